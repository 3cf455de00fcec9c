"""How figures look: `canvas.py` has fonts and paper, `colours.py` and `wording.py` what they say.

`drawing.py` finds the figures that are installed, draws them in this look and writes them.
"""

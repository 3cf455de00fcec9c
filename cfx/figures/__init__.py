"""How figures look: `canvas.py` has fonts and paper, `text.py` the names of methods and units.

`drawing.py` finds the figures that are installed, draws them in this look and writes them.
"""

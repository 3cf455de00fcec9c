"""Figures: a file for each subject says what is shown, how it is drawn and what is said of it.

`figure.py` says what a figure is and what it is drawn from, `canvas.py` how all look. A job writes
them (`write.py`), a report shows the same as SVG. `jobs.py` has those of several jobs.
"""

"""Figures: what a figure of a finished job is, and how all figures look.

`figure.py` says what a figure shows of the results and how it is written, `canvas.py` has fonts,
paper and lines, `text.py` the names of methods and units, `job.py` reads a finished job's folder.
"""

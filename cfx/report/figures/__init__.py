"""Figures: a file each says what is shown of the results, how it is drawn and what is said of it.

`figure.py` says what a figure is and which are installed, `results.py` what they are drawn from,
`canvas.py` how they look. A job writes them (`write.py`), a report shows the same as SVG. `jobs.py`
has the figures of several jobs, which reports alone have.
"""

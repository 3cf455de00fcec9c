"""Figures: what they show is chosen once (`choice/`) and drawn by two backends.

`choice/` holds pure functions that return plain data: lines, limits, notes, labels. `matplotlib/`
draws them for a job's folder, `plotly/` for the HTML report. A backend decides nothing about the
content.
"""

"""Plots of the HTML report: plain data that the page's script draws, checked by plotly."""

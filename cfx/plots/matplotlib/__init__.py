"""Figures of a job as PNG, drawn by matplotlib. Import it where it is used: matplotlib is heavy."""

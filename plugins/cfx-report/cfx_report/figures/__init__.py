"""Figures of finished jobs beyond those of cfx itself, and of several jobs."""

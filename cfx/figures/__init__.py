"""Figures of a job."""

"""Calibration: driver-specific and pooled parameters, labels of windows, and their cache."""

"""Calibration: fixed parameters of a pair, labels of its windows, and their cache."""

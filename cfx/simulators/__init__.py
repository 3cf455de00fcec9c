"""Simulators: what takes the steps of calibration, learning and evaluation."""

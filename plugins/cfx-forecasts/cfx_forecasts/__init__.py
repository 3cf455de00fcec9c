"""Forecasts of single drivers from every moment of their trajectories."""

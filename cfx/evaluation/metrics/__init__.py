"""Metrics: what is measured of simulated trajectories, each a class of one method."""

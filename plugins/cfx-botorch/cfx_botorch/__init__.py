"""Bayesian optimisation by BoTorch as an optimizer of cfx."""

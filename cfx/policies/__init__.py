"""Policies: recent states in, parameters out."""

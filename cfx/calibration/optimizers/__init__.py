"""Optimizers: many independent bounded problems at once."""

"""Optimizers of other libraries, each problem with a search of its own."""

"""Rivals of cfx's benchmark, each a module or a few lines on a shared base."""

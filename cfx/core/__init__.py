"""Foundations of cfx: errors, components, the registry, files, where work runs."""

"""Learners: they train policies."""

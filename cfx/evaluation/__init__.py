"""Evaluation: closed loop, metrics, statistics."""

"""Datasets: recordings in, pairs out."""

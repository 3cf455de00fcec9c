"""Driving style: entropy weights, scores, clusters."""

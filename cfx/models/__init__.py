"""Driving models: pure, batched, differentiable steps."""

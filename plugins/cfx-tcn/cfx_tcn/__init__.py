"""Temporal convolutional networks for cfx: `policy=tcn`."""

"""Classic driving models for cfx: `gipps`, `ovm`, `fvdm` and `newell`."""

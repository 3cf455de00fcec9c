"""Classic driving models for cfx: `gipps`, `gipps_delay`, `ovm`, `fvdm` and `newell`."""

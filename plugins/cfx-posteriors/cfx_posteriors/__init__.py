"""What recordings say of drivers' parameters: `calibration.posterior=laplace|nuts|hierarchical`."""

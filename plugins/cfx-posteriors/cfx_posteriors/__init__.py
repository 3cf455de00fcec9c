"""What recordings say of drivers' parameters: `calibration.posterior=laplace|hierarchical`."""

"""What recordings say of drivers' parameters: `calibration.posterior`, by name of a method."""

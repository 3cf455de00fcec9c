"""What a calibration knows: posterior distributions of parameters, beside the point estimates."""

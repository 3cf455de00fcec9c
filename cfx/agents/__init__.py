"""What drives: a driver's context, networks with their inputs, and a parameter head."""

"""What drives: a driver's context, networks with their inputs, and a head that makes parameters of their answers."""

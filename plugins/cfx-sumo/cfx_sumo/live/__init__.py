"""Live drivers: policies that drive vehicles of a running SUMO simulation."""

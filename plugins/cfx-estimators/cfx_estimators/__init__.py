"""Classical estimators of a driver's parameters as policies."""

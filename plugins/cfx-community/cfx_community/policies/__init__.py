"""Classical estimators of a driver's parameters, and further networks."""

"""SciPy's differential evolution for cfx: `optimizer=differential_evolution`."""

"""CMA-ES for cfx: `optimizer=cma`."""

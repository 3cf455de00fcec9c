"""Jobs in MLflow: their runs, and its user interface with tables and charts set up."""

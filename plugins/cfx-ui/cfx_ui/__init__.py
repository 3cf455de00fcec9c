"""The tracked jobs in the user interface of MLflow."""

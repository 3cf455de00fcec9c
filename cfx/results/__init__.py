"""Tracking: what MLflow keeps of a job."""

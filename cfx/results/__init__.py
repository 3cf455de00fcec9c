"""Results: the configuration of a job, its tables, and where jobs are tracked."""

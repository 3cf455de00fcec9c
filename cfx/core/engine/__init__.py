"""Where a job's work runs: this machine's cores, or a cluster's."""

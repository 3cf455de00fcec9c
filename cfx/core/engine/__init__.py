"""Engines, which run a job's work: this machine's cores, or a cluster's."""

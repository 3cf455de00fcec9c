"""The demonstration that follows a job: its trajectories on a motorway in SUMO."""

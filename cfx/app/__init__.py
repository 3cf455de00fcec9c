"""The program: command line, configuration, jobs and sweeps."""

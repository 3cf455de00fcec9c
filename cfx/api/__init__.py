"""cfx from Python: functions on data frames, over the components that Hydra composes."""

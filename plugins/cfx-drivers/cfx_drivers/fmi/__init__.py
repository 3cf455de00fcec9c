"""cfx's drivers as co-simulation units of FMI 3.0: `cfx export --to fmi`."""

"""The figures of a job that are cfx's own: each an entry point of the group `cfx.figures`."""

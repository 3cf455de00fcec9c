"""One HTML page about finished jobs, complete in itself, to be sent to a colleague."""

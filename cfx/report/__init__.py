"""One HTML page about finished jobs: complete in itself, without any network, to be sent to a colleague."""

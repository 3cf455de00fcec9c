"""A plugin for cfx with one component of each kind, each in a file of its own."""

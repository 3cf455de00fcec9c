"""`python -m cfx`: the same program as the command `cfx`."""

from cfx.cli import program

program()

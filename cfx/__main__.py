"""`python -m cfx`: the same program as the command `cfx`."""

from cfx.app.cli import program

program()

"""`python -m cfx`: the same program as the command `cfx`."""

import sys

from cfx.cli import main

sys.exit(main())

"""`cfx plugins`: what is installed, whether it works, and a new package to start from."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from cfx.completion import complete_with, kinds, names

_KINDS = (
    "dataset (or data), model, simulator, optimizer, objective, policy, learner, protocol or metric"
)


def main(arguments: Sequence[str]) -> int:
    """Runs the sub-command.

    Returns:
        The exit code: 1 if `check` found something broken, 0 otherwise.

    Raises:
        CfxError: the user's mistake.
    """
    options = parser().parse_args(list(arguments))
    if options.action == "show":
        from cfx.plugins.tables import show

        show(options.kind, options.name)
        return 0
    if options.action == "new":
        from cfx.plugins.new import create

        create(options.kind, options.name, options.folder)
        return 0
    if options.action == "check":
        from cfx.plugins.check import check

        return check(options.kind, options.name)
    from cfx.plugins.tables import overview

    overview()
    return 0


def parser() -> argparse.ArgumentParser:
    """Returns the parser of the sub-command."""
    made = argparse.ArgumentParser(
        "cfx plugins", description="Shows the installed components, without importing any."
    )
    actions = made.add_subparsers(dest="action")
    check = actions.add_parser(
        "check", help="load components and try each for a moment; exit code 1 if one is broken"
    )
    kind = check.add_argument("kind", nargs="?", help=f"{_KINDS}; all kinds if left out")
    complete_with(kind, kinds)
    name = check.add_argument("name", nargs="?", help="one component; all of the kind if left out")
    complete_with(name, names)
    show = actions.add_parser("show", help="a component's parameters, settings and reference")
    complete_with(show.add_argument("kind", help=_KINDS), kinds)
    complete_with(show.add_argument("name"), names)
    new = actions.add_parser(
        "new", help="write a package for a component of your own, with tests that pass"
    )
    complete_with(new.add_argument("kind", help=_KINDS), kinds)
    new.add_argument("name", help="as in model=NAME: lower-case letters, digits and _")
    new.add_argument("--folder", type=Path, help="where to write it; default: cfx-NAME, here")
    return made

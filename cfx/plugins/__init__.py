"""`cfx plugins`: what is installed, whether it works, and a new package to start from."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

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
    options = _parser().parse_args(list(arguments))
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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "cfx plugins", description="Shows the installed components, without importing any."
    )
    actions = parser.add_subparsers(dest="action")
    check = actions.add_parser(
        "check", help="load components and try each for a moment; exit code 1 if one is broken"
    )
    check.add_argument("kind", nargs="?", help=f"{_KINDS}; all kinds if left out")
    check.add_argument("name", nargs="?", help="one component; all of the kind if left out")
    show = actions.add_parser("show", help="a component's parameters, settings and reference")
    show.add_argument("kind", help=_KINDS)
    show.add_argument("name")
    new = actions.add_parser(
        "new", help="write a package for a component of your own, with tests that pass"
    )
    new.add_argument("kind", help=_KINDS)
    new.add_argument("name", help="as in model=NAME: lower-case letters, digits and _")
    new.add_argument("--folder", type=Path, help="where to write it; default: cfx-NAME, here")
    return parser

"""`cfx plugins`: what is installed, whether it works, and a new package to start from."""

from __future__ import annotations

import argparse
from pathlib import Path

from cfx.app.completion import complete_with, kinds, names
from cfx.core import registry
from cfx.core.command import Command

_KINDS = f"{', '.join(registry.KINDS)} (data is a dataset too)"


class PluginsCommand(Command):
    """Shows, checks and writes components."""

    summary = "installed components; check loads them all, show prints one, new writes a package"

    def parser(self) -> argparse.ArgumentParser:
        made = argparse.ArgumentParser(
            "cfx plugins", description="Shows the installed components, without importing any."
        )
        actions = made.add_subparsers(dest="action")
        check = actions.add_parser(
            "check", help="load components and try each for a moment; exit code 1 if one is broken"
        )
        kind = check.add_argument("kind", nargs="?", help=f"{_KINDS}; all kinds if left out")
        complete_with(kind, kinds)
        name = check.add_argument(
            "name", nargs="?", help="one component; all of the kind if left out"
        )
        complete_with(name, names)
        show = actions.add_parser("show", help="a component's parameters, settings and reference")
        complete_with(show.add_argument("kind", help=_KINDS), kinds)
        complete_with(show.add_argument("name", help="one component"), names)
        new = actions.add_parser(
            "new", help="write a package for a component of your own, with tests that pass"
        )
        complete_with(new.add_argument("kind", help=_KINDS), kinds)
        new.add_argument("name", help="as in model=NAME: lower-case letters, digits and _")
        new.add_argument("--folder", type=Path, help="where to write it; default: cfx-NAME, here")
        return made

    def run(self, options: argparse.Namespace) -> int:
        if options.action == "show":
            from cfx.app.plugins.tables import show

            show(options.kind, options.name)
            return 0
        if options.action == "new":
            from cfx.app.plugins.new import create

            create(options.kind, options.name, options.folder)
            return 0
        if options.action == "check":
            from cfx.app.plugins.check import check

            return check(options.kind, options.name)
        from cfx.app.plugins.tables import overview

        overview()
        return 0

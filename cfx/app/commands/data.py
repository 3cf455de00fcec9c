"""`cfx data`: what recordings hold, and public ones to download."""

from __future__ import annotations

import argparse
from pathlib import Path

from cfx.core.command import Command


class DataCommand(Command):
    """Looks at recordings."""

    summary = "what a recording holds (describe), a public one to download (fetch)"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser("cfx data", description="Looks at recordings.")
        actions = parser.add_subparsers(dest="action", required=True)
        describe = actions.add_parser("describe", help="what recordings hold")
        describe.add_argument("files", nargs="+", metavar="FILE", help="a recording")
        fetch = actions.add_parser(
            "fetch",
            help="download a public recording; nothing else in cfx uses the network unasked",
        )
        fetch.add_argument(
            "recording", choices=["ngsim-i80"], metavar="ngsim-i80", help="which recording"
        )
        fetch.add_argument(
            "--recording",
            dest="part",
            default="0400",
            help="0400 (default), 0500, 0515 (pm, 15 minutes each) or all",
        )
        fetch.add_argument("--folder", default="data", help="where the file goes; default: data")
        fetch.add_argument("--url", help="of a mirror that speaks SODA, ending in .csv")
        fetch.add_argument(
            "--force", action="store_true", help="download again and replace the file"
        )
        return parser

    def run(self, options: argparse.Namespace) -> int:
        if options.action == "fetch":
            _fetch(options)
            return 0
        from cfx.data.describe import describe

        for number, file in enumerate(options.files):
            if number:
                print()
            print(describe(Path(file)))
        return 0


def _fetch(options: argparse.Namespace) -> None:
    import shlex

    from cfx.core.console import console_logging
    from cfx.core.files import path_override
    from cfx.data.fetch import URL, fetch_ngsim_i80

    with console_logging():
        path = fetch_ngsim_i80(
            Path(options.folder).expanduser(),
            options.part,
            url=options.url or URL,
            force=options.force,
        )
    print(f"Look at it: python -m cfx data describe {shlex.quote(str(path))}")
    print(f"Use it: python -m cfx data=ngsim {shlex.quote(path_override('data.path', path))}")

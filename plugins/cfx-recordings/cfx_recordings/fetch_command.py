"""`cfx data fetch`: public recordings to download."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from cfx.plugin import Command


class FetchCommand(Command):
    """Downloads a public recording."""

    summary = "download a public recording"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx data fetch",
            description="Downloads a public recording; nothing else in cfx uses the network"
            " unasked.",
        )
        parser.add_argument(
            "recording", choices=["ngsim-i80"], metavar="ngsim-i80", help="which recording"
        )
        parser.add_argument(
            "--recording",
            dest="part",
            default="0400",
            help="0400 (default), 0500, 0515 (pm, 15 minutes each) or all",
        )
        parser.add_argument("--folder", default="data", help="where the file goes; default: data")
        parser.add_argument("--url", help="of a mirror that speaks SODA, ending in .csv")
        parser.add_argument(
            "--force", action="store_true", help="download again and replace the file"
        )
        return parser

    def run(self, options: argparse.Namespace) -> int:
        from cfx.plugin import console, files
        from cfx_recordings.fetch import URL, fetch_ngsim_i80

        with console.console_logging(), console.console_logging("cfx_recordings"):
            path = fetch_ngsim_i80(
                Path(options.folder).expanduser(),
                options.part,
                url=options.url or URL,
                force=options.force,
            )
        print(f"Look at it: python -m cfx data describe {shlex.quote(str(path))}")
        override = shlex.quote(files.path_override("data.path", path))
        print(f"Use it: python -m cfx data=ngsim {override}")
        return 0

"""`cfx policies`: the ready-made policies and their cards."""

from __future__ import annotations

import argparse
import re
import sys

from cfx.app.completion import complete_with
from cfx.core.command import Command
from cfx.policies import ready
from cfx.policies.ready.traffic_table import outside_words, traffic_of


class PoliciesCommand(Command):
    """Lists the ready-made policies, or shows the card of one."""

    summary = "the ready-made policies; the card of one (show)"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx policies",
            description="Lists the ready-made policies that come with cfx.",
            epilog="cfx policies make, of the distribution cfx-report, trains them anew.",
        )
        actions = parser.add_subparsers(dest="action")
        actions.add_parser("list", help="all of them, as without an action")
        show = actions.add_parser("show", help="the card of a policy: what it knows, and how well")
        name = show.add_argument("name", help="such as idm, or cfx://idm")
        complete_with(name, lambda _: ready.names())
        return parser

    def run(self, options: argparse.Namespace) -> int:
        if options.action == "show":
            folder = ready.folder_of_ready_made(
                ready.SCHEME + options.name.removeprefix(ready.SCHEME)
            )
            _show((folder / "CARD.md").read_text("utf-8"))
            return 0
        _overview()
        return 0


_UNUSUAL = re.compile(r"\*\*([a-z ]+)\*\* \|$")
"""The verdict at the end of a row of a card's table of traffic, such as `**low** |`, where a value
lies outside what is usual of people; rows with a usual value end without one."""


def _show(text: str) -> None:
    """Prints a card; on a terminal words for values that are not usual are red."""
    from rich.console import Console
    from rich.text import Text

    if not sys.stdout.isatty():
        print(text)
        return
    console = Console(markup=False, highlight=False, soft_wrap=True)
    for line in text.splitlines():
        text_of_line = Text(line)
        verdict = _UNUSUAL.search(line)
        if verdict is not None:
            text_of_line.stylize("bold red", verdict.start(1), verdict.end(1))
        console.print(text_of_line)


def _overview() -> None:
    from cfx.core.console import blank_table, print_table

    table = blank_table(
        "policy",
        "model",
        "RMSE speed [m/s]",
        "over pooled",
        "RMS jerk [m/s3]",
        "traffic: unusual",
        "size",
        "what it is",
    )
    for name in ready.names():
        card = ready.card_of(name)
        errors = card["errors_on_unseen_drivers"]
        table.add_row(
            f"{ready.SCHEME}{name}",
            card["model"],
            f"{errors['rmse_speed']:.3f}",
            f"{errors['improvement_over_pooled']:+.1%}",
            f"{card['safety']['jerk']:.2f}",
            _unusual(name),
            f"{card['size_kb']} kB",
            card["summary"],
        )
    print_table(table)
    print(
        "A policy's card: cfx policies show NAME. Drive with it: cfx drive --drivers car=cfx://NAME"
    )


def _unusual(name: str) -> str:
    """Returns how many values of a policy's traffic are not usual, of how many."""
    measured = traffic_of(name)
    if measured is None:
        return "not measured"
    unusual, compared = outside_words(measured)
    return f"{unusual} of {compared}"

"""Each statement of the contract fails for a sub-command that breaks it, and says so."""

from __future__ import annotations

import argparse

import pytest

from cfx.app.commands.cite import CiteCommand
from cfx.core.command import Command
from cfx.core.contract import Check
from cfx_contracts import commands as checks


class Silent(CiteCommand):
    summary = ""


class Talkative(CiteCommand):
    summary = "one\ntwo"


class Unexplained(CiteCommand):
    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser("cfx made-up")
        actions = parser.add_subparsers()
        actions.add_parser("list", help="lists").add_argument("--long", action="store_true")
        return parser


class Nameless(CiteCommand):
    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser("made-up")
        parser.add_argument("--share", help="a share")
        return parser


class Careless(CiteCommand):
    def parse(self, arguments: object) -> argparse.Namespace:
        return argparse.Namespace()


@pytest.mark.parametrize(
    ("command", "check", "sentence"),
    [
        (Silent(), checks.it_has_a_summary_of_one_line, "is the line of `cfx --help`"),
        (Talkative(), checks.it_has_a_summary_of_one_line, "is one line"),
        (Unexplained(), checks.every_argument_has_help, "long does not"),
        (Nameless(), checks.help_can_be_printed, "`prog` is `cfx NAME`"),
        (Careless(), checks.help_can_be_printed, "exit code 0, not None"),
        (Careless(), checks.an_unknown_option_is_refused, "must not be ignored"),
    ],
)
def test_what_breaks_the_contract_is_found(command: Command, check: Check, sentence: str) -> None:
    with pytest.raises(AssertionError, match=sentence):
        check(command)


def test_a_module_that_imports_something_heavy_is_found() -> None:
    class Heavy(CiteCommand):
        pass

    Heavy.__module__ = "scipy"
    with pytest.raises(AssertionError, match=r"import scipy in `run`"):
        checks.its_module_imports_nothing_heavy(Heavy())

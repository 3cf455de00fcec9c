"""`cfx plugins check`: loads components and holds each to the quick part of its kind's contract."""

from __future__ import annotations

import argparse
import contextlib
import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass

from cfx.app import nodes
from cfx.app.completion import add_kind, complete_with
from cfx.core import registry
from cfx.core.command import Command
from cfx.core.component import API_VERSION, Component
from cfx.core.console import blank_table, console_logging, print_table
from cfx.core.contract import violations
from cfx.core.distributions import OWN
from cfx.core.progress import Task
from cfx.errors import CfxError, ConfigError, NotInstalledError, in_words
from cfx_contracts import contract_for


class CheckCommand(Command):
    """Tries components."""

    summary = "load components and try each for a moment; exit code 1 if one is broken"

    def parser(self) -> argparse.ArgumentParser:
        made = argparse.ArgumentParser("cfx plugins check", description=self.summary)
        add_kind(made, optional=True)
        name = made.add_argument(
            "name", nargs="?", help="one component; all of the kind if left out"
        )
        complete_with(name, lambda options: registry.names(options.kind))
        return made

    def run(self, options: argparse.Namespace) -> int:
        return check(options.kind, options.name)


@dataclass(frozen=True)
class Verdict:
    """What is known of a component after it was tried.

    Attributes:
        entry: which component.
        state: fine, broken, shadowed, or not installed: an extra that it needs is not there.
        complaint: what is wrong, in one sentence that names the distribution; "" if nothing is.
        hint: what could be better; "" if nothing could.
    """

    entry: registry.Entry
    state: str
    complaint: str = ""
    hint: str = ""


def check(kind: str | None = None, name: str | None = None) -> int:
    """Tries all components, those of a kind, or one; prints a table, hints and complaints.

    Returns:
        1 if a component is broken or shadowed, else 0.

    Raises:
        PluginError: there is no such kind or name.
        ConfigError: Python was started with -O.
    """
    if not __debug__:
        raise ConfigError(
            "cfx plugins check is made of assertions, which python -O removes;"
            " start python without -O"
        )
    chosen = _chosen(kind, name)
    verdicts = []
    with console_logging(Task.__module__), Task("Checking components", len(chosen)) as task:
        for entry in chosen:
            with _unheard():
                verdicts.append(examine(entry))
            task.advance()
    rows = blank_table("kind", "name", "distribution", "version", "from", "state")
    for verdict in verdicts:
        entry = verdict.entry
        rows.add_row(
            entry.kind, entry.name, entry.distribution, entry.version, entry.location, verdict.state
        )
    print_table(rows)
    for hint in dict.fromkeys(verdict.hint for verdict in verdicts if verdict.hint):
        print(f"Hint: {hint}")
    complaints = dict.fromkeys(verdict.complaint for verdict in verdicts if verdict.complaint)
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    return 1 if complaints else 0


@contextlib.contextmanager
def _unheard() -> Iterator[None]:
    """Prints nothing of what components say while they are tried."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def _chosen(kind: str | None, name: str | None) -> list[registry.Entry]:
    """Returns the entries of all kinds or one, of all names or one."""
    entries = []
    kinds = list(registry.every_kind()) if kind is None else [registry.kind_of(kind).name]
    for each in kinds:
        for entry in registry.entries(each):
            if name is None or entry.name == name:
                entries.append(entry)
    if not entries and kind is not None and name is not None:
        registry.entry(kind, name)  # says which names there are
    return entries


def examine(entry: registry.Entry) -> Verdict:
    """Tries one component with its default settings, or those of its `trial`.

    Of a kind without a contract the class is imported and examined, no more. Whatever the component
    does, this returns.
    """
    shadow = _shadow(entry)
    if shadow:
        return Verdict(entry, "shadowed", shadow)
    complaint = hint = ""
    try:
        cls = registry.get(entry.kind, entry.name)
        if entry.kind in registry.KINDS:
            nodes.render(cls, entry.name)
            hint = _not_tried(entry, cls)
            if not hint:
                component = registry.create(entry.kind, {"name": entry.name, **cls.trial})
                complaint = _broken_contract(entry, component)
        else:
            hint = (
                f"the kind '{entry.kind}' has no contract: its classes were loaded but not tried."
            )
    except NotInstalledError as error:
        return Verdict(entry, "not installed", hint=str(error))
    except CfxError as error:
        complaint = " ".join(str(error).split())
        if entry.distribution not in complaint:
            complaint = f"{entry}: {complaint}"
    except Exception as error:  # a plugin may raise anything
        complaint = f"{entry} cannot be used with its default settings: {in_words(error)}"
    if complaint:
        return Verdict(entry, "broken", complaint)
    if hint or entry.distribution == OWN or entry.api:
        return Verdict(entry, "fine", hint=hint)
    hint = (
        f"{entry.distribution} declares no version of cfx's plugin API and counts as built for the"
        " current one; its author can add to pyproject.toml:"
        f' [project.entry-points."{registry.API_GROUP}"] {API_VERSION} = "{entry.package}"'
    )
    return Verdict(entry, "fine", hint=hint)


def _not_tried(entry: registry.Entry, cls: type[Component]) -> str:
    """Returns why a component cannot be tried; "" if it can."""
    required = []
    for name, field in cls.schema.model_fields.items():
        if registry.is_blank(field):
            required.append(f"{registry.kind_of(entry.kind).group}.{name}")
    if not required:
        return ""
    keys = ", ".join(required)
    return f"{entry.kind} '{entry.name}' was loaded but not tried: it needs {keys}."


def _shadow(entry: registry.Entry) -> str:
    """Returns why another component of that name is used instead; "" if none is."""
    namesakes = registry.namesakes(entry)
    if not namesakes:
        return ""
    if namesakes[0].distribution == OWN:
        return (
            f"{entry} is never used, because cfx has a {entry.kind} '{entry.name}' of its own;"
            f" its author must rename it, or pip uninstall {entry.distribution}"
        )
    others = " and ".join(f"{other.distribution} {other.version}" for other in namesakes)
    return (
        f"{entry} cannot be used, because {others} brings a {entry.kind} of that name too;"
        " uninstall one of them"
    )


def _broken_contract(entry: registry.Entry, component: object) -> str:
    """Returns the first statement of the contract that does not hold; "" if all hold."""
    broken = list(violations(component, contract_for(entry.kind).quick))
    if not broken:
        return ""
    check, sentence = broken[0]
    text = f"{entry} breaks its contract: {' '.join(sentence.split())} ({check})"
    if len(broken) > 1:
        text += f"; and {len(broken) - 1} more"
    return f"{text}; cfx_contracts.check_contract in its own tests shows all of it"

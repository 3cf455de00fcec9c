"""`cfx plugins check`: loads components and holds each to the quick part of its kind's contract."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from cfx import nodes, registry
from cfx.component import API_VERSION
from cfx.console import blank_table, put
from cfx.errors import CfxError, ConfigError
from cfx.progress import Task


@dataclass(frozen=True)
class Verdict:
    """What is known of a component after it was tried.

    Attributes:
        entry: which component.
        state: fine, broken or shadowed.
        complaint: what is wrong, in one sentence that names the distribution; "" if nothing is.
        hint: what could be better; "" if nothing could.
    """

    entry: registry.Entry
    state: str
    complaint: str = ""
    hint: str = ""


def check(kind: str | None = None, name: str | None = None) -> int:
    """Tries components and prints a table, complaints on stderr and hints; returns 1 if one is broken or shadowed, else 0.

    Args:
        kind: one kind alone.
        name: one name of that kind alone.

    Raises:
        PluginError: there is no such kind or name.
        ConfigError: Python was started with -O.
    """
    if not __debug__:
        raise ConfigError(
            "cfx plugins check is made of assertions, which python -O removes; start python without -O"
        )
    chosen = _chosen(kind, name)
    verdicts = []
    with Task("Checking components", len(chosen)) as task:
        for entry in chosen:
            verdicts.append(examine(entry))
            task.advance()
    rows = blank_table("kind", "name", "distribution", "version", "from", "state")
    for one in verdicts:
        entry = one.entry
        rows.add_row(
            entry.kind, entry.name, entry.distribution, entry.version, entry.location, one.state
        )
    put(rows)
    for hint in dict.fromkeys(one.hint for one in verdicts if one.hint):
        print(f"Hint: {hint}")
    complaints = list(dict.fromkeys(one.complaint for one in verdicts if one.complaint))
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    return 1 if complaints else 0


def _chosen(kind: str | None, name: str | None) -> list[registry.Entry]:
    kinds = registry.KINDS if kind is None else [registry.kind_of(kind).name]
    found = [
        entry
        for one in kinds
        for entry in registry.entries(one)
        if name is None or entry.name == name
    ]
    if not found and kind is not None and name is not None:
        registry.entry(kind, name)  # says which names there are
    return found


def examine(entry: registry.Entry) -> Verdict:
    """Tries one component with its default settings, or those of its `trial`; whatever it does, this returns."""
    shadow = _shadow(entry)
    if shadow:
        return Verdict(entry, "shadowed", shadow)
    try:
        cls = registry.get(entry.kind, entry.name)
        nodes.render(cls, entry.name)
        required = [
            name for name, field in cls.schema.model_fields.items() if registry.is_blank(field)
        ]
        if required:
            return Verdict(entry, "fine", hint=_not_tried(entry, required))
        component = registry.create(entry.kind, {"name": entry.name, **cls.trial})
        complaint = _broken_contract(entry, component)
    except CfxError as error:
        complaint = " ".join(str(error).split())
        if entry.distribution not in complaint:
            complaint = f"{entry}: {complaint}"
    except Exception as error:  # a plugin may raise anything
        complaint = f"{entry} cannot be used with its default settings: {registry.in_words(error)}"
    return (
        Verdict(entry, "broken", complaint)
        if complaint
        else Verdict(entry, "fine", hint=_undeclared(entry))
    )


def _shadow(entry: registry.Entry) -> str:
    rivals = registry.rivals(entry)
    if not rivals:
        return ""
    if rivals[0].distribution == registry.OWN:
        return (
            f"{entry} is never used, because cfx has a {entry.kind} '{entry.name}' of its own; its author must rename it, or pip"
            f" uninstall {entry.distribution}"
        )
    others = " and ".join(f"{one.distribution} {one.version}" for one in rivals)
    return f"{entry} cannot be used, because {others} brings a {entry.kind} of that name too; uninstall one of them"


def _broken_contract(entry: registry.Entry, component: object) -> str:
    from cfx.testing import contract_for, violations

    found = [
        f"{' '.join(sentence.split())} ({check})"
        for check, sentence in violations(contract_for(entry.kind), component)
    ]
    if not found:
        return ""
    more = f"; and {len(found) - 1} more" if len(found) > 1 else ""
    return f"{entry} breaks its contract: {found[0]}{more}; its own tests with cfx.testing's suite show all of it"


def _not_tried(entry: registry.Entry, required: list[str]) -> str:
    keys = ", ".join(f"{registry.kind_of(entry.kind).group}.{name}" for name in required)
    return f"{entry.kind} '{entry.name}' was loaded but not tried: it needs {keys}."


def _undeclared(entry: registry.Entry) -> str:
    if entry.distribution == registry.OWN or entry.api:
        return ""
    return (
        f"{entry.distribution} declares no version of cfx's plugin API and counts as built for the current one; its author can"
        f' add to pyproject.toml: [project.entry-points."{registry.API_GROUP}"] {API_VERSION} = "{entry.package}"'
    )

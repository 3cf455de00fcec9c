"""Which vehicles a program gives its driver, instant by instant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class Roster:
    """Tells which vehicles are a program's no more.

    A program that steps all its vehicles in one call gives up those that the call leaves out. One
    that makes several calls at an instant may give a vehicle in a later one: then it is given up
    when the next instant comes.
    """

    def __init__(self) -> None:
        self._given: set[str] = set()
        self._calls = 0

    def add(self, given: list[str]) -> None:
        """Notes the vehicles of a further call at the same instant."""
        self._calls += 1
        self._given.update(given)

    def begin_instant(self, given: list[str]) -> set[str]:
        """Notes the vehicles of the first call at an instant.

        Returns:
            Those that the program gave as this instant began, beside those of this call: at the
            last instant, where it made several calls.
        """
        before, self._given = self._given, set(given)
        if self._calls == 1:
            before = self._given
        self._calls = 1
        return before

    def forget(self, name: str) -> None:
        """Drops a vehicle."""
        self._given.discard(name)

    def clear(self) -> None:
        """Drops all calls and vehicles."""
        self._given, self._calls = set(), 0

    @property
    def given(self) -> set[str]:
        """The vehicles of the calls at this instant."""
        return self._given

    def described(self) -> dict[str, Any]:
        """Returns what `go_on` reads, as text and numbers."""
        return {"given": sorted(self._given), "calls": self._calls}

    def go_on(self, described: Mapping[str, Any]) -> None:
        """Goes on from a description."""
        self._given = set(described["given"])
        self._calls = described["calls"]

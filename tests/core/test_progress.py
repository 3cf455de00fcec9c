"""Progress: bars in notebooks and on a job's terminal, nothing on a program's."""

from __future__ import annotations

import io
import sys
from types import SimpleNamespace

import pytest
from rich.console import Console

from cfx.core import progress
from cfx.core.guest import visit

Shown = list[tuple[str, bool]]


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> Shown:
    """Stands in for a kernel, with or without IPython installed; returns what it is shown."""
    shown: Shown = []

    def display(data: dict[str, str], *, raw: bool, display_id: str, update: bool) -> None:
        assert raw
        assert display_id
        shown.append((data["text/html"], update))

    shell = SimpleNamespace(kernel=object())
    ipython = SimpleNamespace(get_ipython=lambda: shell)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(
        sys.modules,
        "IPython.display",
        SimpleNamespace(display=display),
    )
    return shown


def _terminal() -> tuple[Console, io.StringIO]:
    written = io.StringIO()
    return Console(file=written, force_terminal=True), written


def test_a_notebook_shows_a_bar_and_takes_it_away(
    notebook: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "_DRAW_EVERY", 0.0)
    console, written = _terminal()
    with visit(), progress.Task("a < b", 4, console) as task:
        task.advance(3)
    pages = [page for page, _ in notebook]
    assert any("a &lt; b" in page and 'max="4" value="3"' in page for page in pages)
    assert notebook[-1] == ("", True)
    assert [update for _, update in notebook].count(False) == 1
    assert written.getvalue() == ""


def test_short_work_leaves_a_notebook_as_it_is(notebook: Shown) -> None:
    with progress.Task("short", 1) as task:
        task.advance()
    assert notebook == []


@pytest.mark.parametrize("of_a_program", [False, True])
def test_only_jobs_draw_on_a_terminal(of_a_program: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "IPython", None)
    console, written = _terminal()

    def work() -> None:
        with progress.Task("counting", 1, console) as task:
            task.advance()

    if of_a_program:
        with visit():
            work()
    else:
        work()
    assert ("counting" in written.getvalue()) is not of_a_program

"""The browser that tests of pages use must see what a page asks for."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.browser import Browser, find_chromium

PAGE = """<!doctype html><title>a page</title><p id="text"></p>
<script>document.getElementById("text").textContent = "drawn by a script"; {more}</script>"""


def test_a_page_is_drawn_and_a_complete_one_asks_for_nothing(
    browser: Browser, tmp_path: Path
) -> None:
    file = tmp_path / "page.html"
    file.write_text(PAGE.format(more=""), encoding="utf-8")
    browser.page.goto(file.as_uri())
    assert browser.page.text_content("#text") == "drawn by a script"
    assert browser.addresses == [file.as_uri()]
    assert browser.over_network() == browser.outside() == browser.errors == []


def test_what_a_page_asks_for_outside_is_seen_and_not_reached(
    browser: Browser, tmp_path: Path
) -> None:
    file = tmp_path / "page.html"
    more = """fetch("https://example.org/x").catch(() => { document.title = "refused" }); new WebSocket("wss://example.org/y");
    fetch("http://127.0.0.1:9/").catch(() => 0); undefined_name()"""
    file.write_text(PAGE.format(more=more), encoding="utf-8")
    browser.page.goto(file.as_uri())
    browser.page.wait_for_function("document.title === 'refused'")
    assert sorted(browser.outside()) == ["https://example.org/x", "wss://example.org/y"]
    assert "http://127.0.0.1:9/" in browser.over_network()
    assert any("undefined_name" in error for error in browser.errors)


def test_a_browser_that_is_named_must_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CFX_TEST_BROWSER", "/nowhere/chromium")
    with pytest.raises(pytest.fail.Exception, match="names /nowhere/chromium, which cannot be run"):
        find_chromium()

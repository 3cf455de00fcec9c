"""A real headless Chromium for tests of pages.

It reaches this machine only, and every address it asks for is kept. Debian's `chromium` does
(`apt-get install chromium`), or the browser that `CFX_TEST_BROWSER` names. Without one the tests
skip, unless `CFX_TEST_BROWSER_REQUIRED` is set, as `.ci/run` does. Playwright controls it, and
downloads no browser of its own.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, Page

NAMES = (
    "chromium",
    "chromium-browser",
    "google-chrome-stable",
    "google-chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
)
OPTIONS = (
    "--no-sandbox",  # CI runs as root in a container, where Chromium's sandbox cannot start
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # Even a page that asks for it reaches nothing outside.
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)
WITHOUT_NETWORK = ("about", "blob", "chrome", "data", "file")


@dataclass(frozen=True)
class Browser:
    """A fresh browser with one empty page.

    Attributes:
        page: Playwright's page; `page.goto(path.as_uri())` opens a file.
        addresses: all that was asked for since the start, in order, by every page, frame and
            worker; WebSockets too.
        errors: uncaught exceptions of the pages' scripts, and what they wrote to the console as an
            error.
    """

    page: Page
    addresses: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def over_network(self) -> list[str]:
        """Returns the addresses that need a network at all, 127.0.0.1 included.

        It must be empty for a file that is complete.
        """
        return [one for one in self.addresses if urlsplit(one).scheme not in WITHOUT_NETWORK]

    def outside(self) -> list[str]:
        """Returns the addresses that are not on this machine."""
        return [one for one in self.over_network() if urlsplit(one).hostname != "127.0.0.1"]


def find_chromium() -> str | None:
    """Returns the path of a Chromium or Chrome on this machine, None if there is none."""
    named = os.environ.get("CFX_TEST_BROWSER")
    if named:
        return shutil.which(named) or pytest.fail(
            f"CFX_TEST_BROWSER names {named}, which cannot be run", pytrace=False
        )
    return next(filter(None, map(shutil.which, NAMES)), None)


@pytest.fixture
def browser() -> Iterator[Browser]:
    """Starts Chromium for one test (half a second).

    Playwright's event loop then never meets another test.
    """
    path = find_chromium()
    if path is None:
        complaint = (
            "no Chromium on this machine"
            " (apt-get install chromium, or name one in CFX_TEST_BROWSER)"
        )
        if os.environ.get("CFX_TEST_BROWSER_REQUIRED"):
            pytest.fail(complaint, pytrace=False)
        pytest.skip(complaint)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=path, args=list(OPTIONS), timeout=120_000
        )
        try:
            context = chromium.new_context(viewport={"width": 1600, "height": 1000}, locale="en-US")
            context.set_default_timeout(
                60_000
            )  # a page that never comes is a failure, a slow machine is none
            watched = Browser(context.new_page())
            _watch(context, watched)
            yield watched
        finally:
            chromium.close()


def _watch(context: BrowserContext, watched: Browser) -> None:
    context.on("request", lambda request: watched.addresses.append(request.url))
    context.on("weberror", lambda error: watched.errors.append(str(error.error)))
    context.on(
        "console",
        lambda message: watched.errors.append(message.text) if message.type == "error" else None,
    )
    watched.page.on("websocket", lambda socket: watched.addresses.append(socket.url))

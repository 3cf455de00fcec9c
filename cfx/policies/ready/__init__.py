"""Ready-made policies, which come with the package: `cfx://NAME` wherever a job is named.

Each is a folder with a policy, its card (`card.json`, and `CARD.md` for people) and the metrics of
the job that tested it on unseen drivers (`metrics.json`). `cfx policies make`, which comes with the
distribution cfx-report, makes them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cfx.errors import DataError, nearest

SCHEME = "cfx://"

READY_FOLDER = Path(__file__).resolve().parent / "policies"
"""Holds a folder for each ready-made policy, by its name."""


def names() -> tuple[str, ...]:
    """Returns the names of all ready-made policies, sorted."""
    cards = [card.parent.name for card in READY_FOLDER.glob("*/card.json")]
    return tuple(sorted(cards))


def is_ready_made(text: object) -> bool:
    """Says whether a text names a ready-made policy, whether or not there is one of that name."""
    return str(text).startswith(SCHEME)


def folder_of_ready_made(text: str) -> Path:
    """Returns the folder of `cfx://NAME`.

    Raises:
        DataError: there is no such policy.
    """
    name = text.removeprefix(SCHEME)
    options = names()
    if name not in options:
        raise DataError(
            f"{text}: there is no ready-made policy '{name}'.{nearest(name, options)}"
            f" cfx policies lists them: {', '.join(options)}."
        )
    return READY_FOLDER / name


def card_of(name: str) -> dict[str, Any]:
    """Returns the card of a ready-made policy.

    Raises:
        DataError: there is no such policy.
    """
    folder = folder_of_ready_made(f"{SCHEME}{name.removeprefix(SCHEME)}")
    card: dict[str, Any] = json.loads((folder / "card.json").read_text(encoding="utf-8"))
    return card

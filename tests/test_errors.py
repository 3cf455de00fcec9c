"""What an error's text may hold when it reaches a terminal or a file."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from cfx.core.console import ConsoleHandler
from cfx.errors import DataError, in_words, printable, without_passwords


def test_names_cannot_command_a_terminal() -> None:
    said = str(DataError("pair '\x1b]0;owned\x07\x1b[2Jx' has\nno frame: Zürich ✓"))
    assert said == "pair '\\x1b]0;owned\\x07\\x1b[2Jx' has\nno frame: Zürich ✓"
    assert printable("plain\ttext") == "plain\ttext"


@pytest.mark.parametrize(
    ("uri", "shown"),
    [
        ("postgresql://me:secret@host:5432/db", "postgresql://me:***@host:5432/db"),
        ("open mysql+pymysql://me:s%40cret@h/db now", "open mysql+pymysql://me:***@h/db now"),
        ("http://127.0.0.1:5000/#/a@b", "http://127.0.0.1:5000/#/a@b"),
        ("sqlite:////home/me/a.db", "sqlite:////home/me/a.db"),
    ],
)
def test_passwords_of_uris_are_never_shown(uri: str, shown: str) -> None:
    assert without_passwords(uri) == shown
    assert str(DataError(uri)) == shown


def test_messages_of_the_log_are_as_harmless(capsys: pytest.CaptureFixture[str]) -> None:
    record = logging.LogRecord(
        "cfx.test", logging.INFO, "", 0, "pair \x1b[2J of postgresql://a:b@c/d", None, None
    )
    ConsoleHandler().emit(record)
    assert capsys.readouterr().out == "pair \\x1b[2J of postgresql://a:***@c/d\n"


@pytest.mark.parametrize(
    "asked", [lambda values: max(values, 0.0), float, math.sqrt, lambda values: values and 1]
)
def test_python_that_asks_a_tensor_for_one_value_is_told_what_to_write(
    asked: Callable[[torch.Tensor], object],
) -> None:
    with pytest.raises((RuntimeError, ValueError)) as error:
        asked(torch.ones(2))
    words = in_words(error.value)
    assert "torch.where(condition, this, that)" in words
    assert f"{Path(__file__).name}, line " in words

"""Errors of the user: one sentence with what is wrong, where, and what to write instead."""

from __future__ import annotations

import difflib
import os
import re
import traceback
from collections.abc import Iterable


class CfxError(Exception):
    """A user's mistake.

    The command line prints its text alone, on stderr, and exits with `exit_code`.
    """

    exit_code = 2

    def __str__(self) -> str:
        """Returns the text without passwords, and without what a terminal would obey."""
        return printable(without_passwords(super().__str__()))


def printable(text: str) -> str:
    r"""Returns a text in which control characters other than new lines are written as `\x1b`.

    Names in recordings may hold sequences that change a terminal's title or clear it.
    """
    characters = []
    for character in text:
        if character.isprintable() or character in "\n\t":
            characters.append(character)
        else:
            characters.append(character.encode("unicode_escape").decode())
    return "".join(characters)


def without_passwords(text: str) -> str:
    """Returns a text in which the passwords of URIs are written as `***`."""
    return re.sub(r"(://[^/\s:@]*):[^/\s@]+@", r"\1:***@", text)


class Terminated(BaseException):
    """SIGTERM arrived."""


class ConfigError(CfxError):
    """A value or a key of the configuration is wrong."""


class DataError(CfxError):
    """A data file is missing, cannot be read, or holds what no recording can hold."""


class PluginError(CfxError):
    """A component cannot be found, cannot be imported, or breaks its contract."""


class ParameterError(CfxError):
    """A model parameter lies outside its bounds or its specification is contradictory."""


class TrackingError(CfxError):
    """The MLflow store cannot be reached or is not one of ours."""


class OutputError(CfxError):
    """A result cannot be written."""


class NotInstalledError(CfxError):
    """A package that nothing else needs is not installed; says what installs it."""


class JobFailedError(CfxError):
    """A job of a multirun failed; its folder says why."""


class EngineError(CfxError):
    """The workers of an engine cannot be reached, or were lost for good."""


class SumoError(CfxError):
    """SUMO is missing, or does not do what is asked of it."""


def nearest(name: str, choices: Iterable[str]) -> str:
    """Returns " Did you mean 'x'?" for the nearest of `choices`, or "" if none is near.

    Capital letters make no difference: `idm` is near IDM.
    """
    in_lower_case = {choice.lower(): choice for choice in choices}
    close = difflib.get_close_matches(name.lower(), in_lower_case, n=1, cutoff=0.5)
    if not close:
        return ""
    return f" Did you mean '{in_lower_case[close[0]]}'?"


def first_line(error: BaseException) -> str:
    """Returns the first line of an error's text; its type's name where it has none."""
    text = str(error).strip()
    if not text:
        return type(error).__name__
    return text.splitlines()[0].strip()


_OF_MANY = re.compile(
    r"Boolean value of Tensor|elements? tensors can be converted|cannot be converted to Scalar"
)
"""What PyTorch says where Python asks a tensor of many values for one."""


def in_words(error: BaseException) -> str:
    """Returns an error's type and the first line of its text.

    Of an `if`, a `max` or a `float` of a tensor it says where it stands, and what to write.
    """
    first = next(iter(str(error).splitlines()), "")
    words = f"{type(error).__name__}: {first}".rstrip(": ")
    if not _OF_MANY.search(first):
        return words
    torch = f"{os.sep}torch{os.sep}"
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if torch not in frame.filename:
            words = f"{frame.filename}, line {frame.lineno}, `{frame.line}`"
            break
    return (
        f"{words}: a tensor holds a value for each driver, so that it has no single truth and is no"
        " single number; write torch.where(condition, this, that) in place of if, and"
        " torch.maximum, torch.minimum and torch.sqrt in place of max, min and math.sqrt"
    )


def listed(values: Iterable[object], limit: int = 12) -> str:
    """Returns the values separated by commas, cut off after `limit` of them."""
    texts = [str(value) for value in values]
    text = ", ".join(texts[:limit])
    if len(texts) > limit:
        text += f", ... ({len(texts)} in all)"
    return text

"""What Hydra says about a wrong command line, in one sentence with the nearest right name."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator, Sequence
from typing import Any

import yaml
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cfx import hydra_source
from cfx.errors import CfxError, nearest


def is_user_error(error: BaseException) -> bool:
    """Says whether an error raised outside the job itself is the user's to mend."""
    if isinstance(
        error, CfxError | HydraException | OmegaConfBaseException | yaml.YAMLError | OSError
    ):
        return True
    # Hydra raises plain errors for contradictory flags and for options of the wrong type.
    return isinstance(
        error, ValueError | AssertionError | RuntimeError | ImportError
    ) and _raised_in(error).startswith(("hydra.", "hydra_plugins.", "omegaconf."))


def explain(error: BaseException, overrides: Sequence[str]) -> str:
    """Returns one sentence (for several wrong keys, one each) that says what to write instead."""
    if isinstance(error, CfxError):
        return str(error)
    file_error = next((cause for cause in _chain(error) if _is_about_a_file(cause)), None)
    if isinstance(file_error, OSError):
        return (
            f"{file_error.filename}: {file_error.strerror}; choose an output folder that can be written with"
            " hydra.run.dir=FOLDER (multiruns: hydra.sweep.dir=FOLDER)"
        )
    if (
        isinstance(error, MissingConfigException)
        and error.missing_cfg_file
        and error.options is not None
    ):
        return _unknown_option(error.missing_cfg_file, error.options)
    if isinstance(error, OverrideParseException):
        return _unreadable(error)
    return _reworded(error, overrides)


def _reworded(error: BaseException, overrides: Sequence[str]) -> str:
    text = str(error).strip()
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        return _unknown_key(unknown[1], overrides)
    several = re.search(
        r"(?:Ambiguous value for argument|Sweep parameters) '(.+?)'(?:\n| requires)", text
    )
    if several:
        return (
            f"{several[1]}: several values need a multirun; add -m (or write key=[a,b] for a list)"
        )
    if text.startswith("Config group override must be"):
        return f"{text}; choose an option by its name, such as model=w99"
    return _plain(error)


def _unknown_option(path: str, options: Sequence[str]) -> str:
    group, _, name = path.rpartition("/")
    known = f" Known: {', '.join(options)}." if options else ""
    return f"{group}={name}: there is no {group} '{name}'.{nearest(name, options)}{known}"


def _unreadable(error: OverrideParseException) -> str:
    word = error.override
    if "=" not in word:
        from cfx.cli import COMMANDS

        advice = nearest(word, COMMANDS)
        return f"{word}: neither key=value nor a sub-command.{advice} See cfx --help."
    words = [
        line
        for line in error.message.splitlines()
        if not line.startswith(("Error parsing", "See "))
    ]
    detail = re.sub(r" expecting \{.*\}", "", words[0]) if words else "syntax"
    return f"{word}: cannot be read as key=value ({detail}); quote a value that holds special characters: key=\\'value\\'"


def _unknown_key(key: str, overrides: Sequence[str]) -> str:
    given = next((one for one in overrides if re.match(rf"\+*{re.escape(key)}\b", one)), key)
    others = [one for one in overrides if one != given]
    try:
        config: Any = hydra_source.composed(others)
    except Exception:  # the other overrides may be wrong too; the sentence is then without advice
        return f"{given}: there is no key '{key}'; cfx --cfg job prints every key"
    parent, _, last = key.rpartition(".")
    siblings = OmegaConf.select(config, parent) if parent else config
    if isinstance(siblings, DictConfig):
        names = sorted(str(name) for name in siblings if name != "hydra")
        close = nearest(last, names)
        if parent and close:
            close = close.replace("'", f"'{parent}.", 1)
        return f"{given}: there is no key '{key}'.{close} Known keys{f' of {parent}' if parent else ''}: {', '.join(names)}."
    known = _keys(OmegaConf.to_container(config, resolve=False))
    return f"{given}: there is no key '{key}'.{nearest(key, known)} cfx --cfg job prints every key."


def _keys(values: Any, path: str = "") -> Iterator[str]:
    for name, value in values.items():
        full = f"{path}.{name}" if path else str(name)
        yield full
        if isinstance(value, dict):
            yield from _keys(value, full)


def _plain(error: BaseException) -> str:
    """Returns Hydra's own words, and those of the error behind it, on one line."""
    parts = []
    for cause in _chain(error):
        lines = [line.strip() for line in str(cause).splitlines()]
        kept = [
            line
            for line in lines
            if line
            and not line.startswith(
                ("object_type=", "See https://", "Config search path", "provider=")
            )
        ]
        if kept:
            parts.append(" ".join(kept))
    return (
        ": ".join(dict.fromkeys(parts))
        or f"{type(error).__name__} while composing the configuration"
    )


def _chain(error: BaseException) -> Iterator[BaseException]:
    current: BaseException | None = error
    while current is not None:
        yield current
        current = current.__cause__


def _is_about_a_file(error: BaseException) -> bool:
    return (
        isinstance(error, OSError)
        and not isinstance(error, HydraException)
        and bool(error.filename and error.strerror)
    )


def _raised_in(error: BaseException) -> str:
    """Returns the module of the innermost frame."""
    frames = list(traceback.walk_tb(error.__traceback__))
    return str(frames[-1][0].f_globals.get("__name__", "")) if frames else ""

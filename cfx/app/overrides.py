"""From settings to a configuration and back to the command line that composes it."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cfx.app import hydra_source
from cfx.app.user_errors import explained
from cfx.core import registry
from cfx.core.files import IN_MEMORY, quoted
from cfx.errors import ConfigError, DataError
from cfx.results.config import JobConfig


def override(key: str, value: Any) -> str:
    """Returns the override `key=value` in Hydra's grammar, such as `data.min_duration=30`.

    Raises:
        ConfigError: the value is nothing that a configuration can hold.
    """
    try:
        return f"{key}={_text(value)}"
    except TypeError as error:
        advice = ""
        if key == "model":
            advice = "; a class of yours gets a name by @cfx.model(NAME)"
        raise ConfigError(
            f"{key}: a setting is a text, a number, None, or a list or mapping of these, not"
            f" {error}{advice}"
        ) from None


def config_of(settings: Mapping[str, Any]) -> JobConfig:
    """Composes a configuration as the command line does; None and the text "null" mean `null`.

    Raises:
        CfxError: a name or a value is wrong.
    """
    overrides = []
    for key, value in settings.items():
        is_null = isinstance(value, str) and value == "null"
        overrides.append(override(key, None if is_null else value))
    with explained(overrides):
        values = hydra_source.plain(hydra_source.composed(overrides))
    return JobConfig.of(values)


def command_of(config: JobConfig) -> str:
    """Returns the command line that runs a configuration.

    Raises:
        DataError: its pairs or its policy are in this program's memory and in no file.
    """
    if IN_MEMORY in str(config.data.get("path")):
        raise DataError(
            "these pairs come from a data frame, which no command can read; save them first:"
            " pairs = pairs.save('pairs.parquet')"
        )
    if IN_MEMORY in str(config.protocol.get("run")):
        raise DataError(
            "this policy is in no folder, and no command can read it; save it first:"
            " result.save('outputs/policy')"
        )
    return shlex.join(["python", "-m", "cfx", *overrides_of(config)])


def overrides_of(config: JobConfig) -> tuple[str, ...]:
    """Returns overrides that compose a configuration.

    They name the experiment and the model, and what differs from the defaults that these have:
    other components first, then single settings.
    """
    values = config.model_dump(mode="json")
    chosen = []
    if config.preset:
        chosen.append(f"experiment={config.preset}")
    usual = _composed(chosen)
    for group in registry.GROUPS:
        node = values.get(group)
        is_usual = (usual.get(group) or {}).get("name") == (node or {}).get("name")
        if node is not None and (group == "model" or not is_usual):
            chosen.append(f"{group}={node.get('name')}")
    usual = _composed(chosen)
    values.pop("preset")
    chosen += _differences("", values, usual)
    return tuple(chosen)


def _composed(overrides: Sequence[str]) -> dict[str, Any]:
    """Returns the configuration that overrides compose, as it is written to files."""
    plain = hydra_source.plain(hydra_source.composed(overrides))
    return JobConfig.of(plain).model_dump(mode="json")


def _differences(prefix: str, values: Mapping[str, Any], usual: Mapping[str, Any]) -> Iterator[str]:
    """Yields the overrides of values that differ from the usual ones."""
    for name, value in values.items():
        key = f"{prefix}{name}"
        if name not in usual:
            yield override(f"++{key}", value)
            continue
        before = usual[name]
        if value == before:
            continue
        if isinstance(value, Mapping) and isinstance(before, Mapping) and before:
            yield from _differences(f"{key}.", value, before)
        else:
            yield override(key, value)


def _text(value: Any) -> str:
    """Returns a value in Hydra's grammar.

    Raises:
        TypeError: a configuration cannot hold it; the message says what it is.
    """
    if hasattr(value, "tolist"):  # a number or an array of NumPy's, a series, a tensor
        value = value.tolist()
    if isinstance(value, str | Path):
        text = str(value)
        # Without quotes Hydra would read such a text as a Boolean, as null or as a number.
        is_ambiguous = text.lower() in {"true", "false", "null"}
        with contextlib.suppress(ValueError):
            float(text)
            is_ambiguous = True
        return quoted(text, always=is_ambiguous)
    if isinstance(value, Mapping):
        pairs = [f"{_text(key)}: {_text(item)}" for key, item in value.items()]
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, Sequence):
        return "[" + ", ".join(_text(item) for item in value) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int | float):
        return repr(value)
    # Of what stands within a list or a mapping, it is the item that is named.
    raise TypeError(
        f"the class {value.__name__}" if isinstance(value, type) else f"a {type(value).__name__}"
    )

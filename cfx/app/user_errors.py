"""What Hydra says about a wrong command line, in one sentence with the nearest right name."""

from __future__ import annotations

import contextlib
import math
import re
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cfx.app import hydra_source
from cfx.core import registry
from cfx.core.distributions import advice, brought
from cfx.errors import CfxError, ConfigError, listed, nearest


def is_user_error(error: BaseException) -> bool:
    """Says whether an error raised outside the job itself is the user's to mend."""
    if isinstance(
        error, CfxError | HydraException | OmegaConfBaseException | yaml.YAMLError | OSError
    ):
        return True
    if isinstance(error, ValueError) and isinstance(error.__cause__, OSError):
        return str(error).startswith("Unable to configure handler")  # the log cannot be opened
    # Hydra raises plain errors for contradictory flags and for options of the wrong type.
    if not isinstance(error, ValueError | AssertionError | RuntimeError | ImportError):
        return False
    module = ""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__", ""))  # of the innermost frame in the end
    return module.startswith(("hydra.", "hydra_plugins.", "omegaconf."))


@contextlib.contextmanager
def explained(overrides: Sequence[str]) -> Iterator[None]:
    """Composes a configuration in the block.

    Raises:
        ConfigError: what Hydra says of the overrides, in one sentence; or an override chooses a
            component otherwise than by its name.
    """
    refuse_choices(overrides)
    try:
        yield
    except Exception as error:
        if is_user_error(error) and not isinstance(error, CfxError):
            raise ConfigError(explain(error, overrides)) from None
        raise


def refuse_choices(overrides: Sequence[str]) -> None:
    """Refuses overrides that choose a component otherwise than by its name.

    Hydra would merge the settings of several options into one, and does not say where it has found
    null or a number, nor that a path is none of its options.

    Raises:
        ConfigError: the first of them.
    """
    for override in overrides:
        key, _, value = override.partition("=")
        group, value = key.lstrip("+"), value.strip(" '\"")
        if group not in registry.GROUPS or not value:
            continue
        kind = registry.GROUPS[group].name
        if value.startswith("["):
            raise ConfigError(
                f"{override}: a job has one {kind}; several need a multirun"
                f" (-m {group}={value.strip('[]')}), in Python a call for each"
            )
        is_file = "/" in value or (Path(value).suffix and Path(value).is_file())
        if group == "data" and is_file:
            raise ConfigError(
                f"{override}: write the file as data.path={value}, and its layout as data=tidy or"
                " as another that cfx data describe names"
            )
        if group in {"model", "policy"} and is_file:
            raise ConfigError(
                f"{override}: choose a {kind} by its name; a finished policy, which brings its"
                f" model, is tested by protocol=transfer protocol.run={value}, in Python by"
                " cfx.evaluate"
            )
        if value == "null" or _is_number(value):
            raise ConfigError(
                f"{override}: choose a {kind} by its name, or leave it out; known:"
                f" {', '.join(registry.names(kind))}"
            )


def _is_number(text: str) -> bool:
    with contextlib.suppress(ValueError):
        return math.isfinite(float(text))
    return False


def explain(error: BaseException, overrides: Sequence[str]) -> str:
    """Returns one sentence (for several wrong keys, one each) that says what to write instead."""
    if isinstance(error, CfxError):
        return str(error)
    for cause in _chain(error):
        if not isinstance(cause, OSError) or isinstance(cause, HydraException):
            continue
        if cause.filename and cause.strerror:
            return (
                f"{cause.filename}: {cause.strerror}; choose an output folder that can be written"
                " with hydra.run.dir=FOLDER (multiruns: hydra.sweep.dir=FOLDER)"
            )
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.rpartition("/")
        if error.options is not None:
            return (
                f"{group}={name}: there is no {group} '{name}'.{advice(group, name, error.options)}"
            )
    if isinstance(error, OverrideParseException):
        return _unreadable(error)
    return _reworded(error, overrides)


def no_command(word: str) -> str:
    """Returns a sentence for a word that is neither an override nor a sub-command."""
    advised = advice("command", word, registry.names("command"))
    if ("command", word) in brought():
        return f"cfx {word.replace('.', ' ')} is not installed.{advised}"
    return f"{word}: neither key=value nor a sub-command.{advised} See cfx --help."


def _reworded(error: BaseException, overrides: Sequence[str]) -> str:
    """Returns Hydra's more frequent messages in other words, and the rest as they are."""
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


def _unreadable(error: OverrideParseException) -> str:
    word = error.override
    if "=" not in word:
        return no_command(word)
    detail = "syntax"
    for line in error.message.splitlines():
        if not line.startswith(("Error parsing", "See ")):
            detail = re.sub(r" expecting \{.*\}", "", line)
            break
    return (
        f"{word}: cannot be read as key=value ({detail});"
        " quote a value that holds special characters: key=\\'value\\'"
    )


def _unknown_key(key: str, overrides: Sequence[str]) -> str:
    """Returns a sentence with the keys that there are where `key` was looked for."""
    typed = _override_of(key, overrides)
    right = []  # as far as is known; composed alone, they say which keys there are
    for override in overrides:
        if override != typed:
            right.append(override)
    try:
        config: Any = hydra_source.composed(right)
    except Exception:  # the other overrides may be wrong too; the sentence is then without advice
        return f"{typed}: there is no key '{key}'; cfx --cfg job prints every key"
    node = OmegaConf.select(config, key)
    if isinstance(node, DictConfig):
        sentence = _unknown_name(key, typed, node, right)
        if sentence:
            return sentence
    parent, _, last = key.rpartition(".")
    siblings = config
    if parent:
        siblings = OmegaConf.select(config, parent)
    if isinstance(siblings, DictConfig):
        names = sorted(map(str, siblings))
        if "hydra" in names:  # Hydra's own node, beside those of the job
            names.remove("hydra")
        advice = nearest(last, names)
        heading = "Known keys"
        if parent:
            advice = advice.replace("'", f"'{parent}.", 1)
            heading = f"Known keys of {parent}"
        elsewhere = _options_with(parent, last, str(siblings.get("name", "")))
        return (
            f"{typed}: there is no key '{key}'.{elsewhere or advice} {heading}: {', '.join(names)}."
        )
    everything: Any = OmegaConf.to_container(config, resolve=False)
    paths = _keys(everything)
    return f"{typed}: there is no key '{key}'.{nearest(key, paths)} cfx --cfg job prints every key."


def _override_of(key: str, overrides: Sequence[str]) -> str:
    """Returns the override that sets a key; the key alone if none does."""
    of_key = re.compile(rf"\+*{re.escape(key)}\b")
    for override in overrides:
        if of_key.match(override):
            return override
    return key


def _unknown_name(key: str, typed: str, node: DictConfig, right: Sequence[str]) -> str:
    """Returns a sentence for a wrong name in the mapping that an override sets; "" for none.

    Args:
        key: of the override, `model.parameters` in `model.parameters={taw: 1}`.
        typed: the override.
        node: what there is at the key without this override.
        right: the other overrides.
    """
    mapping = OverridesParser.create().parse_override(typed).value()
    if not isinstance(mapping, dict):
        return ""
    unknown = [name for name in map(str, mapping) if name not in node]
    if not unknown:
        return ""
    sentence = _unknown_key(f"{key}.{unknown[0]}", right)
    if len(unknown) == len(mapping) and "Did you mean" not in sentence:
        _, _, value = typed.partition("=")
        sentence += f" To replace all of them: '~{key}' '+{key}={value}'"
    return sentence


def _options_with(group: str, setting: str, chosen: str) -> str:
    """Returns which other options of a group have a setting; "" if none has."""
    if group not in registry.GROUPS:
        return ""
    kind, options = registry.GROUPS[group].name, []
    for name in registry.names(kind):
        with contextlib.suppress(CfxError):  # a plugin that cannot be imported has none
            component = registry.get(kind, name)
            if setting in component.schema.model_fields:
                options.append(f"{group}={name}")
    if not options:
        return ""
    return f" {group}={chosen} has none; choose {listed(options)} too."


def _keys(values: Mapping[Any, Any], prefix: str = "") -> Iterator[str]:
    """Yields the path of every key of nested mappings."""
    for name, value in values.items():
        path = f"{prefix}{name}"
        yield path
        if isinstance(value, Mapping):
            yield from _keys(value, f"{path}.")


def _plain(error: BaseException) -> str:
    """Returns Hydra's own words, and those of the error behind it, on one line."""
    noise = ("object_type=", "See https://", "Config search path", "provider=")
    parts: list[str] = []
    for cause in _chain(error):
        lines = []
        for line in map(str.strip, str(cause).splitlines()):
            if line and not line.startswith(noise):
                lines.append(line)
        part = " ".join(lines)
        if part and part not in parts:
            parts.append(part)
    return ": ".join(parts) or f"{type(error).__name__} while composing the configuration"


def _chain(error: BaseException) -> Iterator[BaseException]:
    current: BaseException | None = error
    while current is not None:
        yield current
        current = current.__cause__

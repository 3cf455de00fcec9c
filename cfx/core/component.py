"""Base class of components: a class with typed settings that an entry point names."""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
from abc import ABC
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from cfx.errors import ConfigError, nearest

Schema = TypeVar("Schema", bound=BaseModel)

Values = TypeVar("Values", bound=Sequence[Any] | None)

API_VERSION = 1
"""Version of what plugins may use.

It rises only when a plugin that keeps to the public API would have to change.
"""


def each_once(values: Values) -> Values:
    """Returns the values; raises ValueError if one stands there twice."""
    earlier: list[Any] = []
    for value in () if values is None else values:
        if value in earlier:
            raise ValueError(f"{value!r} stands there twice; write each once")
        earlier.append(value)
    return values


Distinct = Annotated[Values, AfterValidator(each_once)]
"""A setting that lists values, each of which stands there once: `Distinct[tuple[float, ...]]`."""


class Settings(BaseModel):
    """Base of every component's settings: frozen, no unknown keys, no NaN or infinity.

    Give each field a `Field(description=...)` with its unit: the text becomes the comment in the
    config node and the line in `python -m cfx plugins show`.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False
    )

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_for_a_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuses true and false where a number is wanted; Python would take them for 1 and 0."""
        if isinstance(value, bool) and info.field_name is not None:
            kinds = _kinds(cls.model_fields[info.field_name].annotation)
            if bool not in kinds and kinds & {int, float}:
                raise ValueError("give a number, not true or false")
        return value


def _kinds(annotation: Any) -> set[Any]:
    """Returns the types that an annotation such as `int | None` names."""
    parts = get_args(annotation)
    if not parts:
        return {annotation}
    kinds = set()
    for part in parts:
        kinds |= _kinds(part)
    return kinds


class Component(ABC):
    """Base of every dataset, model, policy, optimizer and whatever else has a kind.

    Life cycle: the registry imports the class when a config names it, validates the config node
    against its `schema`, and calls the class with the result. Nothing else happens at construction:
    reading files, compiling and training wait for the first method call.

    Attributes:
        kind: as in `cfx.get(kind, name)`; the base class of each kind sets it.
        deprecated: what to use instead of a component that goes; jobs that name it log a warning.
        trial: settings with which `plugins check` tries the component, where trying it with the
            default ones takes long.
        process_code: stands for the code of a class that a program has added to the registry: no
            file says what it does, and no other process shares results of it.
        schema: class of its settings.
        settings: the validated settings.
    """

    kind: ClassVar[str]
    deprecated: ClassVar[str] = ""
    trial: ClassVar[Mapping[str, Any]] = {}
    process_code: ClassVar[str] = ""
    schema: ClassVar[type[Settings]] = Settings
    settings: Settings

    def __init__(self, settings: Settings | None = None, **options: Any) -> None:
        """Takes either a ready `Settings` object or its fields as keywords.

        Raises:
            ConfigError: a key is unknown or a value is wrong.
        """
        if settings is not None and options:
            raise TypeError("give either a Settings object or keyword options, not both")
        if settings is None:
            # A dataset's config group is `data`, as Hydra users expect; every other kind's is its
            # own name.
            group = "data" if self.kind == "dataset" else self.kind
            settings = validate(self.schema, options, where=group)
        self.settings = settings

    @classmethod
    def complaint(cls) -> str:
        """Returns what is wrong with what a class declares; "" if nothing is.

        It is the end of a sentence that begins with the component. Base classes of kinds say it.
        """
        return ""

    def identity(self) -> dict[str, Any]:
        """Returns what results of this component depend on: its class, its settings and its code.

        Cached results carry it. The code is every source file beside the one that defines the
        class, so that a changed equation is never answered from the cache.
        """
        return {
            "class": f"{type(self).__module__}.{type(self).__qualname__}",
            "settings": self.settings.model_dump(mode="json"),
            "code": self.process_code or folder_hash(inspect.getfile(type(self))),
        }


def content_key(description: Any) -> str:
    """Returns the SHA-256 of a description as JSON.

    Values that JSON does not know count as what `str` makes of them.
    """
    text = json.dumps(description, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def folder_hash(module_file: str) -> str:
    """Returns the SHA-256 of the Python files in the folder of a module."""
    digest = hashlib.sha256()
    for path in sorted(Path(module_file).parent.glob("*.py")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def validate(schema: type[Schema], values: Any, *, where: str) -> Schema:
    """Validates `values` against `schema`.

    Args:
        where: the config path that the error message starts with, such as `model`.

    Raises:
        ConfigError: one sentence for each wrong key, joined by newlines.
    """
    try:
        return schema.model_validate(values)
    except ValidationError as error:
        at: dict[tuple[str, ...], list[Any]] = {}
        for problem in error.errors():
            at.setdefault(_location(values, problem), []).append(problem)
        sentences = []
        for key in _one_a_mistake(at):
            sentences.append(_sentence(schema, key, at[key], where))
        raise ConfigError("\n".join(sentences)) from None


def _one_a_mistake(problems: Mapping[tuple[str, ...], Any]) -> Iterator[tuple[str, ...]]:
    """Yields the keys to complain of: of a list its first wrong item, not the list as a whole."""
    lists = set()
    above = set()  # keys of which a part is wrong, so that they need no complaint of their own
    for key in problems:
        for length in range(len(key)):
            above.add(key[:length])
    for key in problems:
        if key in above:
            continue
        if key and key[-1].isdecimal():
            if key[:-1] in lists:
                continue
            lists.add(key[:-1])
        yield key


def _location(values: Any, problem: Any) -> tuple[str, ...]:
    """Returns the keys that lead to a problem, without the names of a type's alternatives."""
    keys, inside = [], values
    for place, part in enumerate(problem["loc"]):
        is_item = isinstance(inside, list | tuple) and isinstance(part, int) and part < len(inside)
        if is_item or (isinstance(inside, Mapping) and part in inside):
            inside = inside[part]
        elif place > 0 and problem["type"] != "missing":
            continue
        keys.append(str(part))
    return tuple(keys)


def _sentence(
    schema: type[BaseModel], location: Sequence[str], problems: Sequence[Any], where: str
) -> str:
    """Returns what pydantic's errors at a key say: one, or one for each alternative of its type."""
    problem = problems[0]
    path = ".".join(filter(None, [where, *location]))
    if problem["type"] == "extra_forbidden":
        keys = sorted(_fields_at(schema, location[:-1]))
        text = f"{path}: unknown key.{nearest(location[-1], keys)}"
        if keys:
            text += f" Known keys: {', '.join(keys)}."
        return text
    if problem["type"] == "missing":
        return f"{path}: a value is required; give one as {path}=..."
    messages = []
    for alternative in problems:
        text = str(alternative["msg"]).removeprefix("Value error, ").removeprefix("Input ")
        if text not in messages:
            messages.append(text)
    message = ", or ".join(messages)
    if isinstance(problem["input"], Mapping):
        # Several settings contradict each other; the message names them.
        if message.startswith(path):
            return f"{message}."
        return f"{path}: {message}."
    return f"{path}={problem['input']!r}: {message}."


def _fields_at(schema: type[BaseModel], location: Sequence[str]) -> list[str]:
    """Returns the names of the settings at a path; nothing where no settings are."""
    current: Any = schema
    for part in location:
        field = getattr(current, "model_fields", {}).get(part)
        if field is None:
            return []
        current = field.annotation
    return list(getattr(current, "model_fields", {}))

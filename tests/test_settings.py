"""A setting that is accepted does something: at least, code reads it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel

from cfx.core import registry
from cfx.results.config import JobConfig

ROOT = Path(__file__).resolve().parent.parent

READ_OTHERWISE = {
    "failed_value": "Hydra's sweepers are told of it, before there is a JobConfig",
}
"""Settings that no code reads as an attribute, with the reason."""


def _leaves(schema: type[BaseModel]) -> Iterator[str]:
    """Yields the names of a schema's settings, those of settings within settings too."""
    for name, field in schema.model_fields.items():
        default = None
        if not field.is_required():
            default = field.get_default(call_default_factory=True, validated_data={})
        if isinstance(default, BaseModel):
            yield from _leaves(type(default))
        else:
            yield name


def test_every_setting_of_every_component_is_read() -> None:
    names = set(_leaves(JobConfig))
    for kind, about in registry.KINDS.items():
        if about.chosen:
            for entry in registry.entries(kind):
                names |= set(_leaves(registry.get(kind, entry.name).schema))
    texts = []
    for folder in ("cfx", "plugins"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            if "tests" not in path.parts:
                texts.append(path.read_text(encoding="utf-8"))
    read = set(re.findall(r"\.([A-Za-z_]\w*)", "\n".join(texts)))
    assert names - read == set(READ_OTHERWISE)

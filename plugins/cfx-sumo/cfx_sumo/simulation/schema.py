"""The car-following models and attributes that SUMO knows, read from the schema that comes with it.

SUMO takes an attribute that it does not know without a word, so that a misspelt one would be
calibrated without any effect.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from cfx.errors import ConfigError, SumoError, nearest
from cfx.plugin import VType, distributions
from cfx_sumo.installed import DISTRIBUTION

_XS = "{http://www.w3.org/2001/XMLSchema}"
_ELEMENT = "carFollowing-"

_OF_ALL = (
    "minGap",
    "maxSpeed",
    "desiredMaxSpeed",
    "speedFactor",
    "tau",
    "decel",
    "emergencyDecel",
    "apparentDecel",
    "collisionMinGapFactor",
    "actionStepLength",
    "hasDriverState",
    "startupDelay",
)
"""Attributes that matter to a follower whatever its model.

The schema lists them among all that a vehicle has.
"""


def check_vtype(kind: VType) -> None:
    """Checks that SUMO knows a vehicle type's model, and that this model reads its attributes.

    Raises:
        ConfigError: it does not; names the nearest that it knows.
        SumoError: SUMO's schema is not there.
    """
    attributes_of = car_following()
    name = kind.car_follow_model
    if name not in attributes_of:
        raise ConfigError(
            f"model.car_follow_model={name}: SUMO has no such car-following"
            f" model.{nearest(name, attributes_of)} Known: {', '.join(attributes_of)}."
        )
    for attribute in kind.attributes:
        if attribute not in attributes_of[name]:
            raise ConfigError(
                f"model: SUMO's {name} reads no attribute"
                f" '{attribute}'.{nearest(attribute, attributes_of[name])} Known:"
                f" {', '.join(sorted(attributes_of[name]))}."
            )


@functools.cache
def car_following() -> dict[str, frozenset[str]]:
    """Returns the vType attributes that each car-following model of the installed SUMO reads.

    Raises:
        SumoError: the schema is not there.
    """
    package = importlib.util.find_spec("sumo_data")
    folders = package.submodule_search_locations if package is not None else None
    for folder in folders or ():
        path = Path(folder, "data", "xsd", "types", "route.xsd")
        if path.is_file():
            return _read(path)
    raise SumoError(
        "SUMO's schema (the package sumo-data) is not there: "
        + distributions.install_line(DISTRIBUTION)
    )


def _read(path: Path) -> dict[str, frozenset[str]]:
    root = ElementTree.parse(path).getroot()  # noqa: S314 - SUMO's own file
    types = {element.get("name", ""): element for element in root.iter(f"{_XS}complexType")}
    models = {}
    for element in types["vTypeBaseType"].iter(f"{_XS}element"):
        name, kind = element.get("name", ""), element.get("type", "")
        if name.startswith(_ELEMENT):
            attributes = _attributes(types, kind) | set(_OF_ALL)
            models[name.removeprefix(_ELEMENT)] = frozenset(attributes)
    return models


def _attributes(types: Mapping[str, ElementTree.Element], name: str) -> set[str]:
    """Returns the attributes of a type and of those that it extends."""
    names = set()
    for element in types[name].iter(f"{_XS}attribute"):
        names.add(element.get("name", ""))
    for base in types[name].iter(f"{_XS}extension"):
        names |= _attributes(types, base.get("base", ""))
    return names

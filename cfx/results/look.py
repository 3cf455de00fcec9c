"""Colours that both backends share.

Colours are Okabe and Ito's (2008), and Tol's purple, told apart by readers with any colour vision.
A method has one colour in every figure; each backend gives it a dash, so that a grey print can be
read.
"""

from __future__ import annotations

COLOURS = {
    "real": "#000000",
    "leader": "#9a9a9a",
    "default": "#009e73",
    "population": "#aa4499",
    "fixed": "#0072b2",
    "shrunk": "#7a5c3e",
    "policy": "#d55e00",
    "constant_speed": "#bdbdbd",
    "constant_acceleration": "#666666",
    "population_residual": "#dba6d0",
    "fixed_residual": "#7fb8dc",
    "population_ar": "#661155",
    "fixed_ar": "#003f66",
    "policy_sampled": "#b8860b",
}
OTHER_COLOUR = "#777777"
"""A method of a protocol that cfx does not know."""

CLUSTER_COLOURS = ("#56b4e9", "#8c8c8c", "#e69f00")
"""Conservative, normal, aggressive: none of them a method's colour."""

TRAIN_COLOUR, VALIDATION_COLOUR = "#56b4e9", "#cc79a7"
COLLISION_COLOUR = "#d00000"
INK = "#333333"
PALE = "#e4e4e4"
BAND = "#f3f3f3"
EDGE = "#808080"

JOB_COLOURS = (
    "#332288",
    "#cc6677",
    "#117733",
    "#ddaa33",
    "#88ccee",
    "#882255",
    "#44aa99",
    "#999933",
    "#777777",
)
"""Tol's muted colours, told apart by readers with any colour vision, none a method's."""

_VEHICLES = (
    "#440154",
    "#482576",
    "#404588",
    "#34618d",
    "#297a8e",
    "#20928c",
    "#25ac82",
    "#4cc26c",
    "#86d549",
    "#cae11f",
)
"""The colour map viridis from dark to light."""


def colour_of(method: str) -> str:
    """Returns the colour of a method or of a recorded vehicle."""
    return COLOURS.get(method, OTHER_COLOUR)


def vehicle_colour(vehicle: int, vehicles: int) -> str:
    """Returns the colour of follower `vehicle` (1 and up) of `vehicles`, from dark to light."""
    place = (vehicle - 1) * (len(_VEHICLES) - 1) / max(vehicles - 1, 1)
    return _VEHICLES[round(place)]

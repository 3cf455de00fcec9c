"""Colours of figures and reports: of methods, clusters, jobs, and of what surrounds the data."""

from __future__ import annotations

__all__ = [
    "BAND",
    "CLUSTER_COLOURS",
    "COLLISION_COLOUR",
    "COLOURS",
    "EDGE",
    "INK",
    "JOB_COLOURS",
    "colour_of",
]
"""What plugins may use, as `cfx.plugin.colours`."""


COLOURS = {
    "real": "#000000",
    "leader": "#9a9a9a",
    "default": "#009e73",
    "pooled": "#aa4499",
    "driver_specific": "#0072b2",
    "shrunk": "#7a5c3e",
    "policy": "#d55e00",
    "constant_speed": "#bdbdbd",
    "constant_acceleration": "#666666",
    "pooled_residual": "#dba6d0",
    "driver_specific_residual": "#7fb8dc",
    "pooled_ar": "#661155",
    "driver_specific_ar": "#003f66",
    "policy_sampled": "#b8860b",
}
"""Colours of vehicles and methods that cfx knows; `colour_of` gives those of others too."""

OTHER_COLOUR = "#777777"
"""A method of a protocol that cfx does not know."""

CLUSTER_COLOURS = ("#56b4e9", "#8c8c8c", "#e69f00")
"""Conservative, normal, aggressive: none of them a method's colour."""

TRAIN_COLOUR = "#56b4e9"
"""Colour of losses on training data."""

VALIDATION_COLOUR = "#cc79a7"
"""Colour of losses on drivers that are kept for validation."""

COLLISION_COLOUR = "#d00000"
"""Colour of collisions."""

INK = "#333333"
"""Colour of labels and of lines at zero."""

PALE = "#e4e4e4"
"""Colour of the grid."""

BAND = "#f3f3f3"
"""Colour of areas behind the data, such as the range of recorded values."""

EDGE = "#808080"
"""Colour of the edges of axes and of lines of reference."""

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


def colour_of(method: str) -> str:
    """Returns the colour of a method or of a recorded vehicle."""
    return COLOURS.get(method, OTHER_COLOUR)

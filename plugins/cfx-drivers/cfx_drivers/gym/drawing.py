"""A picture of vehicles in a lane, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 720, 60
"""Of the picture, in pixels."""

_PIXELS_PER_M = 5
_ROAD, _LINE = (236, 239, 241), (158, 168, 176)
_LEADER, _EGO, _BEHIND = (38, 50, 56), (21, 101, 192), (239, 108, 0)


def picture(fronts: Sequence[float], lengths: Sequence[float]) -> NDArray[Any]:
    """Returns an RGB picture `(HEIGHT, WIDTH, 3)`, uint8; the ego stands in its middle.

    Args:
        fronts: front bumpers of the leader, the ego and the vehicles behind, m.
        lengths: of these vehicles, m.
    """
    image = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[:] = _ROAD
    image[[6, HEIGHT - 7]] = _LINE
    for number, (front, length) in enumerate(zip(fronts, lengths, strict=True)):
        ahead = (front - fronts[1]) * _PIXELS_PER_M + WIDTH / 2
        right = min(max(round(ahead), 0), WIDTH)
        left = min(max(round(ahead - length * _PIXELS_PER_M), 0), WIDTH)
        colour = (_LEADER, _EGO, _BEHIND)[min(number, 2)]
        image[HEIGHT // 2 - 5 : HEIGHT // 2 + 5, left:right] = colour
    return image

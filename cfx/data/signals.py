"""Signals: what is measured of a follower and of their surroundings, declared once.

`SIGNALS` are those that every recording gives. A further one, such as the rain or a second vehicle
ahead, is a `Signal` that an input of policies declares (`cfx.plugin.PolicyInput.signals`); readers
take it from its column, and it is given over time wherever a follower is simulated. What a signal
is measured in, how it is scaled, continued beyond the end of a recording and moved along with a
simulated follower follows from its `quantity`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from cfx.core import registry
from cfx.errors import PluginError

if TYPE_CHECKING:
    from torch import Tensor

Quantity = Literal["position", "gap", "speed", "acceleration", "other"]
"""What kind of number a signal is.

`position` is along the lane, `gap` the distance from the follower's front bumper to something
ahead: it shrinks as the follower moves on. All but `other` are multiplied by `data.scale`.
"""


@dataclass(frozen=True)
class Signal:
    """One signal over time.

    Attributes:
        name: of the signal, as inputs of policies and drivers elsewhere call it.
        unit: SI; "" for a number without one.
        meaning: in a few words.
        column: of the tidy layout.
        quantity: what kind of number it is.
        belongs_to: `follower`, whose signals are simulated in closed loop, or the `surroundings`,
            whose signals are given over time.
        low, high: the range that is physically possible; a recording outside is refused.

    Raises:
        PluginError: the range is empty, or there is no name or column.
    """

    name: str
    unit: str
    meaning: str
    column: str
    quantity: Quantity = "other"
    belongs_to: Literal["follower", "surroundings"] = "surroundings"
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        if not self.name.isidentifier() or not self.column:
            raise PluginError(
                f"signal '{self.name}': give it a name of letters, digits and _, and the column of"
                " the tidy layout that holds it"
            )
        if not self.low < self.high:
            raise PluginError(f"signal '{self.name}': low={self.low:g} is not below {self.high:g}")

    @property
    def is_scaled(self) -> bool:
        """Whether it grows with distances and speeds (`data.scale`)."""
        return self.quantity != "other"

    def seen_from(self, position: Tensor, stored: Tensor) -> Tensor:
        """Returns the signal as a follower at a position sees it.

        Args:
            position: of the follower's front bumper, `(*batch, T)`, m.
            stored: as `PairBatch.surroundings` stores it, `(*batch, T)`: of a gap, the position of
                what is ahead.
        """
        if self.quantity == "gap":
            return stored - position
        return stored


def _by_name(*signals: Signal) -> dict[str, Signal]:
    return {signal.name: signal for signal in signals}


SIGNALS = _by_name(
    Signal("leader_position", "m", "the leader's front bumper", "leader_position_m", "position"),
    Signal("leader_speed", "m/s", "the leader's speed", "leader_speed_mps", "speed", low=0),
    Signal(
        "leader_acceleration",
        "m/s2",
        "the leader's acceleration",
        "leader_acceleration_mps2",
        "acceleration",
    ),
    Signal(
        "follower_position",
        "m",
        "the follower's front bumper",
        "follower_position_m",
        "position",
        "follower",
    ),
    Signal(
        "follower_speed",
        "m/s",
        "the follower's speed",
        "follower_speed_mps",
        "speed",
        "follower",
        low=0,
    ),
    Signal(
        "follower_acceleration",
        "m/s2",
        "the follower's acceleration",
        "follower_acceleration_mps2",
        "acceleration",
        "follower",
    ),
    Signal("gap", "m", "to the leader, bumper to bumper", "gap_m", "gap", "follower"),
)
"""The signals of every recording, by name."""

RECORDED = tuple(name for name in SIGNALS if name != "gap")
"""Those that are stored; the gap follows from positions and the leader's length."""

OBSERVED = (
    "leader_speed",
    "leader_acceleration",
    "follower_speed",
    "follower_acceleration",
    "gap",
)
"""Those that policies observe. Positions are not among them: a policy drives alike on every road.

The order is that of the states which drivers elsewhere keep (`DriverState.history`)."""


def declared_by(name: str) -> tuple[Signal, ...]:
    """Returns the signals that an input of policies reads, by its name.

    Raises:
        PluginError: no such input is installed, or it cannot be loaded.
    """
    declared: Any = registry.get("input", name)
    signals: tuple[Signal, ...] = declared.signals
    return signals


def further_signals(signals: Iterable[Signal]) -> tuple[Signal, ...]:
    """Returns the signals that are not `SIGNALS`, each once, in order.

    Raises:
        PluginError: two different signals share a name or a column, one redefines a signal of every
            recording, or is said to be simulated.
    """
    chosen: dict[str, Signal] = {}
    columns = {signal.column: signal for signal in SIGNALS.values()}
    for signal in signals:
        if SIGNALS.get(signal.name) == signal:
            continue
        other = chosen.get(signal.name) or SIGNALS.get(signal.name) or columns.get(signal.column)
        if other is not None and other != signal:
            raise PluginError(
                f"the signal '{signal.name}' (column {signal.column}) is declared in two ways, also"
                f" as '{other.name}' (column {other.column}); give one of them another name and"
                " column"
            )
        if signal.belongs_to == "follower" or signal.quantity == "position":
            raise PluginError(
                f"the signal '{signal.name}' must belong to the surroundings and be no position:"
                " what the follower does is simulated, from the signals of every recording"
            )
        chosen[signal.name] = signal
        columns[signal.column] = signal
    return tuple(chosen.values())

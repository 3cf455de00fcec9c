"""One pair over time: speed, gap and the parameters of each method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cfx.plots.choice.common import Array, finite, without_infinity
from cfx.plots.words import label, number, short_label, unit_label

if TYPE_CHECKING:
    from cfx.evaluation.result import Evaluation, PairTrajectory

HIDDEN = frozenset({"shrunk"})
"""Methods whose lines are left out at first: with one more nobody tells the lines apart."""

TIME_TITLE = "time from the start of the pair (s)"

_ROOM = 1.5
"""The default may stretch an axis by so many times the range of the other lines, on either side."""


@dataclass(frozen=True)
class Line:
    """A signal.

    Attributes:
        method: whose it is: a method, `real` or `leader`.
        time: `(T,)` s.
        values: `(T,)`, NaN where there is none.
        steps: whether a value holds until the next frame.
    """

    method: str
    time: Array
    values: Array
    steps: bool = False

    @property
    def hidden(self) -> bool:
        """Whether it is left out until a reader asks for it."""
        return self.method in HIDDEN


@dataclass(frozen=True)
class Note:
    """A remark inside a panel, at its upper end or at its lower end."""

    text: str
    method: str
    above: bool


@dataclass(frozen=True)
class Collision:
    """Where a simulated gap first becomes negative."""

    method: str
    time: float
    gap: float

    @property
    def text(self) -> str:
        """What stands beside the symbol."""
        return f"{short_label(self.method)} collides"


@dataclass(frozen=True)
class Panel:
    """Lines on common axes.

    Attributes:
        title: what is shown, with its unit.
        lines: those that are drawn, the hidden ones too.
        low, high: ends of the vertical axis; None where nothing is known of them.
        notes: remarks.
        collisions: of a gap.
        bounds: of a parameter, if they are known.
        meaning: of a parameter, in words.
    """

    title: str
    lines: tuple[Line, ...]
    low: float | None
    high: float | None
    notes: tuple[Note, ...] = ()
    collisions: tuple[Collision, ...] = ()
    bounds: tuple[float, float] | None = None
    meaning: str = ""


@dataclass(frozen=True)
class ParameterAxis:
    """A tuned parameter: its name, its unit, and the bounds within which policies choose.

    `meaning` says in words what it is.
    """

    name: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    meaning: str = ""


def parameter_axes(evaluation: Evaluation) -> tuple[ParameterAxis, ...]:
    """Returns the tuned parameters of an evaluation."""
    lows, highs = evaluation.bounds
    meanings = evaluation.meanings or ("",) * len(evaluation.names)
    axes = []
    for k, name in enumerate(evaluation.names):
        low, high = float(lows[k]), float(highs[k])
        axes.append(ParameterAxis(name, evaluation.units[k], low, high, meanings[k]))
    return tuple(axes)


@dataclass(frozen=True)
class PairPanels:
    """What is shown of one pair.

    Attributes:
        pair_id: which pair.
        speed, gap: over the test part.
        parameters: a panel for each tuned parameter.
    """

    pair_id: str
    speed: Panel
    gap: Panel
    parameters: tuple[Panel, ...]


def pair_panels(
    trajectory: PairTrajectory, methods: Sequence[str], parameters: Sequence[ParameterAxis]
) -> PairPanels:
    """Chooses the panels of one pair.

    Args:
        trajectory: the pair.
        methods: those to show, in their order; what a trajectory lacks is left out.
        parameters: in the order in which the trajectory has them.
    """
    time = trajectory.time
    present = [method for method in methods if method in trajectory.speed]
    speed_lines = [_line("leader", time, trajectory.leader_speed)]
    speed_lines += _lines(time, trajectory.real_speed, trajectory.speed, present)
    gap_lines = _lines(time, trajectory.real_gap, trajectory.gap, present)
    panels = []
    for k, parameter in enumerate(parameters):
        lines = []
        for method in present:
            values = without_infinity(trajectory.parameters[method][:, k])
            lines.append(Line(method, time, values, steps=True))
        panels.append(_parameter_panel(parameter, tuple(lines)))
    return PairPanels(
        trajectory.pair_id,
        _signal_panel("speed", "m/s", tuple(speed_lines)),
        _signal_panel("gap", "m", tuple(gap_lines), _collisions(gap_lines)),
        tuple(panels),
    )


def method_panels(
    trajectory: PairTrajectory, methods: Sequence[str], errors: Mapping[str, float]
) -> tuple[Panel, ...]:
    """Chooses a panel per method: its speed against the real driver's.

    Args:
        trajectory: the pair.
        methods: those to show.
        errors: by method, RMSE of speed, m/s.
    """
    panels = []
    for method in methods:
        lines = (
            _line("real", trajectory.time, trajectory.real_speed),
            _line(method, trajectory.time, trajectory.speed[method]),
        )
        low, high = _range(lines)
        title = f"{label(method)}: RMSE of speed {errors[method]:.3f} m/s"
        panels.append(Panel(title, lines, low, high))
    return tuple(panels)


def errors_text(what: str, unit: str, errors: Mapping[str, float]) -> str:
    """Returns a title such as "RMSE of speed (m/s): default 1.02, policy 0.31".

    Args:
        what: the signal.
        unit: of the errors.
        errors: by method; hidden methods are left out.
    """
    listed = []
    for method, error in errors.items():
        if method not in HIDDEN:
            value = f"{error:.2f}" if np.isfinite(error) else "none"
            listed.append(f"{short_label(method)} {value}")
    return f"RMSE of {what} ({unit}): {', '.join(listed)}"


def _line(method: str, time: Array, values: Array) -> Line:
    return Line(method, time, without_infinity(values))


def _lines(
    time: Array, real: Array, simulated: Mapping[str, Array], methods: Sequence[str]
) -> list[Line]:
    lines = [_line("real", time, real)]
    for method in methods:
        lines.append(_line(method, time, simulated[method]))
    return lines


def _signal_panel(
    name: str, unit: str, lines: tuple[Line, ...], collisions: tuple[Collision, ...] = ()
) -> Panel:
    """Chooses the axis by the lines that matter; a note says how far a default lies off them."""
    low, high = _range(tuple(line for line in lines if line.method != "default"))
    notes: list[Note] = []
    if low is not None and high is not None:
        far = finite(np.concatenate([np.empty(0), *_of("default", lines)]))
        height = max(high - low, 1.0)
        lowest, highest = low - _ROOM * height, high + _ROOM * height
        if len(far):
            least, most = float(far.min()), float(far.max())
            if most > highest:
                notes.append(Note(f"default up to {number(most)} {unit} ↑", "default", above=True))
            if least < lowest:
                text = f"default down to {number(least)} {unit} ↓"
                notes.append(Note(text, "default", above=False))
            low, high = min(low, max(least, lowest)), max(high, min(most, highest))
        low, high = low - 0.06 * height, high + 0.06 * height
    title = unit_label(name, unit)
    return Panel(title, lines, low, high, tuple(notes), collisions)


def _of(method: str, lines: Sequence[Line]) -> list[Array]:
    return [line.values for line in lines if line.method == method]


def _range(lines: Sequence[Line]) -> tuple[float | None, float | None]:
    """Returns the lowest and the highest value of the lines that are not hidden; None for none."""
    seen = [line.values for line in lines if not line.hidden]
    values = finite(np.concatenate([np.empty(0), *seen]))
    if not len(values):
        return None, None
    return float(values.min()), float(values.max())


def _collisions(lines: Sequence[Line]) -> tuple[Collision, ...]:
    found = []
    for line in lines:
        hit = np.flatnonzero(line.values < 0)
        if line.method != "real" and not line.hidden and len(hit):
            first = int(hit[0])
            found.append(Collision(line.method, float(line.time[first]), float(line.values[first])))
    return tuple(found)


def _parameter_panel(parameter: ParameterAxis, lines: tuple[Line, ...]) -> Panel:
    """Chooses an axis of at least a fifth of the range: a small change looks small."""
    title, said = unit_label(parameter.name, parameter.unit), parameter.meaning
    lowest, highest = _range(lines)
    if parameter.low is None or parameter.high is None:
        if lowest is None or highest is None:
            return Panel(title, lines, None, None, meaning=said)
        margin = 0.15 * max(highest - lowest, 1e-3 * abs(highest), 1e-6)
        return Panel(title, lines, lowest - margin, highest + margin, meaning=said)
    bounds = (parameter.low, parameter.high)
    if lowest is None or highest is None:
        lowest, highest = bounds
    width = max(1.3 * (highest - lowest), 0.2 * (bounds[1] - bounds[0]))
    centre, margin = (highest + lowest) / 2, 0.06 * width
    low = max(centre - width / 2, min(bounds[0], lowest)) - margin
    high = min(centre + width / 2, max(bounds[1], highest)) + margin
    return Panel(title, lines, low, high, bounds=bounds, meaning=said)


def bounds_text(panel: Panel) -> str:
    """Returns a panel's title with the parameter's bounds, if they are known."""
    if panel.bounds is None:
        return panel.title
    return f"{panel.title}, {number(panel.bounds[0])} to {number(panel.bounds[1])}"

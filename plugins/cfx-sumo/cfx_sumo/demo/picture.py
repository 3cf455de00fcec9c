"""Pictures of the demonstration: the road from above at three moments, speeds and gaps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Patch
from matplotlib.transforms import Affine2D

from cfx.plugin import Evaluation, Result, canvas, colours, drawing, pair_lines, wording
from cfx_sumo.demo.motorway import Motorway
from cfx_sumo.demo.replay import CAR_LENGTH, FOLLOWERS
from cfx_sumo.demo.simulated import Array, SimulatedPair

_ASPHALT, _PAINT, _GRASS = "#6b7178", "#f4f4f4", "#e9eee4"
_CAR_WIDTH = 1.9  # m
_MOMENTS = 3


def write_pictures(
    folder: Path, road: Motorway, simulated: Sequence[SimulatedPair], evaluation: Evaluation
) -> list[Path]:
    """Writes `demo.png` and `demo_drives.png`.

    Args:
        folder: where to.
        road: where the pairs were.
        simulated: the pairs, from the best to the worst improvement; the one in the middle is the
            picture's.
        evaluation: of these pairs, as they were simulated in SUMO.

    Raises:
        OutputError: a file cannot be written.
    """
    middle = simulated[len(simulated) // 2]
    together = [drive for drive in simulated if drive.scene == middle.scene]
    picture = drawing.write_figure(snapshots(road, middle, together), folder / "demo.png")
    trajectories = pair_lines.drives(
        Result.of(evaluation), [drive.pair.pair_id for drive in simulated]
    )
    return [picture, drawing.write_figure(trajectories, folder / "demo_drives.png")]


@canvas.styled
def snapshots(road: Motorway, main: SimulatedPair, together: Sequence[SimulatedPair]) -> Figure:
    """The road from above, driving upwards, at three moments.

    Each follower has a lane, behind its own copy of the leader.

    Args:
        road: where the pairs were.
        main: the pair in the middle of the picture.
        together: all pairs that were on the road with it, itself among them.
    """
    frames = np.linspace(main.first, len(main.pair) - 1, _MOMENTS).round().astype(int)
    span = max(_reach(main, int(frame)) for frame in frames) + 4 * CAR_LENGTH
    width = max(26.0, 0.4 * span)
    figure = canvas.blank(1.3 + 2.9 * span / width, width=9.0)
    for axes, frame in zip(figure.subplots(1, _MOMENTS), frames, strict=True):
        view = _View.of(main, together, int(frame), width)
        _draw_road(axes, road, view)
        for drive in together:
            _draw_pair(axes, drive, int(frame), view, named=drive is main)
        title = "the models take over"
        if frame > main.first:
            title = f"after {(frame - main.first) * main.pair.dt:.0f} s"
        axes.set_title(title, fontsize=10.5)
        axes.set(xlim=(-view.width / 2, view.width / 2), ylim=(-span / 2, span / 2), aspect="equal")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.grid(visible=False)
        axes.spines[["left", "bottom"]].set_visible(False)
    handles = []
    for kind in ("leader", *FOLLOWERS):
        handles.append(Patch(color=colours.COLOURS[kind], label=wording.method_label(kind)))
    name = wording.shortened(main.pair.pair_id, 50)
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles),
        title=f"In SUMO: pair {name}, each follower behind its own copy of the leader",
        title_fontsize=11,
    )
    return figure


def _reach(one: SimulatedPair, frame: int) -> float:
    """Returns how far the last follower is behind the leader, m, front to front."""
    return max(float(one.gap[kind][frame]) for kind in FOLLOWERS) + one.pair.leader_length


class _View:
    """Turns SUMO's coordinates so that a pair drives upwards in the middle."""

    def __init__(self, centre: Array, heading: float, width: float) -> None:
        self.width = width
        turn = np.radians(heading)
        forward = np.array([np.sin(turn), np.cos(turn)])
        self._axes = np.stack([[forward[1], -forward[0]], forward])
        self._centre = centre
        self.heading = heading

    @classmethod
    def of(
        cls, one: SimulatedPair, together: Sequence[SimulatedPair], frame: int, width: float
    ) -> _View:
        """Looks at all lanes that are used, and along them at one pair."""
        vehicles = np.stack([one.place[kind][frame] for kind in FOLLOWERS])
        leader = vehicles[:, 0].mean(axis=0)
        last = vehicles[np.argmax([one.gap[kind][frame] for kind in FOLLOWERS]), 1]
        along = cls((leader[:2] + last[:2]) / 2, float(leader[2]), width)
        beside = []
        for other in together:
            moment = min(frame, len(other.pair) - 1)
            for kind in FOLLOWERS:
                beside.append(other.place[kind][moment, 0, :2])
        along._centre = along._centre + along._axes[0] * along(np.stack(beside))[:, 0].mean()
        return along

    def __call__(self, points: Array) -> Array:
        """Turns `(..., 2)`."""
        turned: Array = (points - self._centre) @ self._axes.T
        return turned


def _draw_road(axes: Axes, road: Motorway, view: _View) -> None:
    axes.set_facecolor(_GRASS)
    for grow, colour in ((0.5, _PAINT), (0.05, _ASPHALT)):
        for lane in road.lanes:
            middle, half = view(lane.shape), (lane.width + grow) / 2
            left, right = _aside(middle, half), _aside(middle, -half)
            x, y = np.concatenate([left, right[::-1]]).T
            axes.fill(x, y, color=colour, linewidth=0, zorder=1)
    for lane in road.lanes:
        if lane.inner:
            x, y = _aside(view(lane.shape), lane.width / 2).T
            axes.plot(x, y, color=_PAINT, linewidth=1.0, dashes=(6, 8), zorder=2)


def _aside(line: Array, distance: float) -> Array:
    """Returns a line shifted to its left, m."""
    along = np.gradient(line, axis=0)
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return np.asarray(line + distance * left / length)


def _draw_pair(axes: Axes, one: SimulatedPair, frame: int, view: _View, *, named: bool) -> None:
    if frame >= len(one.pair):
        return
    for kind in FOLLOWERS:
        leader, follower = one.place[kind][frame]
        shade = 1.0 if named else 0.45
        _car(axes, leader, one.pair.leader_length, colours.COLOURS["leader"], view, shade)
        _car(axes, follower, CAR_LENGTH, colours.COLOURS[kind], view, shade)
        front, rear = view(follower[:2]), view(leader[:2]) - [0, one.pair.leader_length]
        axes.plot(
            [front[0], rear[0]],
            [front[1], rear[1]],
            color="white",
            linewidth=1.2,
            alpha=shade,
            zorder=3,
        )
        if named:
            distance = f"{one.gap[kind][frame]:.1f} m".replace("-", "\N{MINUS SIGN}")
            axes.text(
                front[0],
                front[1] - CAR_LENGTH - 0.8,
                distance,
                ha="center",
                va="top",
                fontsize=6.5,
                color=colours.INK,
                zorder=6,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 0.6},
                clip_on=True,
            )


def _car(axes: Axes, place: Array, length: float, colour: str, view: _View, shade: float) -> None:
    box = FancyBboxPatch(
        (-_CAR_WIDTH / 2, -length),
        _CAR_WIDTH,
        length,
        boxstyle="round,pad=0,rounding_size=0.6",
        facecolor=colour,
        edgecolor="white",
        linewidth=0.8,
        alpha=shade,
        zorder=5,
    )
    turn = Affine2D().rotate_deg(view.heading - float(place[2])).translate(*view(place[:2]))
    box.set_transform(turn + axes.transData)
    axes.add_patch(box)

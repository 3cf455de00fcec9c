"""Pictures of the demonstration: the road from above at three moments, and speeds and gaps over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Patch
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from cfx.evaluation.result import Evaluation
from cfx.plots.look import COLOURS, INK
from cfx.plots.matplotlib import figures
from cfx.plots.matplotlib.canvas import canvas, styled
from cfx.plots.matplotlib.write import write_figure
from cfx.plots.words import LABELS, short
from cfx.sumo.motorway import Motorway
from cfx.sumo.replay import FOLLOWERS
from cfx.sumo.shown import CAR_LENGTH, Shown

Array = NDArray[np.float64]

_ASPHALT, _PAINT, _GRASS = "#6b7178", "#f4f4f4", "#e9eee4"
_CAR_WIDTH = 1.9  # m
_MOMENTS = 3


def write_pictures(
    folder: Path, road: Motorway, shown: Sequence[Shown], evaluation: Evaluation
) -> list[Path]:
    """Writes `demo.png` and `demo_drives.png`.

    Args:
        folder: where to.
        road: where they drove.
        shown: the pairs, from the best to the worst improvement; the one in the middle is the picture's.
        evaluation: of these pairs, as they drove in SUMO.

    Raises:
        OutputError: a file cannot be written.
    """
    middle = shown[len(shown) // 2]
    together = [one for one in shown if one.scene == middle.scene]
    return [
        write_figure(snapshots(road, middle, together), folder / "demo.png"),
        write_figure(
            figures.pairs(evaluation, [one.pair.pair_id for one in shown]),
            folder / "demo_drives.png",
        ),
    ]


@styled
def snapshots(road: Motorway, main: Shown, together: Sequence[Shown]) -> Figure:
    """The road from above, driving upwards, at three moments: a lane for each follower, each behind its copy of the leader.

    Args:
        road: where they drove.
        main: the pair in the middle of the picture.
        together: all pairs that were on the road with it, itself among them.
    """
    frames = np.linspace(main.first, len(main.pair) - 1, _MOMENTS).round().astype(int)
    span = max(_reach(main, int(frame)) for frame in frames) + 4 * CAR_LENGTH
    width = max(26.0, 0.4 * span)
    figure = canvas(1.3 + 2.9 * span / width, width=9.0)
    for axes, frame in zip(figure.subplots(1, _MOMENTS), frames, strict=True):
        view = _View.of(main, together, int(frame), width)
        _draw_road(axes, road, view)
        for one in together:
            _draw_pair(axes, one, int(frame), view, named=one is main)
        seconds = (frame - main.first) * main.pair.dt
        axes.set_title(
            f"{seconds:.0f} s after the drivers took over" if seconds else "the drivers take over",
            fontsize=10.5,
        )
        axes.set(xlim=(-view.width / 2, view.width / 2), ylim=(-span / 2, span / 2), aspect="equal")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.grid(visible=False)
        axes.spines[["left", "bottom"]].set_visible(False)
    figure.legend(
        handles=[Patch(color=COLOURS[kind], label=LABELS[kind]) for kind in ("leader", *FOLLOWERS)],
        loc="outside upper center",
        ncols=len(FOLLOWERS) + 1,
        title=f"In SUMO: pair {short(main.pair.pair_id, 60)}, each follower behind its own copy of the leader",
        title_fontsize=11,
    )
    return figure


def _reach(one: Shown, frame: int) -> float:
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
    def of(cls, one: Shown, together: Sequence[Shown], frame: int, width: float) -> _View:
        """Looks at all lanes that are used, and along them at one pair."""
        vehicles = np.stack([one.place[kind][frame] for kind in FOLLOWERS])
        leader = vehicles[:, 0].mean(axis=0)
        last = vehicles[np.argmax([one.gap[kind][frame] for kind in FOLLOWERS]), 1]
        along = cls((leader[:2] + last[:2]) / 2, float(leader[2]), width)
        beside = np.stack(
            [
                other.place[kind][min(frame, len(other.pair) - 1), 0, :2]
                for other in together
                for kind in FOLLOWERS
            ]
        )
        along._centre = along._centre + along._axes[0] * along(beside)[:, 0].mean()
        return along

    def __call__(self, points: Array) -> Array:
        """Turns `(..., 2)`."""
        turned: Array = (points - self._centre) @ self._axes.T
        return turned


def _draw_road(axes: Axes, road: Motorway, view: _View) -> None:
    axes.set_facecolor(_GRASS)
    for grow, colour in ((0.5, _PAINT), (0.05, _ASPHALT)):
        for lane in road.lanes:
            left, right = (
                _aside(view(lane.shape), side * (lane.width + grow) / 2) for side in (1, -1)
            )
            axes.fill(*np.concatenate([left, right[::-1]]).T, color=colour, linewidth=0, zorder=1)
    for lane in road.lanes:
        if lane.inner:
            axes.plot(
                *_aside(view(lane.shape), lane.width / 2).T,
                color=_PAINT,
                linewidth=1.0,
                dashes=(6, 8),
                zorder=2,
            )


def _aside(line: Array, distance: float) -> Array:
    """Returns a line shifted to its left, m."""
    along = np.gradient(line, axis=0)
    normal = (
        np.stack([-along[:, 1], along[:, 0]], 1)
        / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    )
    return np.asarray(line + distance * normal)


def _draw_pair(axes: Axes, one: Shown, frame: int, view: _View, *, named: bool) -> None:
    if frame >= len(one.pair):
        return
    for kind in FOLLOWERS:
        leader, follower = one.place[kind][frame]
        shade = 1.0 if named else 0.45
        _car(axes, leader, one.pair.leader_length, COLOURS["leader"], view, shade)
        _car(axes, follower, CAR_LENGTH, COLOURS[kind], view, shade)
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
            label = f"{one.gap[kind][frame]:.1f} m".replace("-", "\N{MINUS SIGN}")
            axes.text(
                front[0],
                front[1] - CAR_LENGTH - 0.8,
                label,
                ha="center",
                va="top",
                fontsize=7.5,
                color=INK,
                zorder=6,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.2},
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

"""The animation: one HTML file with the road, the vehicles, their plots and scripts in it."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cfx.plugin import Agent, Evaluation, Result, colours, files, wording
from cfx_report.inline import embedded_json, inline_scripts, security_policy
from cfx_sumo.demo.motorway import Motorway
from cfx_sumo.demo.replay import CAR_LENGTH, FOLLOWERS
from cfx_sumo.demo.simulated import Array, SimulatedPair

_ASSETS = resources.files("cfx_sumo") / "assets"


def write_page(
    path: Path,
    road: Motorway,
    simulated: Sequence[SimulatedPair],
    evaluation: Evaluation,
    policy: Agent,
    source: str,
) -> Path:
    """Writes the page; returns its path.

    Args:
        path: the file; what was there is replaced once the new page is complete.
        road: where the pairs were.
        simulated: the pairs.
        evaluation: of these pairs, as they were simulated in SUMO.
        policy: what chose the parameters.
        source: where the recordings come from.

    Raises:
        OSError: the page cannot be written.
    """
    page = render(road, simulated, evaluation, policy, source)
    with files.atomic_write(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return path


def render(
    road: Motorway,
    simulated: Sequence[SimulatedPair],
    evaluation: Evaluation,
    policy: Agent,
    source: str,
) -> str:
    """Returns the page as HTML."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    scripts = inline_scripts([_asset("demo.js")])
    rows: list[Any] = []
    for drive in simulated:
        rows += drive.table.to_dict("records")
    plots = _plots(evaluation)
    vehicles = ("leader", *FOLLOWERS)
    return environment.from_string(_asset("demo.html.j2")).render(
        security=security_policy(scripts),
        scripts=scripts,
        style=_asset("demo.css"),
        colours={kind: colours.COLOURS[kind] for kind in vehicles},
        labels={kind: wording.method_label(kind) for kind in vehicles},
        content=embedded_json(_content(road, simulated, plots)),
        simulated=simulated,
        plots=plots,
        rows=rows,
        model=policy.model_node["name"],
        policy=policy.policy_node["name"],
        windows=policy.windows,
        dt=policy.dt,
        source=Path(source).name,
        count=len(simulated),
    )


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


def _content(
    road: Motorway, simulated: Sequence[SimulatedPair], plots: Sequence[_Plot]
) -> dict[str, Any]:
    """Returns what the script draws.

    Positions are centimetres from a corner of the road, so that they are short integers.
    """
    corner = np.concatenate([lane.shape for lane in road.lanes]).min(axis=0)
    pairs = []
    for drive, plot in zip(simulated, plots, strict=True):
        pairs.append(_pair(drive, corner) | {"axes": plot.axes})
    lanes = []
    for lane in road.lanes:
        shape = _rounded(100 * (lane.shape - corner))
        lanes.append({"width": lane.width, "inner": lane.inner, "shape": shape})
    return {
        "colours": {kind: colours.COLOURS[kind] for kind in ("leader", *FOLLOWERS)},
        "labels": {kind: wording.method_label(kind) for kind in FOLLOWERS},
        "followers": FOLLOWERS,
        "carLength": CAR_LENGTH,
        "lanes": lanes,
        "pairs": pairs,
    }


def _pair(drive: SimulatedPair, corner: Array) -> dict[str, Any]:
    speed, gap, place = {}, {}, {}
    for kind in FOLLOWERS:
        speed[kind] = _rounded(100 * drive.speed[kind])
        gap[kind] = _rounded(100 * drive.gap[kind])
        # Centimetres and tenths of a degree.
        position, heading = drive.place[kind][..., :2], drive.place[kind][..., 2:]
        place[kind] = _rounded(np.concatenate([100 * (position - corner), 10 * heading], axis=-1))
    return {
        "id": drive.pair.pair_id,
        "scene": drive.scene,
        "dt": drive.pair.dt,
        "first": drive.first,
        "leaderLength": drive.pair.leader_length,
        "speed": speed,
        "gap": gap,
        "place": place,
    }


class _Plot(NamedTuple):
    """Speeds, gaps and parameters of a pair, and where their axes lie.

    Attributes:
        svg: the `svg` element.
        label: for readers who do not see it.
        axes: of each panel left, top, width and height as shares of the figure, and the seconds at
            its ends.
    """

    svg: str
    label: str
    axes: list[list[float]]


def _plots(evaluation: Evaluation) -> list[_Plot]:
    """Draws each pair; the axes' places are where the page puts its line of time."""
    from cfx.plugin import pair_lines  # pair_lines
    from cfx_report.inline import PLACE, inline_svg

    result = Result.of(evaluation)
    plots = []
    for k, trajectory in enumerate(evaluation.trajectories):
        figure = pair_lines.draw_pair(result, trajectory.pair_id)
        svg = inline_svg(figure).replace(PLACE, f"plot-{k}-")
        axes = []
        for panel in figure.axes:
            box, (begin, end) = panel.get_position(), panel.get_xlim()
            numbers = (box.x0, 1 - box.y1, box.width, box.height, begin, end)
            axes.append([round(float(number), 4) for number in numbers])
        plots.append(_Plot(svg, f"Speed, gap and parameters of pair {trajectory.pair_id}", axes))
    return plots


def _rounded(values: Array) -> list[Any]:
    rounded: list[Any] = np.round(np.nan_to_num(values)).astype(int).tolist()
    return rounded

"""The animation: one HTML file with the road, the drives, their plots and scripts in it."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from cfx.agents.agent import Agent
from cfx.evaluation.result import Evaluation
from cfx.files import atomic_write
from cfx.plots.choice.trajectories import pair_panels, parameter_axes
from cfx.plots.look import COLOURS
from cfx.plots.plotly.figure import Plot
from cfx.plots.plotly.trajectories import pair_plot
from cfx.plots.words import LABELS
from cfx.sumo.motorway import Motorway
from cfx.sumo.replay import CAR_LENGTH, FOLLOWERS
from cfx.sumo.shown import Array, Shown

_ASSETS = resources.files("cfx.sumo") / "assets"


def write_page(
    path: Path,
    road: Motorway,
    shown: Sequence[Shown],
    evaluation: Evaluation,
    policy: Agent,
    source: str,
) -> Path:
    """Writes the page; returns its path.

    Args:
        path: the file; what was there is replaced once the new page is complete.
        road: where they drove.
        shown: the pairs.
        evaluation: of these pairs, as they drove in SUMO.
        policy: who drove.
        source: where the recordings come from.

    Raises:
        OSError: the page cannot be written.
    """
    page = render(road, shown, evaluation, policy, source)
    with atomic_write(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return path


def render(
    road: Motorway,
    shown: Sequence[Shown],
    evaluation: Evaluation,
    policy: Agent,
    source: str,
) -> str:
    """Returns the page as HTML."""
    import jinja2
    from plotly.offline import get_plotlyjs

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # An end tag inside a string of a script would end its element.
    scripts = [
        source.replace("</script", "<\\/script") for source in (get_plotlyjs(), _asset("demo.js"))
    ]
    return environment.from_string(_asset("demo.html.j2")).render(
        security=_security(scripts),
        scripts=scripts,
        style=_asset("demo.css"),
        colours={kind: COLOURS[kind] for kind in ("leader", *FOLLOWERS)},
        labels={kind: LABELS[kind] for kind in ("leader", *FOLLOWERS)},
        content=_json(_content(road, shown, evaluation)),
        shown=shown,
        rows=[row for one in shown for row in one.table.to_dict("records")],
        model=policy.model_node["name"],
        policy=policy.policy_node["name"],
        windows=policy.windows,
        dt=policy.dt,
        source=Path(source).name,
        count=len(shown),
    )


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


def _json(value: Any) -> str:
    """Returns JSON that can stand inside a script element, whatever names it holds."""
    from plotly.utils import PlotlyJSONEncoder

    text = json.dumps(value, cls=PlotlyJSONEncoder, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def _security(scripts: Sequence[str]) -> str:
    """Returns the Content-Security-Policy: only these very scripts run, and nothing is ever asked from a network."""
    allowed = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(one.encode()).digest()).decode()}'"
        for one in scripts
    )
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none';"
        " form-action 'none'"
    )


def _content(road: Motorway, shown: Sequence[Shown], evaluation: Evaluation) -> dict[str, Any]:
    """Returns what the script draws: positions in centimetres from a corner of the road, so that they are short integers."""
    corner = np.concatenate([lane.shape for lane in road.lanes]).min(axis=0)
    axes = parameter_axes(evaluation.names, evaluation.units, evaluation.bounds)
    pairs = []
    for one, trajectory in zip(shown, evaluation.trajectories, strict=True):
        plot = pair_plot(pair_panels(trajectory, evaluation.methods, axes))
        pairs.append(_pair(one, corner) | {"plot": _plot(plot)})
    return {
        "colours": {kind: COLOURS[kind] for kind in ("leader", *FOLLOWERS)},
        "labels": {kind: LABELS[kind] for kind in FOLLOWERS},
        "followers": FOLLOWERS,
        "carLength": CAR_LENGTH,
        "lanes": [
            {
                "width": lane.width,
                "inner": lane.inner,
                "shape": _rounded(100 * (lane.shape - corner)),
            }
            for lane in road.lanes
        ],
        "pairs": pairs,
    }


def _pair(one: Shown, corner: Array) -> dict[str, Any]:
    return {
        "id": one.pair.pair_id,
        "scene": one.scene,
        "dt": one.pair.dt,
        "first": one.first,
        "leaderLength": one.pair.leader_length,
        "speed": {kind: _rounded(100 * one.speed[kind]) for kind in FOLLOWERS},
        "gap": {kind: _rounded(100 * one.gap[kind]) for kind in FOLLOWERS},
        "place": {
            kind: _rounded(
                np.concatenate(
                    [100 * (one.place[kind][..., :2] - corner), 10 * one.place[kind][..., 2:]],
                    axis=-1,
                )
            )
            for kind in FOLLOWERS
        },
    }


def _plot(plot: Plot) -> dict[str, Any]:
    (view,) = plot.views.values()
    return {
        "data": view["data"],
        "layout": view["layout"],
        "height": plot.height,
        "label": plot.label,
    }


def _rounded(values: Array) -> list[Any]:
    whole_numbers: list[Any] = np.round(np.nan_to_num(values)).astype(int).tolist()
    return whole_numbers

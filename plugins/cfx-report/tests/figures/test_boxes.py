"""No text of a figure is cut, in one column of a paper and across a page, with long names."""

from __future__ import annotations

import dataclasses

import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from cfx.core import registry
from cfx.core.distributions import OWN
from cfx.figures.canvas import Paper, on_paper
from cfx.figures.drawing import draw_figure
from cfx.results.result import Result
from tests.made_up import make_results

A4_MM = 297
LONG = "recording-of-a-long-name/2026-11-28-"


@pytest.fixture(scope="module")
def result() -> Result:
    methods = ("default", "pooled", "driver_specific", "shrunk", "policy")
    made = make_results(pairs=9, frames=60, methods=methods)
    evaluation, trajectories = made.evaluation, []
    for trajectory in evaluation.trajectories:
        trajectories.append(dataclasses.replace(trajectory, pair_id=LONG + trajectory.pair_id))
    values = evaluation.values
    long_ids = pd.Categorical(LONG + values["pair_id"].astype(str))
    evaluation = dataclasses.replace(
        evaluation,
        about=evaluation.about.assign(pair_id=LONG + evaluation.about["pair_id"].astype(str)),
        values=values.assign(pair_id=long_ids),
        trajectories=tuple(trajectories),
    )
    return Result.of(evaluation, tables={"curves": made.curves})


def cut(figure: Figure) -> list[str]:
    """Returns the texts that leave the canvas; labels of ticks beyond an axis are not drawn."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    ticks = []
    for axes in figure.axes:
        ticks += [*axes.get_xticklabels(), *axes.get_yticklabels()]
    found = []
    for text in figure.findobj(Text):
        box = text.get_window_extent(renderer)
        if text in ticks or not text.get_visible() or not text.get_text().strip():
            continue
        if box.width and not (
            box.x0 >= -1
            and box.y0 >= -1
            and box.x1 <= figure.bbox.width + 1
            and box.y1 <= figure.bbox.height + 1
        ):
            found.append(text.get_text())
    return found


@pytest.mark.parametrize("width_mm", [88, 180])
def test_no_text_is_cut_and_no_page_is_taller_than_a4(result: Result, width_mm: int) -> None:
    drawn = 0
    for one in registry.installed("figure"):
        if one.distribution not in {OWN, "cfx-report", "cfx-forecasts"}:
            continue  # a third party's chooses sizes of its own
        with on_paper(Paper(width_mm / 25.4, 8.0)):
            figure = draw_figure(one, result)
        if figure is not None:
            drawn += 1
            assert cut(figure) == [], one.name
            assert figure.get_figheight() * 25.4 <= A4_MM, one.name
    assert drawn >= 9

"""What holds for every figure that is installed, and how third parties bring one."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt

from cfx.core import registry
from cfx.core.distributions import OWN
from cfx.figures.canvas import blank, hover
from cfx.figures.drawing import draw_figure, write_figure, write_figures
from cfx.results.figure import JobFigure
from cfx.results.result import Result
from cfx_report.inline import PLACE, inline_svg
from cfx_report.page import render
from cfx_report.runs import read_runs
from tests.installer import Installer
from tests.job_folders import write_job
from tests.made_up import (
    GAINS,
    make_distributions,
    make_forecasts,
    make_history,
    make_platoon,
    make_results,
)


def _known(results: Result) -> dict[str, float]:
    known = {"pareto_k": 0.3, "effective_samples": 400.0}
    for axis in results.parameters:
        known |= {f"low_{axis.name}": 1.0, f"median_{axis.name}": 2.0, f"high_{axis.name}": 3.0}
        known[f"contraction_{axis.name}"] = 0.5
    return known


def _drawn(results: Result) -> dict[str, float]:
    return {f"parameter_{axis.name}": 2.0 for axis in results.parameters}


FAN = {"low": 0.5, "median": 1.0, "high": 1.5}


@pytest.fixture(scope="module")
def everything() -> Result:
    """Results of a job that measured all that figures can show."""
    made = make_results(pairs=5, frames=60)
    forecasts = make_forecasts()
    evaluation = made.evaluation
    at_sites = made.style.table.assign(driver_type="", site="")
    at_sites["site"] = [("A", "B")[number % 2] for number in range(len(at_sites))]
    style = dataclasses.replace(made.style, table=at_sites)
    evaluation = dataclasses.replace(evaluation, style=style)
    results = Result.of(evaluation, tables={"curves": made.curves})
    ids, axis = evaluation.table["pair_id"].unique(), results.parameters[0]
    slices = pd.DataFrame(
        [(ids[0], axis.name, place, place, 1 + place, 1.0) for place in (0.0, 0.5, 1.0)],
        columns=["pair_id", "parameter", "place", "value", "loss", "best_loss"],
    )
    fits = pd.DataFrame({"pair_id": ids, "method": "driver_specific"})
    labels = pd.DataFrame({"pair_id": ids[0], "time_s": [0.0, 0.5], "sensitivity": [0.1, 0.2]})
    sites = pd.DataFrame(
        [("test", "A", "all"), ("test", "A", "acc"), ("full_trajectory", "A", "all")],
        columns=["scope", "site", "driver_type"],
    )
    gains = {
        "over_driver_specific": 0.1,
        "over_driver_specific_low": -0.1,
        "over_driver_specific_high": 0.2,
    }
    tables = {
        "sites": sites.assign(**gains),
        "platoon": make_platoon({"policy": 2}).table,
        "history": make_history(made.evaluation.trajectories, GAINS),
        "forecasts": forecasts,
        "distributions": make_distributions(forecasts),
        "slices": slices,
        "fits": fits.assign(train_rmse_speed=0.3, test_rmse_speed=0.4, **_known(results)),
        "posterior": fits.assign(draw=0, **_drawn(results)),
        "prior": pd.DataFrame([_drawn(results)] * 3),
        "fan": fits.assign(time_s=1.0, calibrated_on=False, signal="speed", measured=1.0, **FAN),
        "labels": labels.assign(**{f"parameter_{axis.name}": 1.0}),
    }
    prior = {"weight": 0.2, "pairs": 3, "held_out_error": {"0.01": 0.7, "0.3": 0.6, "1": 0.65}}
    data = {**results.data, "priors": [prior]}
    return dataclasses.replace(results, tables={**results.tables, **tables}, data=data)


OWN = [
    one
    for one in registry.installed("figure")
    if one.distribution in {OWN, "cfx-report", "cfx-forecasts"}
    and not one.name.startswith("traffic")  # beside their protocol, on its own results
]


@pytest.mark.parametrize("one", OWN, ids=lambda one: one.name)
def test_every_figure_keeps_its_contract(
    one: registry.Installed[JobFigure], everything: Result
) -> None:
    settings = dict(mpl.rcParams)
    drawn = draw_figure(one, everything)
    assert drawn is not None
    assert one.component.title
    assert one.component.caption.endswith(".")
    for axes in drawn.axes:
        named = axes.get_xlabel() or axes.get_ylabel() or axes.get_title(loc="left")
        shared = drawn.get_supxlabel() or drawn.get_supylabel()
        assert named or shared, "nothing says what a panel shows"
    again = draw_figure(one, everything)
    assert again is not None
    svg = inline_svg(again)
    assert svg == inline_svg(drawn)
    assert svg.startswith("<svg viewBox=")
    assert "http" not in svg.replace("http://www.w3.org/", "")
    assert len(svg) < 400_000
    assert not plt.get_fignums()
    assert dict(mpl.rcParams) == settings


def test_the_same_figure_gives_the_same_bytes(everything: Result, tmp_path: Path) -> None:
    one = next(one for one in OWN if one.name == "style_distribution")
    for form in ("png", "pdf", "svg"):
        written = []
        for name in ("figure", "again"):
            figure = draw_figure(one, everything)
            assert figure is not None
            written.append(write_figure(figure, tmp_path / f"{name}.{form}").read_bytes())
        assert written[0] == written[1], form


@pytest.mark.parametrize("one", registry.installed("figure"), ids=lambda one: one.name)
def test_a_figure_of_what_was_not_measured_is_left_out(one: registry.Installed[JobFigure]) -> None:
    table = make_results(pairs=1, frames=5).evaluation.table
    bare = Result(tables={"pairs": table[table["method"] == "default"]})
    assert draw_figure(one, bare) is None


def test_an_inline_figure_has_text_pictures_of_clouds_and_says_what_the_mouse_shows() -> None:
    figure = blank(3.0)
    axes = figure.subplots()
    axes.scatter(np.arange(1000), np.arange(1000))
    (line,) = axes.plot([0, 1], [0, 1])
    axes.set_xlabel("a < b & </script><img src=x>")
    hover(line, "one <b>line</b>")
    svg = inline_svg(figure)
    assert "a &lt; b &amp; &lt;/script&gt;&lt;img src=x&gt;</text>" in svg
    assert "<title>one &lt;b&gt;line&lt;/b&gt;</title>" in svg
    assert svg.count("<image") == 1
    assert svg.count("<use") < 100
    assert f'id="{PLACE}' in svg
    assert f"#{PLACE}" in svg


FURTHER = """
    from cfx.figures.canvas import blank
    from cfx.results.figure import JobFigure

    class Further(JobFigure):
        \"\"\"A figure of a third party.\"\"\"

        title = "Something further"
        caption = "It shows nothing."
        order = 5

        def draw(self, results):
            return blank(2.0)

    class Broken(Further):
        def draw(self, results):
            raise ValueError("no luck")

    class Untitled(Further):
        title = ""
"""


@pytest.mark.usefixtures("blank_figures")
def test_a_third_partys_figure_needs_a_class_and_an_entry_point(
    tmp_path: Path, install: Installer, caplog: pytest.LogCaptureFixture
) -> None:
    figures = {
        name.lower(): f"further_figures:{name}" for name in ("Further", "Broken", "Untitled")
    }
    figures |= {"following": "further_figures:Further", "missing": "no_such_module:Figure"}
    install("somebody-else", {"cfx.figures": figures}, {"further_figures.py": FURTHER})
    write_job(tmp_path / "job", pairs=3)
    drawn = tmp_path / "job" / "figures" / "further.png"
    drawn.parent.mkdir(exist_ok=True)
    drawn.touch()
    names = [one.name for one in registry.installed("figure")]
    made = make_results(pairs=1, frames=5)
    paths = write_figures(tmp_path / "figures", Result.of(made.evaluation))
    page = render(read_runs([str(tmp_path / "job")]))
    assert names[:2] == ["broken", "further"]
    assert {"missing", "untitled"}.isdisjoint(names)
    written = [path.stem for path in paths]
    assert written[0] == "further"
    assert "broken" not in written
    assert "following" not in written, "two of a name: neither is drawn, and a warning names both"
    assert page.count("Something further") == 2, "its heading, and the words for who sees none"
    for name in ("broken", "following", "missing", "untitled"):
        assert f"figure {name} of the distribution somebody-else is left out" in caplog.text
    assert (
        "broken of the distribution somebody-else is left out: ValueError: no luck" in caplog.text
    )
    assert "has no title or no caption" in caplog.text

"""What figures and reports show of traffic."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cfx.figures.colours import colour_of
from cfx.figures.drawing import draw_figure, figure_named
from cfx.figures.wording import MINUS, method_label
from cfx.results.result import Result
from cfx_forecasts.traffic.figures import draw_paths, draw_traffic, path_panels, traffic_panels
from cfx_forecasts.traffic.summary import traffic_methods, traffic_metrics
from cfx_forecasts.traffic.tables import ROAD_COLUMNS

pytest.importorskip("cfx_report", reason="the page is that of cfx-report")

from cfx_forecasts.traffic.section import traffic_sheet
from cfx_report.page import render
from cfx_report.runs import read_runs
from tests.drawn import drawn_lines
from tests.job_folders import write_job
from tests.made_up import make_results
from tests.pages import Page


def make_traffic(
    methods: tuple[str, ...] = ("pooled", "driver_specific_ar", "policy"),
) -> dict[str, pd.DataFrame]:
    """Traffic of made-up vehicles: each method's flows and variations are of another size."""
    rng = np.random.default_rng(0)
    roads, growth, strips, paths = [], [], [], []
    for k, method in enumerate(("real", *methods)):
        size = 1.0 - 0.1 * k
        density = rng.uniform(20.0, 110.0, 400)
        flow = size * 25.0 * density * (1.0 - density / 150.0)
        columns = {"density": density, "flow": flow, "speed_std": size * 0.9}
        strips.append(pd.DataFrame({"method": method, **columns}))
        if method == "real":
            continue
        for density_of_ring in (30.0, 60.0, 90.0):
            ring_flow = size * 25.0 * density_of_ring * (1.0 - density_of_ring / 150.0)
            row = dict.fromkeys(ROAD_COLUMNS, 1.0) | {"flow": ring_flow, "wave_speed": -15.0 * size}
            level = {"level": density_of_ring, "density": density_of_ring}
            roads.append(row | level | {"method": method, "road": "ring", "collisions": 0})
        free = dict.fromkeys(ROAD_COLUMNS, np.nan) | {"discharge": 1500.0 * size, "collisions": k}
        roads.append(free | {"method": method, "road": "open", "level": 1800.0})
        vehicle = np.arange(9)
        along = {"leader_speed": 8.0, "vehicle": vehicle, "speed_std": size * np.sqrt(vehicle)}
        growth.append(pd.DataFrame({"method": method, **along}))
        time = np.tile(np.arange(50.0), 4)
        place = np.mod(10.0 * time + 100.0 * np.repeat(np.arange(4.0), 50), 400.0)
        points = {"vehicle": np.repeat(np.arange(4), 50), "time_s": time, "place": place}
        paths.append(pd.DataFrame({"method": method, **points, "speed": 10.0 * size}))
    return {
        "traffic": pd.DataFrame(roads, columns=list(ROAD_COLUMNS)),
        "traffic_growth": pd.concat(growth, ignore_index=True),
        "traffic_strips": pd.concat(strips, ignore_index=True),
        "traffic_paths": pd.concat(paths, ignore_index=True),
    }


def test_traffic_has_lines_points_and_a_panel_of_paths_per_method() -> None:
    roads, growth, strips, paths = make_traffic().values()
    methods = traffic_methods(roads)
    panels = traffic_panels(roads, growth, strips, -14.0, methods)
    figure = draw_traffic(panels, methods)
    assert len(panels) == 4
    for axes, panel in zip(figure.axes, panels, strict=True):
        for line in panel.lines:
            if len(line.time) > 2:
                drawn = drawn_lines(axes)[colour_of(line.method)]
                np.testing.assert_allclose(drawn.get_ydata(), line.values)
    points = np.asarray(figure.axes[0].collections[0].get_offsets())
    np.testing.assert_allclose(points[:, 0], panels[0].cloud[0])
    without = traffic_panels(roads, growth.iloc[:0], strips, -14.0, methods)
    assert len(without) == 3
    rings = draw_paths(path_panels(paths, methods))
    assert [axes.get_title(loc="left") for axes in rings.axes[:3]] == [
        method_label(method) for method in methods
    ]


def test_traffic_has_a_plot_and_a_table(tmp_path: Path) -> None:
    metrics = write_job(tmp_path / "job", pairs=4)
    traffic = make_traffic()
    for name, table in traffic.items():
        table.to_parquet(tmp_path / "job" / f"{name}.parquet", index=False)
    roads, growth, strips, _ = traffic.values()
    found = {**metrics, **traffic_metrics(roads, growth, strips, -14.0)}
    (tmp_path / "job" / "metrics.json").write_text(
        json.dumps({key: value if math.isfinite(value) else None for key, value in found.items()})
    )
    page = Page(render(read_runs([str(tmp_path)])))
    assert "traffic" in page.having("id")
    (job,) = read_runs([str(tmp_path)]).jobs
    sheet = traffic_sheet(job, roads)
    assert [row[0].text for row in sheet.rows] == [
        "pooled",
        "driver-specific + noise",
        "policy",
        "real",
    ]
    pooled, *_, real = sheet.rows
    assert pooled[1].text == f"{found['traffic/capacity/pooled']:.0f}"
    assert real[4].text == f"{MINUS}14.0"


@pytest.mark.parametrize("name", ["traffic", "traffic_paths"])
def test_each_figure_is_drawn_where_there_is_traffic_and_nowhere_else(name: str) -> None:
    one = figure_named(name)
    evaluation = make_results(pairs=3, frames=20).evaluation
    assert draw_figure(one, Result.of(evaluation)) is None
    assert draw_figure(one, Result.of(evaluation, tables=make_traffic())) is not None

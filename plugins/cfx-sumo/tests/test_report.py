"""Flows, headways and time-space diagrams of a scenario."""

from __future__ import annotations

import csv
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cfx_sumo.drive.report_figure import draw_report
from cfx_sumo.drive.scenario_report import (
    Observations,
    Observer,
    ScenarioReport,
    busiest_lane,
    lane_flows,
    write_report,
)


class Column:
    """Stands in for SUMO: vehicles at 10 m/s, one every two seconds, on a lane of 200 m."""

    def __init__(self, headway: float = 2.0) -> None:
        self.now, self.headway = 0.0, headway
        self.simulation: Any = SimpleNamespace(getTime=lambda: self.now)
        self.vehicle: Any = self

    def place(self, name: str) -> float:
        return 10.0 * (self.now - self.headway * int(name))

    def getIDList(self) -> list[str]:  # noqa: N802 - SUMO's names
        return [str(car) for car in range(100) if 0.0 <= self.place(str(car)) <= 210.0]

    def getLaneID(self, name: str) -> str:  # noqa: N802
        return "road_0" if self.place(name) <= 200.0 else ":junction_0"

    def getLanePosition(self, name: str) -> float:  # noqa: N802
        return self.place(name)

    def getSpeed(self, name: str) -> float:  # noqa: N802
        return 10.0


def seen(headway: float = 2.0, seconds: int = 120) -> Observations:
    sumo, observer = Column(headway), Observer()
    for step in range(2 * seconds):
        sumo.now = 0.5 * step
        observer.look(sumo)
    return observer.observations()


def test_a_column_has_its_flow_and_headway() -> None:
    """One vehicle every two seconds is 1,800 an hour once the first has come half-way."""
    found = lane_flows(seen())
    assert list(found) == ["road_0"]
    lane = found["road_0"]
    assert lane.speed == pytest.approx(10.0)
    assert lane.headways == pytest.approx([2.0] * len(lane.headways))
    assert lane.flow == pytest.approx(1800.0 * 110 / 120, rel=0.02)


def test_both_runs_stand_side_by_side(tmp_path: Path) -> None:
    report = ScenarioReport(seen(2.0), seen(4.0))
    assert busiest_lane(report.driven) == "road_0"
    write_report(report, tmp_path / "report")
    with (tmp_path / "report" / "lanes.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert float(row["cfx_flow"]) > 1.8 * float(row["sumo_flow"])
    assert (tmp_path / "report" / "report.png").stat().st_size > 10_000
    figure = draw_report(report)
    paths = figure.axes[2].collections[0]
    assert len(paths.get_segments()) > 100  # type: ignore[attr-defined]


def test_an_empty_road_has_no_lane() -> None:
    nothing = Observer().observations()
    assert busiest_lane(nothing) is None
    assert lane_flows(nothing) == {}

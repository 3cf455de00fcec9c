"""A parameter that recordings do not determine is marked in tables for papers too."""

from __future__ import annotations

from pathlib import Path

from cfx.app import cli
from cfx_report.runs import read_runs
from cfx_report.section import formatted
from cfx_report.sections import calibration


def test_latex_has_the_shares_of_the_page(flat_job: Path, tmp_path: Path) -> None:
    (job,) = read_runs([str(flat_job)]).jobs
    panels = calibration.slices_of(job)
    shown = {panel.axis.name: formatted(panel.near, ".0%").replace("%", "\\%") for panel in panels}
    output = tmp_path / "table.tex"
    assert cli.main(["report", str(flat_job), "--tables", "latex", "--output", str(output)]) == 0
    rows = [line.split(" & ") for line in output.read_text().splitlines() if "cc1 (" in line]
    assert rows
    assert rows[0][-2] == shown["cc1"]
    (of_b,) = [line for line in output.read_text().splitlines() if line.startswith("b (")]
    assert of_b.rstrip(" \\").split(" & ")[-2:] == ["100 \\%", "100 \\%"]

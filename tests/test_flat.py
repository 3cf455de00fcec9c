"""A parameter that recordings do not determine is marked wherever its values are shown.

W99's deceleration b has no effect below its brake cap, 9 m/s2, so that its loss is flat for every
driver where a job tunes it.
"""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

import cfx
from cfx.app import cli
from cfx_report.runs import read_runs
from cfx_report.section import formatted
from cfx_report.sections import calibration
from cfx_sumo.export import export

JOB = [
    "debug=quick",
    "data.pairs=3",
    "data.platoon_size=1",
    "data.frames=150",
    "data.max_pairs=null",
    "figures.enabled=false",
    "model=w99",
    "model.parameters.b.tuned=true",
    "policy=fixed",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("flat"))
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        return cfx.run([*JOB, "tracking.enabled=false"]).folder


def test_tables_and_metrics_say_it_and_it_is_held_at_its_default(folder: Path) -> None:
    table = pd.read_csv(folder / "pairs.csv")
    fixed = table[table["method"] == "fixed"]
    assert (fixed["flat_b"] == 1).all()
    assert fixed["parameter_b"].to_list() == pytest.approx([4.5] * 3, abs=1e-3)
    assert (fixed["flat_cc1"] < 1).all()
    assert table.loc[table["method"] != "fixed", "flat_b"].isna().all()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["flat/b"] == 1
    assert metrics["flat/cc1"] == 0


def test_latex_has_the_shares_of_the_page(folder: Path) -> None:
    (job,) = read_runs([str(folder)]).jobs
    panels = calibration.slices_of(job)
    shown = {panel.axis.name: formatted(panel.near, ".0%").replace("%", "\\%") for panel in panels}
    output = folder / "table.tex"
    assert cli.main(["report", str(folder), "--tables", "latex", "--output", str(output)]) == 0
    rows = [line.split(" & ") for line in output.read_text().splitlines() if "cc1 (" in line]
    assert rows
    assert rows[0][-2] == shown["cc1"]
    (of_b,) = [line for line in output.read_text().splitlines() if line.startswith("b (")]
    assert of_b.rstrip(" \\").split(" & ")[-2:] == ["100 \\%", "100 \\%"]


def test_vtypes_name_what_is_flat(folder: Path) -> None:
    lines = export(folder, folder / "drivers.add.xml")
    assert any("do not determine" in line and "b of 3" in line for line in lines)
    text = (folder / "drivers.add.xml").read_text()
    assert text.count('<param key="flat" value="') == 3

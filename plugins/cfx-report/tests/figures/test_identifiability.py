"""Slices, fits and labels: what is chosen, drawn and reported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cfx.results.result import ParameterAxis
from cfx_report.figures.calibration import (
    draw_fits,
    draw_labels,
    draw_slices,
    fits_of,
    labels_of,
    slice_panels,
)
from cfx_report.page import render
from cfx_report.runs import read_runs
from cfx_report.sections import calibration
from tests.job_folders import write_job

AXES = (ParameterAxis("T", "s", 0.0, 4.0), ParameterAxis("s0", "m", 0.5, 8.0))
PLACES = np.linspace(0, 1, 5)


def slices(pairs: list[str], names: tuple[str, ...] = ("T", "s0")) -> pd.DataFrame:
    """T is determined, its best in the middle; s0 changes nothing."""
    rows = []
    for number, pair in enumerate(pairs):
        for name in names:
            for place in PLACES:
                loss = 0.5 * (1 + (place - 0.5) ** 2 * (number + 4)) if name == names[0] else 0.5
                value = 4 * place
                rows.append((pair, name, place, value, loss, 0.5))
    columns = ["pair_id", "parameter", "place", "value", "loss", "best_loss"]
    return pd.DataFrame(rows, columns=columns)


FITS = pd.DataFrame(
    {
        "pair_id": ["a", "b", "a", "b"],
        "method": ["default", "default", "driver_specific", "driver_specific"],
        "train_rmse_speed": [0.9, 0.8, 0.3, 0.4],
        "test_rmse_speed": [0.9, 0.7, 0.6, np.nan],
    }
)

LABELS = pd.DataFrame(
    {
        "pair_id": ["a"] * 4,
        "time_s": [0.5, 0.0, 1.0, 1.5],
        "parameter_T": [1.1, 1.0, 1.2, 1.3],
        "parameter_s0": [2.0, 2.0, 2.0, 2.0],
        "loss": 0.1,
        "sensitivity": [0.2, 0.0, 0.4, 0.4],
    }
)

PAIRS = pd.DataFrame(
    {"pair_id": ["a"], "method": ["driver_specific"], "parameter_T": [1.15], "parameter_s0": [2.0]}
)


def test_a_flat_slice_is_flat_everywhere_and_a_steep_one_near_its_best() -> None:
    steep, flat = slice_panels(slices(["a", "b", "c"]), AXES)
    assert flat.near == 1.0
    assert steep.near == pytest.approx(1 / 5)
    np.testing.assert_allclose(steep.median, 1 + (PLACES - 0.5) ** 2 * 5)
    np.testing.assert_allclose(flat.ratios, 1.0)


def test_a_slice_without_a_finite_loss_is_left_out_or_infinite() -> None:
    table = slices(["a", "b"])
    table.loc[(table["pair_id"] == "a"), "best_loss"] = np.nan
    table.loc[(table["pair_id"] == "b") & (table["place"] == 1.0), "loss"] = np.inf
    (steep, _) = slice_panels(table, AXES)
    assert steep.ratios.shape == (1, 5)
    assert np.isinf(steep.ratios[0, -1])


def test_fits_have_the_pairs_that_are_defined_on_both_parts() -> None:
    fits = fits_of(FITS)
    assert list(fits) == ["driver_specific", "default"]
    assert fits["driver_specific"]["pair_id"].tolist() == ["a"]
    assert fits["default"]["train_rmse_speed"].tolist() == [0.9, 0.8]


def test_labels_are_in_the_order_of_time_and_weighted_by_what_they_matter() -> None:
    ((pair_id, rows),) = labels_of(LABELS, PAIRS, AXES).items()
    assert pair_id == "a"
    assert rows["time_s"].tolist() == [0.0, 0.5, 1.0, 1.5]
    np.testing.assert_allclose(rows["weight"], [0.0, 0.5, 1.0, 1.0])
    assert rows["fixed_T"].unique().tolist() == [1.15]
    assert rows["fixed_s0"].unique().tolist() == [2.0]
    assert labels_of(LABELS, PAIRS.iloc[:0], AXES) == {}


def test_what_was_chosen_is_drawn() -> None:
    panels = slice_panels(slices(["a", "b", "c"]), AXES)
    for axes, panel in zip(draw_slices(panels).axes, panels, strict=False):
        lines = [line.get_ydata() for line in axes.lines]
        np.testing.assert_allclose(lines[len(panel.ratios)], panel.median)
    fits = fits_of(FITS)
    for fit, line in zip(fits.values(), draw_fits(fits).axes[0].lines, strict=False):
        np.testing.assert_allclose(line.get_xdata(), fit["train_rmse_speed"])
    ((pair_id, rows),) = labels_of(LABELS, PAIRS, AXES).items()
    drawn = draw_labels(pair_id, rows, AXES).axes
    assert len(drawn) == len(AXES) + 1
    assert drawn[0].lines[0].get_ydata()[0] == 1.15


@pytest.mark.usefixtures("blank_figures")
def test_a_report_shows_them(tmp_path: Path) -> None:
    folder = tmp_path / "job"
    write_job(folder, pairs=3)
    (job,) = read_runs([str(folder)]).jobs
    names = tuple(str(one["name"]) for one in job.data["parameters"])
    ids = job.pairs["pair_id"].unique().tolist()
    slices(ids, names[:2]).to_parquet(folder / "slices.parquet")
    FITS.assign(pair_id=[ids[0], ids[1]] * 2).to_parquet(folder / "fits.parquet")
    labels = LABELS.rename(
        columns={
            f"parameter_{a}": f"parameter_{b}" for a, b in zip(("T", "s0"), names, strict=False)
        }
    )
    labels.assign(pair_id=ids[0]).to_parquet(folder / "labels.parquet")
    runs = read_runs([str(folder)])
    assert [panel.near for panel in calibration.slices_of(runs.jobs[0])] == [
        pytest.approx(0.2),
        1.0,
    ]
    page = render(runs)
    for title in (
        "Calibrated parameters of all drivers, and their rank correlations",
        "The loss when one parameter is moved and the others are held",
        "Errors where calibrated, and on the test part",
        "Per-window calibrated parameters over time, and how much they mattered",
    ):
        assert page.count(f'aria-label="{title}"') == 1

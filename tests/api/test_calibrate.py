"""Calibration and simulation from Python are those of the command line, and refuse as it does."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from torch import Tensor

import cfx
from cfx.app.overrides import override
from cfx.calibration.calibrator import Calibrator
from cfx.errors import CfxError, ConfigError, DataError, ParameterError
from cfx.results.table import stored_tables
from tests.checkout import needs

WEAK = {"calibration.prior": "weak"}
"""Choosing the prior's weight takes ten calibrations more."""
RANDOM = {"optimizer": "random", "optimizer.samples": 256, **WEAK}
OFF = ["tracking.enabled=false", "figures=none", "cache.enabled=false"]
LEADER = pd.DataFrame({"time_s": np.arange(600) * 0.1, "speed": 15.0})
NOBODY = pd.DataFrame({"T": []})


class Job(NamedTuple):
    """A job of the command line.

    Attributes:
        found: driver-specific parameters as calibration found them.
        fits: its table of errors.
    """

    found: Tensor
    fits: pd.DataFrame


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> cfx.Pairs:
    """Three pairs that were written to a file."""
    made = cfx.read(dataset="synthetic", pairs=3, frames=300)
    return made.save(tmp_path_factory.mktemp("a recording") / "pairs.parquet")


@pytest.fixture(scope="module")
def fit(pairs: cfx.Pairs) -> cfx.Fit:
    return cfx.calibrate(pairs, "idm", objective="gap_rmse", seed=3, **RANDOM)


def job_of(fit: cfx.Fit, folder: Path) -> Job:
    """Runs the command of a fit."""
    found = []
    calibrated = Calibrator.driver_specific

    def recorded(self: Calibrator, *given: Any) -> Tensor:
        found.append(calibrated(self, *given))
        return found[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Calibrator, "driver_specific", recorded)
        cfx.run([*shlex.split(fit.command)[3:], *OFF, f"hydra.run.dir={folder}"])
    return Job(found[0], stored_tables(folder)["fits"])


@pytest.fixture(scope="module")
def job(fit: cfx.Fit, tmp_path_factory: pytest.TempPathFactory) -> Job:
    """The job of the fit's command."""
    return job_of(fit, tmp_path_factory.mktemp("job") / "out")


def test_parameters_are_those_of_the_command_to_the_last_bit(fit: cfx.Fit, job: Job) -> None:
    assert fit.parameters.to_numpy().tolist() == job.found.tolist()


def test_a_chosen_prior_is_that_of_the_command_to_the_last_bit(tmp_path: Path) -> None:
    made = cfx.read(dataset="synthetic", pairs=2, frames=120).save(tmp_path / "pairs.parquet")
    chosen = {"optimizer": "random", "optimizer.samples": 16}
    fit = cfx.calibrate(made, "krauss", **chosen)
    assert fit.parameters.to_numpy().tolist() == job_of(fit, tmp_path / "out").found.tolist()


def test_errors_are_those_of_the_command(fit: cfx.Fit, job: Job) -> None:
    for method in ("default", "driver_specific"):
        own = fit.losses[fit.losses["method"] == method].reset_index(drop=True)
        its = job.fits[job.fits["method"] == method].reset_index(drop=True)
        assert own["test_rmse_speed"].tolist() == its["test_rmse_speed"].tolist()
        assert own["test_rmse_gap"].tolist() == its["test_rmse_gap"].tolist()
        # A job takes these parameters out of its table of means over frames.
        pd.testing.assert_frame_equal(own, its[own.columns], rtol=1e-6, check_dtype=False)


def test_driver_specific_parameters_have_the_lowest_loss(fit: cfx.Fit) -> None:
    train = fit.losses.groupby("method")["train_rmse_gap"].mean()
    assert train["driver_specific"] <= train["pooled"] <= train["default"]


def test_groups_are_pooled_beside_one_another_as_each_alone(pairs: cfx.Pairs) -> None:
    first, second, third = pairs.summary.index
    groups = {"all": [first, second, third], "two": [third, first], "one": second}
    table = cfx.calibrate_pooled(pairs, "idm", groups, objective="gap_rmse", seed=3, **RANDOM)
    assert list(table.index) == ["all", "two", "one"]
    alone = cfx.calibrate_pooled(pairs.select([second]), objective="gap_rmse", seed=3, **RANDOM)
    assert table.loc["one"].tolist() == alone.loc["all"].tolist()
    whole = cfx.calibrate(pairs, objective="gap_rmse", seed=3, split=1.0, **RANDOM)
    assert table.loc["all"].tolist() == whole.pooled.tolist()
    shorter = cfx.calibrate_pooled(pairs, objective="gap_rmse", seed=3, split=0.5, **RANDOM)
    assert shorter.loc["all"].tolist() != whole.pooled.tolist()


@pytest.mark.parametrize(
    ("groups", "said"),
    [
        ({"mine": ["nobody"]}, "group 'mine': there is no pair 'nobody'"),
        ({"mine": []}, "group 'mine' has no pairs"),
        ({}, "groups: there is none"),
        (["a1", "b2"], "a list says no names of groups"),
    ],
)
def test_groups_that_cannot_be_pooled_are_said(pairs: cfx.Pairs, groups: Any, said: str) -> None:
    with pytest.raises(CfxError, match=said):
        cfx.calibrate_pooled(pairs, "idm", groups)


def test_pooled_parameters_have_no_posterior(pairs: cfx.Pairs) -> None:
    with pytest.raises(ConfigError, match="intervals are of driver-specific parameters"):
        cfx.calibrate_pooled(pairs, "idm", **{"calibration.posterior": "laplace"})


def test_a_summary_has_units_defaults_and_pooled_values(fit: cfx.Fit) -> None:
    table = fit.summary
    assert table.loc["T", ["unit", "default"]].tolist() == ["s", 1.6]
    assert table["pooled"].tolist() == fit.pooled.tolist()
    assert table["at_bound"].between(0, 1).all()
    assert "parameter" in fit._repr_html_()
    assert "driver-specific" in repr(fit)


@needs("cfx-posteriors")
def test_a_posterior_is_that_of_the_command_and_gives_new_drivers(
    pairs: cfx.Pairs, tmp_path: Path
) -> None:
    fit = cfx.calibrate(pairs, "krauss", **RANDOM, **{"calibration.posterior": "hierarchical"})
    folder = tmp_path / "job"
    cfx.run([*shlex.split(fit.command)[3:], *OFF, f"hydra.run.dir={folder}"])
    fits = pd.read_parquet(folder / "fits.parquet")
    its = fits[fits["method"] == "driver_specific"].set_index("pair_id")
    pd.testing.assert_frame_equal(fit.intervals, its[fit.intervals.columns], check_names=False)
    its = pd.read_parquet(folder / "posterior.parquet")
    # A job takes the point estimates, where searches start, out of its table of means over frames.
    np.testing.assert_allclose(fit.draws["t_r"], its["parameter_t_r"], rtol=1e-6)
    its = pd.read_parquet(folder / "population.parquet")
    np.testing.assert_allclose(fit.draw(1000)["t_r"], its["parameter_t_r"], rtol=1e-6)
    new = fit.draw(4, seed=1)
    drive = cfx.simulate("krauss", new, leader=LEADER, gap=30.0, speed=14.0)
    assert list(drive["pair_id"].unique()) == list(new.index)


@needs("cfx-posteriors")
def test_intervals_come_with_their_doubt_and_draws_as_arviz_reads_them(pairs: cfx.Pairs) -> None:
    fit = cfx.calibrate(pairs, "krauss", posterior="laplace", **RANDOM)
    assert "calibration.posterior=laplace" in fit.command
    rows = fit.intervals
    assert (rows["noise"] == rows["noise"].iloc[0]).all()
    assert rows["held"].between(0.0, 1.0).all()
    in_doubt = (rows["pareto_k"] > 0.7) | (rows["held_chance"] < 0.05)
    in_doubt |= rows["noise_left"].abs() > 0.3
    assert ((rows["doubt"] != "") == in_doubt).all()
    tree = fit.inference_data()
    assert dict(tree["posterior"].sizes) == {"chain": 1, "draw": 200, "pair": len(pairs)}
    for pair_id in rows.index:
        drawn = fit.draws.loc[pair_id, "t_r"].to_numpy()
        its = tree["posterior"]["t_r"].sel(chain=0, pair=pair_id).to_numpy()
        np.testing.assert_allclose(its, drawn)
    assert {"prior", "diagnostics"} <= set(tree.children)
    with pytest.raises(ConfigError, match=r"give posterior=\.\.\. or calibration\.posterior"):
        cfx.calibrate(pairs, posterior="laplace", **{"calibration.posterior": "nuts"})


def test_settings_of_data_choose_what_is_read_or_are_refused(
    pairs: cfx.Pairs, tmp_path: Path
) -> None:
    path = tmp_path / "pairs.parquet"
    pairs.save(path)
    fewer = {"data.max_pairs": 1, "data.min_duration": 0}
    assert len(cfx.calibrate(path, "krauss", **RANDOM, **fewer).parameters) == 1
    assert len(cfx.config(path, **fewer).pairs or ()) == 1
    driven = cfx.simulate("krauss", None, path, **fewer)["pair_id"]
    assert (driven == driven.iloc[0]).all()
    calls = (
        lambda: cfx.calibrate(pairs, "krauss", **fewer),
        lambda: cfx.config(pairs, **fewer),
        lambda: cfx.train(pairs, "krauss", **fewer),
        lambda: cfx.evaluate("cfx://idm", pairs, **fewer),
        lambda: cfx.forecast("cfx://idm", pairs, at=1.0, **fewer),
        lambda: cfx.simulate("krauss", None, pairs, **fewer),
    )
    for call in calls:
        with pytest.raises(ConfigError, match=r"data\.max_pairs=1: these pairs have been read"):
            call()
    with pytest.raises(ConfigError, match=r"data\.max_pairs=1 does nothing here"):
        cfx.simulate("krauss", None, leader=LEADER, **fewer)


@pytest.mark.parametrize("setting", ["tracking.enabled", "cache.folder", "output.url", "demo"])
def test_settings_that_do_nothing_in_python_are_refused(pairs: cfx.Pairs, setting: str) -> None:
    given = {setting: "x"}
    calls = (
        lambda: cfx.calibrate(pairs, "krauss", **given),
        lambda: cfx.train(pairs, "krauss", **given),
        lambda: cfx.evaluate("cfx://idm", pairs, **given),
        lambda: cfx.forecast("cfx://idm", pairs, at=1.0, **given),
        lambda: cfx.simulate("krauss", None, pairs, **given),
    )
    for call in calls:
        with pytest.raises(ConfigError, match=rf"{setting}=x does nothing here: .*; leave it out"):
            call()


@pytest.mark.parametrize("setting", ["policy", "learner.epochs", "protocol.folds"])
def test_settings_of_training_are_refused_where_parameters_are_calibrated(
    pairs: cfx.Pairs, setting: str
) -> None:
    with pytest.raises(ConfigError, match=f"{setting}=3 does nothing here"):
        cfx.calibrate(pairs, "krauss", **{setting: 3})


def test_without_a_posterior_there_are_no_intervals(fit: cfx.Fit) -> None:
    with pytest.raises(ConfigError, match=r"there is no posterior; say cfx\.calibrate"):
        _ = fit.intervals
    with pytest.raises(ConfigError, match=r"no population to draw from; say .*hierarchical"):
        fit.draw(3)


def test_figures_show_themselves_in_notebooks(fit: cfx.Fit, pairs: cfx.Pairs) -> None:
    for figure in (fit.plot(), pairs.plot()):
        assert vars(figure)["_repr_png_"]().startswith(b"\x89PNG")


def test_nothing_is_written(
    pairs: cfx.Pairs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fit = cfx.calibrate(pairs, "krauss", **RANDOM)
    cfx.simulate("krauss", fit)
    assert list(tmp_path.iterdir()) == []


def test_data_frames_of_other_libraries_are_read(pairs: cfx.Pairs) -> None:
    table = pa.Table.from_pandas(pairs.frame)
    read = cfx.read(table, min_duration=0, accelerations="recorded")
    assert [one.content for one in read.selected] == [one.content for one in pairs.selected]


def test_a_recording_says_its_layout_itself(pairs: cfx.Pairs) -> None:
    read = cfx.read(pairs.node["path"], min_duration=0, max_pairs=2)
    assert read.node["name"] == "tidy"
    assert read.dropped["count"].tolist() == [1]


def test_a_pattern_stands_for_its_files(pairs: cfx.Pairs, tmp_path: Path) -> None:
    first, *others = pairs.summary.index
    pairs.select([first]).save(tmp_path / "a.csv")
    pairs.select(others).save(tmp_path / "b.csv")
    assert list(cfx.read(tmp_path / "*.csv", min_duration=0).summary.index) == [first, *others]
    with pytest.raises(DataError, match="no file matches this pattern"):
        cfx.read(tmp_path / "*.txt")


def test_columns_and_units_of_ones_own_are_mapped(pairs: cfx.Pairs) -> None:
    frame = pairs.frame.rename(columns={"follower_speed_mps": "v"})
    frame["v"] *= 3.6
    own = {"columns": {"speed": "v"}, "units": {"speed": "km/h"}}
    read = cfx.read(frame, min_duration=0, accelerations="recorded", **own)
    for one, other in zip(read.selected, pairs.selected, strict=True):
        np.testing.assert_allclose(one.follower_speed, other.follower_speed, rtol=1e-12)
    with pytest.raises(ConfigError, match="cannot be turned into m/s"):
        cfx.read(frame, min_duration=0, columns={"speed": "v"}, units={"speed": "km"})


def test_pairs_are_counted_selected_and_shown(pairs: cfx.Pairs) -> None:
    assert pairs.summary["frames"].tolist() == [300, 300, 300]
    some = pairs.select(pairs.summary.index[:1])
    assert len(some) == 1
    assert some.dropped["count"].sum() == 2
    assert "duration_s" in pairs._repr_html_()
    assert cfx.config(some, model="idm").command.count("pair_ids") == 1
    with pytest.raises(DataError, match="there is no pair 'x'"):
        pairs.select(["x"])


def test_what_was_read_can_be_saved_though_it_would_be_refused(
    pairs: cfx.Pairs, tmp_path: Path
) -> None:
    """As averages in place of noisy accelerations may be, which lag behind the speeds."""
    frame = pairs.frame.copy()
    frame["follower_speed_mps"] *= 3.6
    with pytest.raises(DataError, match="contradict"):
        cfx.read(frame, min_duration=0)
    read = cfx.read(frame, min_duration=0, check="off")
    assert read.save(tmp_path / "pairs.parquet").frame.equals(read.frame)


def test_pairs_of_a_data_frame_have_no_command(pairs: cfx.Pairs) -> None:
    fit = cfx.calibrate(cfx.read(pairs.frame, min_duration=0), "idm", **RANDOM)
    with pytest.raises(DataError, match="save them first"):
        _ = fit.command


def test_a_recorded_leader_is_followed_from_a_measured_state(
    fit: cfx.Fit, pairs: cfx.Pairs
) -> None:
    drive = cfx.simulate("idm", fit, pairs, at=10.0)
    assert list(drive["pair_id"].unique()) == list(fit.parameters.index)
    first = drive.groupby("pair_id").first()
    for pair in pairs.selected:
        assert first.loc[pair.pair_id, "time_s"] == pytest.approx(10.0)
        assert first.loc[pair.pair_id, "speed"] == pair.follower_speed[100]
        assert first.loc[pair.pair_id, "gap"] == pytest.approx(pair.gap[100])
    assert drive.groupby("pair_id").size().tolist() == [200, 200, 200]


def test_a_simulation_has_the_errors_that_a_fit_says(fit: cfx.Fit, pairs: cfx.Pairs) -> None:
    split = int(fit._last[0])
    drive = cfx.simulate("idm", fit, pairs, at=split * 0.1)
    own = fit.losses[fit.losses["method"] == "driver_specific"].set_index("pair_id")
    for pair in pairs.selected:
        speed = drive.loc[drive["pair_id"] == pair.pair_id, "speed"].to_numpy()[1:]
        error = np.sqrt(np.mean((speed - pair.follower_speed[split + 1 :]) ** 2))
        assert error == pytest.approx(own.loc[pair.pair_id, "test_rmse_speed"], rel=1e-6)


def test_one_leader_is_followed_by_each_row_of_parameters() -> None:
    rows = pd.DataFrame({"T": [1.0, 2.0]}, index=["near", "far"])
    drive = cfx.simulate("idm", rows, leader=LEADER, gap=30.0, speed=14.0)
    first, last = drive.groupby("pair_id").first(), drive.groupby("pair_id").last()
    assert first["gap"].tolist() == [30.0, 30.0]
    assert first["speed"].tolist() == [14.0, 14.0]
    assert last.loc["near", "gap"] < last.loc["far", "gap"]
    as_series = cfx.simulate("idm", leader=LEADER.set_index("time_s")["speed"])
    assert as_series["gap"].iloc[0] == pytest.approx(2.0 + 1.5 * 15.0)


def test_one_leader_is_followed_by_every_driver_of_a_fit(fit: cfx.Fit) -> None:
    """Whether they are given as the fit, as its table, or as a table with a column of ids."""
    of_fit = cfx.simulate("idm", fit, leader=LEADER)
    assert list(of_fit["pair_id"].unique()) == list(fit.parameters.index)
    assert of_fit.groupby("pair_id")["gap"].last().nunique() == len(fit.parameters)
    for table in (fit.parameters, fit.parameters.reset_index()):
        pd.testing.assert_frame_equal(cfx.simulate("idm", table, leader=LEADER), of_fit)


REFUSED: list[tuple[type[CfxError], str, dict[str, Any]]] = [
    (ParameterError, "T=9 is outside its bounds", {"parameters": {"T": 9.0}, "leader": LEADER}),
    (ParameterError, "unknown parameter", {"parameters": {"tau": 1.0}, "leader": LEADER}),
    (DataError, "column speed is missing", {"leader": LEADER.rename(columns={"speed": "v"})}),
    (DataError, "constant step", {"leader": LEADER.iloc[[0, 1, 5]]}),
    (DataError, "0 or more", {"leader": LEADER.assign(speed=-1.0)}),
    (ConfigError, "parameters: there are no rows", {"parameters": NOBODY, "leader": LEADER}),
    (ConfigError, "a ndarray does not say which", {"parameters": np.ones(5), "leader": LEADER}),
    (ConfigError, "a str does not say which", {"parameters": "cfx://idm", "leader": LEADER}),
    (ConfigError, "give recorded pairs", {}),
    (ConfigError, "give a leader", {"gap": 3.0}),
    (ConfigError, "at=1000", {"leader": LEADER, "at": 1000.0}),
]


@pytest.mark.parametrize(("error", "said", "given"), REFUSED)
def test_a_simulation_refuses(error: type[CfxError], said: str, given: dict[str, Any]) -> None:
    with pytest.raises(error, match=said):
        cfx.simulate("idm", **given)


@pytest.mark.parametrize("nothing", [None, "null"])
def test_none_and_null_lift_what_a_setting_limits(nothing: str | None) -> None:
    """A leader that stops dead: without limits Krauss brakes as hard as its gap asks for."""
    speed = np.concatenate([np.full(20, 20.0), np.zeros(80)])
    leader = pd.DataFrame({"time_s": 0.1 * np.arange(100), "speed": speed})
    braking = {}
    limits: dict[str, dict[str, Any]] = {"usual": {}, "lifted": {"model.limits": nothing}}
    for name, settings in limits.items():
        simulated = cfx.simulate(
            "krauss", {"t_r": 1.0}, leader=leader, gap=25.0, speed=20.0, **settings
        )
        braking[name] = float(simulated["acceleration"].min())
    assert braking["usual"] >= -9.0 - 1e-6
    assert braking["lifted"] < -9.0
    assert cfx.config(model="krauss", **{"model.limits": nothing}).config.model["limits"] is None


def test_a_fit_of_another_model_is_refused(fit: cfx.Fit, pairs: cfx.Pairs) -> None:
    with pytest.raises(ConfigError, match="parameters are of model=idm"):
        cfx.simulate("krauss", fit, pairs)
    others = fit.parameters.iloc[:1]
    with pytest.raises(ConfigError, match="there is no row for pair"):
        cfx.simulate("idm", others, pairs)


def test_a_wrong_setting_is_answered_as_on_the_command_line(pairs: cfx.Pairs) -> None:
    with pytest.raises(ConfigError, match="objective=gap_rmes"):
        cfx.calibrate(pairs, objective="gap_rmes")
    with pytest.raises(ConfigError, match="seed"):
        cfx.calibrate(pairs, seed=-1)
    with pytest.raises(ConfigError, match="not the class Pairs; a class of yours gets a name"):
        cfx.train(pairs, cfx.Pairs)  # type: ignore[arg-type]  # what is tested
    with pytest.raises(ConfigError, match=r"split: a setting is a text, .*, not a set"):
        cfx.calibrate(pairs, split={0.5})
    with pytest.raises(ConfigError, match=r"metrics: a setting is a text, .*, not a set"):
        cfx.calibrate(pairs, metrics=[{"jerk"}])


TEXTS = ("idm", "1", "true", "null", "", "a b", "it's", "a=b", "x: y", r"c:\d")
NUMPYS = (np.float64(0.1), np.int64(3), np.bool_(True))
VALUES = (0.1, 3, None, True, [1, 2.5], {"T": {"low": 0.5}}, ["a", "b c"], Path("/a b/c"))


@pytest.mark.parametrize("value", [*TEXTS, *VALUES, *NUMPYS])
def test_an_override_means_its_value(value: Any) -> None:
    from hydra.core.override_parser.overrides_parser import OverridesParser

    (found,) = OverridesParser.create().parse_overrides([override("key", value)])
    expected = str(value) if isinstance(value, Path) else value
    assert found.value() == expected


def test_a_job_is_found_again_by_its_configuration(tmp_path: Path) -> None:
    experiment = cfx.config(
        model="krauss",
        policy="fixed",
        experiment="unseen_drivers",
        **{"protocol.base": "default", "windows.length": 7, "model.parameters.t_r.high": 4.0},
    )
    (tmp_path / "config.yaml").write_text(experiment.config.model_dump_json(), encoding="utf-8")
    again = cfx.from_config(tmp_path / "config.yaml")
    assert again.config == experiment.config
    assert "experiment=unseen_drivers" in again.command
    overrides = shlex.split(again.command)[3:]
    changed = dict(one.split("=", 1) for one in overrides)
    assert changed["windows.length"] == "7"
    with pytest.raises(DataError, match="cannot be read"):
        cfx.from_config(tmp_path / "nothing.yaml")


def test_a_grid_of_pairs_and_frames_has_no_rows_beyond_a_pairs_end(pairs: cfx.Pairs) -> None:
    """As xarray holds pairs of different lengths."""
    frame = pairs.frame
    ids = frame["pair_id"].unique()
    frame = frame[(frame["pair_id"] != ids[0]) | (frame["frame"] < frame["frame"].min() + 250)]
    table = frame.set_index(["pair_id", "frame"])
    grid = table.reindex(pd.MultiIndex.from_product(table.index.levels, names=table.index.names))

    class Dataset:
        def to_dataframe(self) -> pd.DataFrame:
            return grid

    settings = {"min_duration": 0, "accelerations": "recorded"}
    expected = cfx.read(frame, **settings).selected.fingerprint
    assert cfx.read(Dataset(), **settings).selected.fingerprint == expected


def test_pairs_say_what_reading_has_left_out(pairs: cfx.Pairs) -> None:
    read = cfx.read(pairs.frame, min_duration=0, max_pairs=1)
    assert repr(read).endswith("from the table; left out: 2 beyond max_pairs (1))")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"gap": -3.0}, r"gap=-3.0: give a number of 0 m or more"),
        ({"gap": float("nan")}, "gap=nan: give a number"),
        ({"speed": "10"}, "speed='10': give a number of 0 m/s or more"),
        ({"parameters": {"T": float("nan")}}, "T is NaN or infinite"),
        ({"leader": LEADER.assign(speed=120.0)}, "speed goes up to 120; give m/s"),
        ({"leader": LEADER.assign(time_s=LEADER["time_s"] * 100)}, "advances by 10 a row"),
    ],
)
def test_a_follower_starts_from_numbers_that_mean_something(
    given: dict[str, Any], said: str
) -> None:
    with pytest.raises(CfxError, match=said):
        cfx.simulate("idm", **{"leader": LEADER, **given})


@pytest.mark.parametrize("given", [None, 3, [1, 2], [], ""])
def test_what_is_no_recording_is_said(given: Any) -> None:
    """Nothing falls back to a recording that nobody asked for."""
    with pytest.raises(ConfigError, match=r"give a (path|file)"):
        cfx.calibrate(given, "idm")
    with pytest.raises(ConfigError, match=r"give a (path|file)"):
        cfx.evaluate("cfx://idm", given)


def test_a_fit_says_whether_it_is_the_optimum(
    pairs: cfx.Pairs, fit: cfx.Fit, tmp_path: Path
) -> None:
    found = cfx.calibrate(pairs, "krauss", **WEAK)
    assert bool((found.ends_apart < 0.01).all())
    again = cfx.Fit.load(found.save(tmp_path / "fit"))
    pd.testing.assert_series_equal(again.ends_apart, found.ends_apart)
    assert found.losses.groupby("method")["ends_apart"].count().to_dict() == {
        "default": 0,
        "driver_specific": 3,
        "pooled": 0,
    }
    assert fit.ends_apart.isna().all()
    assert "ends_apart" not in fit.losses


def test_a_saved_fit_is_read_back_as_a_fit_and_as_a_job(fit: cfx.Fit, tmp_path: Path) -> None:
    folder = fit.save(tmp_path / "fit")
    again = cfx.Fit.load(folder)
    pd.testing.assert_frame_equal(again.parameters, fit.parameters)
    pd.testing.assert_frame_equal(again.losses, fit.losses)
    assert repr(again) == repr(fit)
    assert again.plot("drives", pair_id=fit.parameters.index[0]) is not None
    own = cfx.load(folder).metrics["rmse_gap/driver_specific"]
    losses = fit.losses[fit.losses["method"] == "driver_specific"]
    assert own == pytest.approx(losses["test_rmse_gap"].mean())
    with pytest.raises(DataError, match=r"holds no fit \(that has parameters.parquet"):
        cfx.Fit.load(tmp_path)


def test_what_was_minimised_comes_first(fit: cfx.Fit) -> None:
    assert repr(fit).index("RMSE of gap") < repr(fit).index("RMSE of speed")
    assert fit.result.judge.name == "rmse_gap"


def test_a_fit_drives_other_drivers_with_its_pooled_parameters(fit: cfx.Fit) -> None:
    others = cfx.read(dataset="synthetic", pairs=2, frames=300, seed=5)
    tested = cfx.evaluate(fit, others, **RANDOM)
    assert tested.judge.name == "rmse_gap"  # what the fit minimised
    rows = tested.pairs[tested.pairs["method"] == "pooled"]
    chosen = rows.filter(like="parameter_").rename(columns=lambda one: one[len("parameter_") :])
    for values in chosen[fit.pooled.index].to_numpy():
        np.testing.assert_allclose(values, fit.pooled, rtol=1e-6)
    ahead = cfx.forecast(fit, others, at=10.0, horizon=1.0)
    driven = cfx.simulate(fit.model, fit.pooled, others, at=10.0)
    for pair_id, path in ahead.paths.groupby("pair_id"):
        its = driven[driven["pair_id"] == pair_id].head(len(path))
        np.testing.assert_allclose(path["speed"], its["speed"], rtol=1e-6)


def test_fits_are_compared_by_their_errors_on_the_test_part(fit: cfx.Fit) -> None:
    worse = cfx.calibrate(
        fit.recorded,
        fit.model,
        objective="gap_rmse",
        **{**RANDOM, "optimizer.samples": 2},
    )
    compared = cfx.compare(fit, worse, again=fit)
    assert set(compared.ranking.jobs) == {"idm", "idm'", "again"}
    own = fit.losses[fit.losses["method"] == "driver_specific"]["test_rmse_gap"].mean()
    assert compared.table.loc["idm"].iloc[0] == pytest.approx(own)
    assert "Closest to the drivers" in repr(compared)
    with pytest.raises(ConfigError, match="two fits or results"):
        cfx.compare(fit)


@pytest.mark.parametrize(
    ("given", "named", "said"),
    [
        (1, {"idm": 1}, "another is called 'idm' too"),
        (1, {"other": "outputs/idm"}, "a str is no fit and no result; cfx.load"),
        (1, {}, "give two fits"),
    ],
)
def test_what_cannot_be_compared_is_said(
    fit: cfx.Fit, given: int, named: dict[str, Any], said: str
) -> None:
    others = {name: fit if value == 1 else value for name, value in named.items()}
    with pytest.raises(ConfigError, match=said):
        cfx.compare(*[fit] * given, **others)


def test_a_table_of_parameters_may_have_its_ids_in_a_column(fit: cfx.Fit) -> None:
    from_index = cfx.simulate(fit.model, fit.parameters, fit.recorded)
    from_column = cfx.simulate(fit.model, fit.parameters.reset_index(), fit.recorded)
    pd.testing.assert_frame_equal(from_index, from_column)

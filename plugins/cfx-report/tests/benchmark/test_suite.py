"""Suites of the benchmark: what is asked, files that are scored without code, tables and pages."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import cfx
from cfx.app.cli import main
from cfx.errors import CfxError, ConfigError, DataError
from cfx.plugin import PairBatch, PairSet
from cfx_report.benchmark import opencf, published, watching
from cfx_report.benchmark.board import Entered, lines_of_rows, standings, write_standings
from cfx_report.benchmark.constants import ConstantDriver
from cfx_report.benchmark.entries import entry_of
from cfx_report.benchmark.everything import commands
from cfx_report.benchmark.leaderboard import render
from cfx_report.benchmark.methods import (
    ConstantEntry,
    JobEntry,
    ReadyEntry,
    RivalEntry,
    Training,
)
from cfx_report.benchmark.predictions import FORECASTS, TRAJECTORIES, read
from cfx_report.benchmark.rival import Driver, Rival, Seen, StepDriver
from cfx_report.benchmark.roads import QUICK, ROADS
from cfx_report.benchmark.score import errors_of
from cfx_report.benchmark.segments import segments_of
from cfx_report.benchmark.submission import score_submission
from cfx_report.benchmark.suite import Site
from cfx_report.benchmark.work import Recordings, make_row

SMALL = replace(
    ROADS,
    version="roads-1",  # the table looks a suite up by it
    files=("a.parquet", "b.parquet"),
    sites=(Site("A", "a", "human"), Site("B", "b", "acc")),
    schemes=(ROADS.schemes[0], replace(ROADS.schemes[1], folds=2)),
    min_duration=0,
    horizons=(0.5, 2.0),
    past_s=2.0,
    every_s=5.0,
    samples=4,
    longest=2,
    baseline="keeps",
    about="made up",
)


class Keeps(StepDriver):
    """Follows its leader's speed, and with noise where chance is drawn."""

    every = 5
    is_stochastic = True

    def __init__(self, pull: float) -> None:
        self.pull = pull

    def accelerations(
        self, seen: Seen, memory: torch.Tensor, generator: torch.Generator | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        chosen = self.pull * (seen.leader_speed[:, -1] - seen.follower_speed[:, -1])
        if generator is not None:
            chosen = chosen + 0.3 * torch.randn(len(chosen), generator=generator).double()
        return chosen, memory


class KeepsRival(Rival):
    """A rival that learns nothing."""

    reference = "made up"
    pull = 0.5

    def fit(self, pairs: PairSet, seed: int) -> Driver:
        return Keeps(self.pull)


class Late(KeepsRival):
    """One that reacts less."""

    pull = 0.2


@pytest.fixture(scope="module")
def recordings() -> Recordings:
    """Six synthetic drivers, two pairs each but for one who has three, on two roads."""
    read_pairs = cfx.read(dataset="synthetic", pairs=13, frames=160, min_duration=0).selected
    made = []
    for number, pair in enumerate(read_pairs):
        is_acc = number % 6 >= 3
        made.append(
            replace(
                pair,
                recording="b1" if is_acc else "a1",
                site="road B" if is_acc else "road A",
                driver_type="acc" if is_acc else "",
                vehicle=f"car {number % 6}",
            )
        )
    pairs = SMALL.selected(PairSet(tuple(made), "made up"))
    return Recordings(SMALL, pairs, Path("nowhere"), SMALL.protocol_of(pairs.fingerprint))


@pytest.fixture(scope="module")
def rows(recordings: Recordings, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders of two rows."""
    folder = tmp_path_factory.mktemp("rows")
    made = []
    for name, rival in (("keeps", KeepsRival()), ("late", Late())):
        entry = RivalEntry(name, (f"rival={name}",), rival)
        make_row(entry, recordings, folder / name, 0)
        made.append(folder / name)
    return made


@pytest.fixture(autouse=True)
def _frozen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cfx_report.benchmark.board.SUITES", (SMALL,))


def test_the_protocol_is_the_published_one() -> None:
    assert ROADS.protocol == "roads-1/da779907be25", (
        "rows of docs/benchmark.md are of this protocol"
    )
    assert QUICK.protocol == "roads-1-quick/07716b943a4e"


def test_the_frozen_pairs_are_those_of_the_recordings(shared_data: Path) -> None:
    assert len(QUICK.load(shared_data)) == 16  # raises if the fingerprint is another


def test_the_longest_pairs_of_each_driver_at_a_site_are_taken(recordings: Recordings) -> None:
    pairs = recordings.pairs
    assert len(pairs) == 12
    assert max(list(pairs.drivers).count(driver) for driver in set(pairs.drivers)) == 2
    assert {pair.driver_type for pair in pairs} == {"human", "acc"}
    assert set(SMALL.sites_of(pairs)) == {"A", "B"}


def test_a_tested_driver_is_never_learned_from(recordings: Recordings) -> None:
    for scheme in SMALL.schemes:
        fold = SMALL.folds_of(recordings.pairs, scheme, 0)
        training = Training(SMALL, scheme, recordings.pairs, fold, Path(), Path(), 0)
        for number in range(training.folds):
            learned, tested = training.learned(number), training.tested(number)
            assert not set(learned.drivers) & set(tested.drivers)
            assert len(learned) + len(tested) == 12


def test_what_a_follower_does_later_is_blank(recordings: Recordings) -> None:
    for task in SMALL.tasks:
        segments = segments_of(SMALL, task, list(recordings.pairs))
        blank = segments.blanked()
        later = torch.arange(blank.mask.shape[1]) > segments.first[:, None]
        assert bool(blank.follower_speed[later].isnan().all())
        assert not bool(blank.follower_speed[~later].isnan().any())
        assert not bool(blank.leader_speed.isnan().any())
        if task.kind == "last_part":
            assert len(segments.past[0]) == int(segments.first[0]) + 1 == 128


def test_errors_are_those_of_cfx(recordings: Recordings, rows: list[Path]) -> None:
    """Of the first task, by hand: forward Euler, root mean squares, without the first frame."""
    errors = pd.read_csv(rows[0] / "benchmark_pairs.csv")
    task = SMALL.task("new_road")
    segments = segments_of(SMALL, task, list(recordings.pairs))
    batch = PairBatch.of(recordings.pairs)
    speed = Keeps(0.5).drive(batch, segments.first, None)
    gap = batch.gap[:, :1] + (batch.leader_position - batch.leader_position[:, :1])
    gap = gap[:, 1:] - speed[:, 1:].cumsum(1) * batch.dt
    by_hand = (speed - batch.follower_speed)[:, 1:].square().mean(1).sqrt()
    gap_by_hand = (gap - batch.gap[:, 1:]).square().mean(1).sqrt()
    here = errors[errors["task"] == "new_road"].set_index("pair_id").loc[recordings.pairs.ids]
    np.testing.assert_allclose(here["rmse_speed"], by_hand, rtol=1e-12)
    np.testing.assert_allclose(here["rmse_gap"], gap_by_hand, rtol=1e-9)
    assert set(errors["task"]) == {"new_road", "same_road", "known", "forecast_0.5s", "forecast_2s"}
    forecast = errors[errors["task"] == "forecast_2s"]
    assert forecast["coverage"].between(0, 1).all()
    assert (forecast["crps_speed"] <= forecast["rmse_speed"] + 0.5).all()


def test_a_finished_row_is_not_made_again_and_another_is_refused(
    recordings: Recordings, rows: list[Path]
) -> None:
    class Fails(KeepsRival):
        """Nobody asks it."""

        def fit(self, pairs: PairSet, seed: int) -> Driver:
            raise AssertionError

    before = (rows[0] / "benchmark_pairs.csv").read_bytes()
    make_row(RivalEntry("keeps", ("rival=keeps",), Fails()), recordings, rows[0], 0)
    assert (rows[0] / "benchmark_pairs.csv").read_bytes() == before
    with pytest.raises(ConfigError, match="holds another row"):
        make_row(RivalEntry("keeps", ("rival=keeps",), Fails()), recordings, rows[0], 1)


CARD = {"who": "A. Author", "paper": "none", "licence": "CC0", "trained_on": "road B"}


def card(folder: Path, **changes: object) -> Path:
    path = folder / "card.json"
    path.write_text(json.dumps({**CARD, **changes}))
    return path


def test_a_submission_is_scored_as_the_row_that_made_it(
    recordings: Recordings, rows: list[Path], tmp_path: Path
) -> None:
    files = [rows[0] / TRAJECTORIES, rows[0] / FORECASTS]
    shuffled = pd.read_parquet(files[0]).sample(frac=1.0, random_state=1)
    shuffled["time_s"] += 1e-7  # of other software
    files[0] = tmp_path / "mine.parquet"
    shuffled.to_parquet(files[0])
    row = score_submission(files, card(tmp_path), recordings, tmp_path / "row", "theirs")
    assert row.card == CARD
    theirs = pd.read_csv(tmp_path / "row/benchmark_pairs.csv")
    ours = pd.read_csv(rows[0] / "benchmark_pairs.csv")
    both = ours.merge(theirs, on=["task", "pair_id"], suffixes=("", "_theirs"))
    assert len(both) == len(ours) == len(theirs)
    for metric in ("rmse_speed", "rmse_gap", "collisions", "crps_speed", "coverage"):
        np.testing.assert_allclose(both[metric], both[f"{metric}_theirs"], atol=1e-6)


def test_quantiles_are_scored_too(recordings: Recordings, rows: list[Path]) -> None:
    """Of one value for all levels: the pinball loss of each is weighted alike."""
    samples = pd.read_parquet(rows[0] / FORECASTS)
    labels = ["pair_id", "origin_s", "horizon_s"]
    grouped = samples.groupby(labels)["speed_mps"]
    levels = [0.05, 0.5, 0.95]
    wide = grouped.quantile(np.array(levels)).rename_axis([*labels, "quantile"]).reset_index()
    found = errors_of(SMALL, recordings.pairs, wide, "q")
    assert found["coverage"].notna().all()
    assert (found["crps_speed"] > 0).all()
    narrow = errors_of(SMALL, recordings.pairs, wide[wide["quantile"] == 0.5], "q")
    assert narrow["coverage"].isna().all()
    np.testing.assert_allclose(narrow["rmse_speed"], found["rmse_speed"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.drop(columns="gap_m"), "column gap_m is missing"),
        (lambda t: t.assign(speed_mps=t["speed_mps"].where(t.index != 7)), "row 8, column speed"),
        (lambda t: t.assign(speed_mps=-t["speed_mps"]), "is no number of 0 or more"),
        (lambda t: t.iloc[1:], "0.1 s of pair '.*' is missing, in 'new_road'"),
        (lambda t: pd.concat([t, t.iloc[:1]]), "stands there twice"),
        (lambda t: t.assign(pair_id="x"), "row 1, column pair_id: 'x' is no pair of 'new_road'"),
        (lambda t: t.assign(task="new_rod"), "Did you mean 'new_road'"),
        (lambda t: t.assign(time_s=t["time_s"] + 1000), "row 1, column time_s: .* is not tested"),
    ],
)
def test_a_bad_file_is_one_sentence(
    recordings: Recordings, rows: list[Path], tmp_path: Path, change: object, said: str
) -> None:
    table = pd.read_parquet(rows[0] / TRAJECTORIES)
    changed = change(table[table["task"] == "new_road"].reset_index(drop=True))  # type: ignore[operator]
    changed.to_parquet(tmp_path / "t.parquet")
    with pytest.raises(DataError, match=said) as raised:
        errors_of(SMALL, recordings.pairs, read(tmp_path / "t.parquet"), "t.parquet")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.drop(columns="sample"), "column sample or the column quantile"),
        (lambda t: t.iloc[1:], "a sample at 0.5 s after .* is missing"),
        (lambda t: pd.concat([t, t.iloc[:1]]), "stands there twice"),
        (lambda t: t.assign(origin_s=0.3), "is no moment of 'forecast'"),
        (lambda t: t.rename(columns={"sample": "quantile"}), "is no quantile"),
    ],
)
def test_bad_forecasts_are_one_sentence(
    recordings: Recordings, rows: list[Path], tmp_path: Path, change: object, said: str
) -> None:
    changed = change(pd.read_parquet(rows[0] / FORECASTS))  # type: ignore[operator]
    changed.to_parquet(tmp_path / "t.parquet")
    with pytest.raises(DataError, match=said):
        errors_of(SMALL, recordings.pairs, read(tmp_path / "t.parquet"), "t.parquet")


def test_a_card_says_everything(recordings: Recordings, rows: list[Path], tmp_path: Path) -> None:
    with pytest.raises(DataError, match='"licence" is missing: of the predictions'):
        score_submission(
            [rows[0] / TRAJECTORIES], card(tmp_path, licence=" "), recordings, tmp_path, "x"
        )


def test_a_wrong_submission_is_named_and_leaves_nothing(
    recordings: Recordings, rows: list[Path], tmp_path: Path
) -> None:
    mine = tmp_path / "mine.parquet"
    pd.read_parquet(rows[0] / TRAJECTORIES).iloc[1:].to_parquet(mine)
    with pytest.raises(DataError, match=re.escape(f"{mine}, column")):
        score_submission([mine], card(tmp_path), recordings, tmp_path / "row", "x")
    assert not (tmp_path / "row").exists()


def test_scores_are_relative_to_the_baseline(rows: list[Path]) -> None:
    entered = [Entered.read(folder) for folder in rows]
    for standing in standings(entered):
        scores = standing.table.set_index("row")["score"]
        assert scores["keeps"] == pytest.approx(0.0, abs=1e-12)
        assert scores["late"] != 0.0
        assert list(standing.sites.columns) == ["A", "B"]
    text = "\n".join(lines_of_rows(entered))
    assert "### Unseen drivers of a road that nobody learned from" in text
    assert "Closest to the drivers:" in text
    with pytest.raises(DataError, match="scores are relative to the row 'keeps'"):
        standings(entered[1:])


def test_seeds_of_one_method_are_no_rivals(rows: list[Path]) -> None:
    """A seed with twice the errors stands in its row alone; the verdict takes their mean."""
    keeps, late = (Entered.read(folder) for folder in rows)
    numbers = ["rmse_speed", "crps_speed"]
    doubled = late.errors.assign(**{name: 2 * late.errors[name] for name in numbers})
    meant = late.errors.assign(**{name: 1.5 * late.errors[name] for name in numbers})
    seed = replace(late, row=replace(late.row, name="late, seed 1"), errors=doubled)
    mean = replace(late, errors=meant)
    for two, one in zip(standings([keeps, late, seed]), standings([keeps, mean]), strict=True):
        assert set(two.table["row"]) == {"keeps", "late", "late, seed 1"}
        verdict, _, seeds = two.verdict.partition(" Of rows with several seeds")
        assert seeds
        assert verdict == one.verdict


def test_standings_are_written_with_what_tables_leave_out(rows: list[Path], tmp_path: Path) -> None:
    entered = [Entered.read(folder) for folder in rows]
    write_standings(entered, tmp_path / "rows.json")
    written = json.loads((tmp_path / "rows.json").read_text(encoding="utf-8"))
    assert set(written["commands"]) == {"keeps", "late"}
    for standing in standings(entered):
        lines = written["tasks"][standing.task.name]["rows"]
        assert [line["row"] for line in lines] == standing.table["row"].tolist()
        scores = [line["score"] for line in lines]
        np.testing.assert_allclose(scores, standing.table["score"], atol=1e-6)
    left_out = [name for name in written["tasks"]["forecast"]["rows"][0] if "coverage" in name]
    assert len(left_out) == len(SMALL.horizons)


def test_saved_rows_stand_as_their_folders_do(
    rows: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [str(folder) for folder in rows]
    assert main(["benchmark", "table", *folders]) == 0
    of_folders = capsys.readouterr().out
    saved = str(tmp_path / "rows.parquet")
    assert main(["benchmark", "table", *folders, "--save", saved]) == 0
    capsys.readouterr()
    assert main(["benchmark", "table", saved]) == 0
    assert capsys.readouterr().out == of_folders
    # A row of one's own beside those of others.
    assert main(["benchmark", "table", saved, folders[0]]) == 2
    assert "two rows are called 'keeps'" in capsys.readouterr().err
    table = pd.DataFrame({"row": ["keeps"]})
    table.to_parquet(saved)
    assert main(["benchmark", "table", saved]) == 2
    assert "is no file of rows" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["benchmark", "table", *folders, "--save", "rows.csv"])
    assert "ends in .parquet" in capsys.readouterr().err


def test_the_page_is_one_file_with_drives(rows: list[Path]) -> None:
    page = render([Entered.read(folder) for folder in rows])
    assert page.count("<svg") == 2
    drives = pd.read_parquet(rows[0] / "drives.parquet")
    errors = pd.read_csv(rows[0] / "benchmark_pairs.csv")
    of_task = errors[errors["task"] == "new_road"]["rmse_speed"]
    assert drives["rmse_speed"].max() == pytest.approx(of_task.max())
    worst = drives[drives["drive"] == "worst"]
    square = (worst["driven"] - worst["recorded"]) ** 2
    assert math.sqrt(square.mean()) == pytest.approx(of_task.max())
    assert page.count('class="sortable') == 8
    assert "http" not in page.replace("http://www.w3.org", "").replace("http-equiv", "")
    assert "late" in page


def test_watching_tests_the_same_frames(
    recordings: Recordings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "_LEAST_S", 2.0)
    entry = RivalEntry("keeps", ("rival=keeps",), KeepsRival())
    found = watching.watch(entry, recordings, tmp_path, 0, (0.0, 5.0))
    errors = found.pivot_table("rmse_speed", "pair_id", "watched_s")
    # This rival reads nothing of the past, so that watching brings nothing.
    np.testing.assert_allclose(errors[0.0], errors[5.0])
    assert len(errors) == 12
    assert "| 5 | " in "\n".join(watching.lines(found))
    with pytest.raises(DataError, match="no pair lasts 101 s"):
        watching.watch(entry, recordings, tmp_path, 0, (0.0, 99.0))


def test_what_is_tested_on_a_published_split_is_not_learned_from(recordings: Recordings) -> None:
    tested = recordings.pairs.take([0, 1])
    learned_from = []

    class Remembers(KeepsRival):
        """Says from whom it learns."""

        def fit(self, pairs: PairSet, seed: int) -> Driver:
            learned_from.extend(pairs.ids)
            return Keeps(0.5)

    entry = RivalEntry("r", ("rival=r",), Remembers())
    found = published.scores(entry, recordings.pairs, tested, 0)
    assert not set(learned_from) & set(tested.ids)
    assert len(learned_from) == 10
    np.testing.assert_allclose(found["mse_sum"], found["rmse_speed"] ** 2 + found["rmse_gap"] ** 2)
    text = "\n".join(published.lines(published.SPLITS["transfollower"], "r", found))
    assert "| IDM, theirs | 17.650 |" in text
    assert "These are 2 pairs, and 202 were published" in text
    with pytest.raises(DataError, match="nothing is left to learn from"):
        published.scores(entry, tested, tested, 0)
    with pytest.raises(ConfigError, match="has to learn"):
        published.scores(entry, None, tested, 0)


def test_an_opencf_submission(recordings: Recordings, tmp_path: Path) -> None:
    parts = []
    for number, pair in enumerate(recordings.pairs[:2]):
        time = np.arange(len(pair)) * 0.1
        known = time <= 2.9 + 1e-9
        columns = {
            "CF_pair_id": number + 7,
            "Time": time,
            "leader_dist": pair.leader_position + 50.0,
            "leader_speed": pair.leader_speed,
            "leader_acceleration": pair.leader_acceleration,
            "follower_dist": np.where(known, pair.follower_position + 50.0, np.nan),
            "follower_speed": np.where(known, pair.follower_speed, np.nan),
        }
        parts.append(pd.DataFrame(columns))
    pd.concat(parts).to_csv(tmp_path / "test_input.csv", index=False)
    entry = RivalEntry("keeps", ("rival=keeps",), KeepsRival())
    written = opencf.write_opencf(
        entry, None, tmp_path / "test_input.csv", tmp_path / "o.csv", 3, 0
    )
    assert written == 2
    table = pd.read_csv(tmp_path / "o.csv")
    assert list(table.columns) == list(opencf.COLUMNS)
    assert set(table["CF_pair_id"]) == {7, 8}
    assert set(table["sample_id"]) == {0, 1, 2}
    one = table[(table["CF_pair_id"] == 7) & (table["sample_id"] == 0)]
    assert one["Time"].tolist() == pytest.approx(list(np.arange(30, 160) * 0.1))
    # Distances are the integral of speeds, from the last known one on.
    pair = recordings.pairs[0]
    moved = np.diff(np.append(pair.follower_position[29] + 50.0, one["follower_dist"]))
    np.testing.assert_allclose(moved, 0.1 * one["follower_speed"], atol=1e-9)
    accelerations = np.diff(np.append(pair.follower_speed[29], one["follower_speed"])) / 0.1
    np.testing.assert_allclose(one["follower_acceleration"], accelerations, atol=1e-9)
    pd.concat(parts).drop(columns="leader_speed").to_csv(tmp_path / "bad.csv")
    with pytest.raises(DataError, match="column leader_speed is missing"):
        opencf.read_opencf(tmp_path / "bad.csv")


def test_constant_parameters_are_watched_before_a_row_of_them_is_made(
    recordings: Recordings,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """They are drawn towards the pooled ones, as strongly as served others; or as one says."""
    monkeypatch.setattr(watching, "_LEAST_S", 2.0)
    watched = {}
    for prior in ((), ("calibration.prior=1000",)):
        settings = ("model=idm", "optimizer=random", "optimizer.samples=32", *prior)
        entry = ConstantEntry("idm", settings, settings)
        errors = watching.watch(entry, recordings, tmp_path / f"new{len(prior)}", 0, (0.0, 5.0))
        watched[prior] = errors.pivot_table("rmse_speed", "pair_id", "watched_s")
        said = "strength" in capsys.readouterr().out
        assert said == (not prior)
        assert (watched[prior][0.0] != watched[prior][5.0]).all()
    assert (watched[()][5.0] != watched[prior][5.0]).all()


def test_the_strength_is_the_one_that_serves_others_best(recordings: Recordings) -> None:
    class OneServes(ConstantDriver):
        """With one strength of the prior it follows its leader, with others it does not."""

        def drawn_back(self, past: PairSet, seed: int, strength: float) -> Driver:
            assert {round(pair.duration, 1) for pair in past} == {2.1}
            return Keeps(0.5 if strength == watching.STRENGTHS[2] else 0.0)

    parameters = cfx.calibrate_pooled(recordings.pairs, optimizer="random")
    driver = OneServes({"model": "idm"}, parameters)
    pairs = list(recordings.pairs)
    strength = watching.best_strength(SMALL, driver, pairs, 8.0, 2.0, 0)
    assert strength == watching.STRENGTHS[2]


def test_what_enters(monkeypatch: pytest.MonkeyPatch) -> None:
    cfx.core.registry.add("rival", "keeps", KeepsRival)
    entry = entry_of(None, ["rival=keeps"], None, 1)
    assert isinstance(entry, RivalEntry)
    assert entry.name == "keeps, seed 1"
    job = entry_of("closed_loop", ["model=idm", "tracking.enabled=false"], None, 0)
    assert isinstance(job, JobEntry)
    assert (job.name, job.words) == (
        "idm, closed loop",
        ("experiment=unseen_drivers", "model=idm"),
    )
    assert job.overrides == (*job.words, "tracking.enabled=false")
    constant = entry_of(None, ["model=idm", "optimizer.samples=64", "cores=1"], None, 0)
    assert isinstance(constant, ConstantEntry)
    assert constant.words == ("policy=fixed", "model=idm", "optimizer.samples=64")
    needs_job = entry_of(None, ["model=idm", "tracking.enabled=false"], None, 0)
    assert isinstance(needs_job, JobEntry)
    ready = entry_of(None, ["driver=cfx://idm"], None, 0)
    assert isinstance(ready, ReadyEntry)
    for words, said in (
        (["rival=keeps", "model=idm"], "beside rival= stand its settings alone"),
        (["driver=cfx://idm", "model=idm"], "stands alone"),
        (["model=idm", "seed=3"], "are the benchmark's"),
        (["rival=kept"], "keeps"),
    ):
        with pytest.raises(CfxError, match=said):
            entry_of(None, words, None, 0)


def test_constant_parameters_are_those_of_a_job(recordings: Recordings, tmp_path: Path) -> None:
    """A job calibrates driver-specific parameters too, and tests and draws; they are not asked."""
    some = ("policy=fixed", "model=idm", "optimizer=random", "optimizer.samples=32")
    settings = (*some, "calibration.prior=weak")
    quiet = ("tracking.enabled=false", "figures=none")
    tables = {}
    for name, entry in (
        ("alone", ConstantEntry("alone", settings, settings)),
        ("job", JobEntry("job", settings, (*settings, *quiet))),
    ):
        make_row(entry, recordings, tmp_path / name, 0)
        tables[name] = pd.read_csv(tmp_path / name / "benchmark_pairs.csv").drop(columns="row")
    pd.testing.assert_frame_equal(tables["alone"], tables["job"], check_exact=True)
    assert not (tmp_path / "alone/jobs").exists()


def test_all_rows_have_a_command_each(monkeypatch: pytest.MonkeyPatch) -> None:
    from cfx_report.benchmark.command import BenchmarkCommand

    options = BenchmarkCommand().parse(["--suite", "roads", "--all", "--data", "D", "--quick"])
    lines = [" ".join(words) for words in commands(options)]
    assert lines[0] == "model=idm --suite roads --data D --quick"
    assert len(lines) == len(set(lines))
    assert sum("--seed 1" in line for line in lines) == sum("--seed 0" in line for line in lines)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--seed", "1"], "i80 freezes the seed 0"),
        (["--quick"], "--quick: i80 is one recording"),
        (["model=idm", "--submission", "a.parquet"], "takes the place of a method"),
        (["--submission", "a.parquet"], "--card FILE is needed"),
    ],
)
def test_options_that_do_not_fit(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["benchmark", "--data", "x", *words])
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_a_missing_recording_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["benchmark", "--suite", "roads", "rival=keeps", "--data", str(tmp_path)]
    cfx.core.registry.add("rival", "keeps", KeepsRival)
    assert main(command) == 2
    assert "i80_reconstructed_pairs.parquet is missing" in capsys.readouterr().err


@pytest.mark.slow
def test_a_model_of_cfx_drives_as_its_job_says(recordings: Recordings, tmp_path: Path) -> None:
    """Errors over full trajectories are those of the job's own table."""
    words = ["model=krauss", "optimizer=random", "tracking.enabled=false", "figures=none"]
    make_row(entry_of(None, words, None, 0), recordings, tmp_path / "row", 0)
    errors = pd.read_csv(tmp_path / "row/benchmark_pairs.csv")
    job = pd.read_csv(tmp_path / "row/jobs/new_road/pairs.csv")
    pooled = job[job["method"] == "pooled"].set_index("pair_id")
    here = errors[errors["task"] == "new_road"].set_index("pair_id").loc[pooled.index]
    np.testing.assert_allclose(here["rmse_speed"], pooled["full_trajectory_rmse_speed"], rtol=1e-6)
    known = errors[errors["task"] == "known"].set_index("pair_id")["rmse_speed"]
    assert not np.allclose(known.loc[pooled.index], pooled["rmse_speed"])  # their own constants

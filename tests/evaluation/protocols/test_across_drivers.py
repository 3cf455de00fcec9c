"""Cross-validation over drivers: folds, what each network learns from, and the test frames."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import gmean

import cfx
from cfx.calibration.cache import Cache
from cfx.calibration.calibrator import Calibrator
from cfx.calibration.random_search import RandomSearch
from cfx.calibration.shards import Solver
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.signals import RECORDED
from cfx.data.tidy import write_tidy
from cfx.errors import DataError
from cfx.evaluation.protocols.across_drivers import AcrossDrivers
from cfx.evaluation.protocols.folds import Together, describe_folds
from cfx.evaluation.result import Purpose
from cfx.learners.base import TrainingData, TrainingResult
from cfx.learners.rollout import RolloutLearner
from cfx.models.krauss import Krauss
from cfx.policies.base import Policy
from cfx.policies.constant import DefaultPolicy, FixedPolicy
from cfx.policies.core import Ensemble
from cfx.policies.gru import GruPolicy
from cfx.policies.prediction import networks_for
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.synthetic import SyntheticDataset
from cfx.simulation.windows import Split, WindowSettings
from cfx_contracts import protocols
from tests.drives import straight_pairs, wavy_pairs
from tests.histories import observed

QUICK = [
    "debug=quick",
    "data.max_pairs=null",
    "data.pairs=6",
    "data.platoon_size=1",
    "data.frames=200",
    "figures=none",
    "tracking.enabled=false",
    "calibration.prior=none",
]


def chained(*followed: tuple[str, str]) -> PairSet:
    """Pairs of (leader, follower)."""
    pairs = straight_pairs([100] * len(followed))
    return PairSet(
        tuple(
            replace(pair, leader_id=leader, follower_id=own)
            for pair, (leader, own) in zip(pairs, followed, strict=True)
        ),
        "test",
    )


def test_no_driver_is_on_both_sides() -> None:
    # Driver 3 follows three leaders.
    pairs = chained(
        ("1", "2"), ("2", "3"), ("8", "3"), ("9", "3"), ("3", "4"), ("4", "5"), ("5", "6")
    )
    fold = AcrossDrivers(folds=3).folds(pairs, seed=0)
    assert set(fold.tolist()) == {0, 1, 2}
    assert (
        len({int(k) for k, pair in zip(fold, pairs, strict=True) if pair.follower_id == "3"}) == 1
    )


def test_a_platoon_stays_together_if_wanted() -> None:
    pairs = chained(("1", "2"), ("2", "3"), ("3", "4"), ("11", "12"), ("12", "13"), ("21", "22"))
    fold = AcrossDrivers(folds=3, together="platoon").folds(pairs, seed=0).tolist()
    assert len(set(fold[:3])) == len(set(fold[3:5])) == 1
    assert len(set(fold)) == 3
    apart = AcrossDrivers(folds=3).folds(pairs, seed=0).tolist()
    assert len(set(apart[:3])) > 1


def in_recordings(*names: str, frames: int = 100) -> PairSet:
    """A pair of another driver in each of these recordings; their numbers there are the same."""
    pairs = straight_pairs([frames] * len(names))
    return PairSet(
        tuple(
            replace(pair, recording=name, follower_id=str(names[:k].count(name)))
            for k, (pair, name) in enumerate(zip(pairs, names, strict=True))
        ),
        "test",
    )


def test_recordings_stay_whole_if_wanted() -> None:
    pairs = in_recordings("morning", "noon", "morning", "evening", "noon", "morning", "evening")
    fold = AcrossDrivers(folds=3, together="recording").folds(pairs, seed=0).tolist()
    of = {pair.recording: k for pair, k in zip(pairs, fold, strict=True)}
    assert sorted(of.values()) == [0, 1, 2]
    assert [of[pair.recording] for pair in pairs] == fold


def at_sites(*drives: tuple[str, str, str]) -> PairSet:
    """Pairs by site, vehicle and what drives it; each is a recording of its own."""
    pairs = straight_pairs([100] * len(drives))
    return PairSet(
        tuple(
            replace(pair, recording=str(k), site=site, vehicle=vehicle, driver_type=kind)
            for k, (pair, (site, vehicle, kind)) in enumerate(zip(pairs, drives, strict=True))
        ),
        "test",
    )


def test_each_site_is_left_out_once() -> None:
    pairs = at_sites(("road", "", ""), ("track", "Kia", "acc"), ("road", "", ""), ("city", "", ""))
    fold = AcrossDrivers(folds=None, together="site").folds(pairs, seed=0).tolist()
    assert fold[0] == fold[2]
    assert sorted({fold[0], fold[1], fold[3]}) == [0, 1, 2]


@pytest.mark.parametrize(
    ("sites", "together", "others"),
    [
        (("road", "track"), "site", "1 other site"),
        (("road", "track", "city"), "site", "2 other sites"),
        (("road", "track", "city"), "driver", "2 other folds"),
    ],
)
def test_it_is_said_what_constants_are_pooled_over(
    sites: tuple[str, ...], together: Together, others: str
) -> None:
    pairs = at_sites(*((site, "", "") for site in sites))
    described = describe_folds(pairs, torch.arange(len(pairs)), together)
    assert described["pooled_over"] == others
    assert described["recordings_per_fold"] == [[pair.recording] for pair in pairs]


def test_all_drives_of_a_car_stay_together_if_wanted() -> None:
    pairs = at_sites(
        ("road", "Kia", "acc"), ("track", "Kia", "human"), ("track", "VW", "acc"), ("road", "", "")
    )
    fold = AcrossDrivers(folds=None, together="vehicle").folds(pairs, seed=0).tolist()
    assert fold[0] == fold[1]
    assert sorted({fold[0], fold[2], fold[3]}) == [0, 1, 2]


@pytest.mark.parametrize("together", ["site", "recording"])
def test_a_car_is_not_tested_by_what_learned_from_it_elsewhere(together: str) -> None:
    pairs = at_sites(("road", "Kia", "acc"), ("track", "Kia", "acc"), ("city", "VW", "acc"))
    with pytest.raises(DataError, match=r"'Kia \(acc\)' drives in 0 and in 1.*together=vehicle"):
        AcrossDrivers(folds=None, together=together).folds(pairs, seed=0)


def test_one_site_alone_cannot_be_left_out() -> None:
    with pytest.raises(DataError, match=r"only 1 site \(name those of its recordings with data"):
        AcrossDrivers(folds=None, together="site").folds(
            at_sites(("", "", ""), ("", "", "")), seed=0
        )


def test_short_pairs_of_a_tested_recording_are_learned_from_elsewhere_only() -> None:
    long, short = in_recordings("a", "b", "a", "b"), in_recordings("a", "c", frames=50)
    shorter = [
        replace(pair, pair_id=f"short {k}", follower_id=f"short {k}")
        for k, pair in enumerate(short)
    ]
    fold = (
        AcrossDrivers(folds=2, together="recording", min_test_duration=10)
        .folds(PairSet((*long, *shorter), "test"), seed=0)
        .tolist()
    )
    assert fold[0] == fold[2] != fold[1] == fold[3]
    assert fold[4] == -2 - fold[0]
    assert fold[5] == -1


def test_folds_follow_the_seed() -> None:
    pairs = chained(*((str(k), str(k + 1)) for k in range(20)))
    protocol = AcrossDrivers()
    assert protocol.folds(pairs, seed=1).equal(protocol.folds(pairs, seed=1))
    assert not protocol.folds(pairs, seed=1).equal(protocol.folds(pairs, seed=2))
    assert np.bincount(protocol.folds(pairs, seed=1).numpy()).tolist() == [4] * 5


def test_too_few_drivers_are_refused() -> None:
    with pytest.raises(
        DataError, match=r"protocol\.folds=5: test has only 3 drivers here; lower protocol\.folds"
    ):
        AcrossDrivers().folds(chained(("1", "2"), ("2", "3"), ("3", "4"), ("9", "4")), seed=0)
    with pytest.raises(DataError, match="only 1 platoon here"):
        AcrossDrivers(folds=2, together="platoon").folds(chained(("1", "2"), ("2", "3")), seed=0)
    with pytest.raises(
        DataError,
        match=r"only 2 recordings here; lower protocol.folds \(2 at least\) or use more recordings",
    ):
        AcrossDrivers(folds=5, together="recording").folds(in_recordings("a", "b", "a"), seed=0)


def calibrator(memory: int = 1 << 28, samples: int = 256) -> Calibrator:
    return Calibrator(
        Solver(MemoryStepper(Krauss(), 0.1), RandomSearch(samples=samples), seed=0, memory=memory),
        cache=Cache(None),
    )


def test_the_populations_parameters_fit_all_their_drivers() -> None:
    """Drivers who are all alike are found as one."""
    truth = torch.tensor([[1.7, 0.3]] * 4 + [[4.0, 0.3]], dtype=torch.float64)
    pairs = wavy_pairs(Krauss(), truth)
    ensemble_size = torch.tensor([[True] * 4 + [False], [False, False, False, False, True]])
    last = torch.full((5,), 250)
    found = calibrator(samples=2048).pooled(pairs, PairBatch.of(pairs), last, ensemble_size)
    assert found[:, 0].tolist() == pytest.approx([1.7, 4.0], abs=0.1)


def test_full_trajectories_belong_to_training() -> None:
    pairs = straight_pairs([101, 83])
    split = Split.none(pairs, WindowSettings())
    assert split.frame.tolist() == [100, 82]
    assert split.windows.tolist() == [20, 16]
    assert split[torch.tensor([1, 1])].windows.tolist() == [16, 16]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> cfx.plugin.Result:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("across"))
        platoons = "data.platoon_size=4"  # drivers follow one another across folds
        across = ["protocol=across_drivers", "protocol.folds=3", "learner.epochs=5"]
        return cfx.run([*QUICK, platoons, *across])


def test_all_methods_are_simulated_over_the_same_frames(result: cfx.plugin.Result) -> None:
    methods = ["default", "pooled", "driver_specific", "policy"]
    assert result.pairs.groupby("pair_id")["method"].apply(list).tolist() == [methods] * 6
    by_pair = result.pairs.groupby("pair_id")[["frames", "fold"]]
    assert by_pair.min().equals(by_pair.max())
    assert set(result.pairs["fold"]) == {0, 1, 2}
    population = result.pairs[result.pairs.method == "pooled"]
    by_fold = population.groupby("fold")["parameter_t_r"]
    assert by_fold.min().equals(by_fold.max()), "one set for all drivers of a fold"
    assert len(set(population["parameter_t_r"])) > 1


def test_every_baseline_has_its_improvement(result: cfx.plugin.Result) -> None:
    policy = result.pairs[result.pairs.method == "policy"].set_index("pair_id")
    for baseline, key in (
        ("driver_specific", "improvement/rmse_speed/driver_specific"),
        ("pooled", "improvement/rmse_speed/pooled"),
    ):
        before = result.pairs[result.pairs.method == baseline].set_index("pair_id")
        gain = (before.rmse_speed - policy.rmse_speed) / before.rmse_speed
        geometric = 1 - gmean(1 - gain)
        assert result.metrics[f"{key}/geometric"] == pytest.approx(geometric)
        assert result.metrics[f"{key}/mean_ratio"] == pytest.approx(gain.mean())
        column = f"improvement_over_{baseline}"
        assert policy[column].to_numpy() == pytest.approx(gain.to_numpy())
        whole = (
            before.full_trajectory_rmse_speed - policy.full_trajectory_rmse_speed
        ) / before.full_trajectory_rmse_speed
        if baseline == "pooled":
            assert result.metrics[
                "full_trajectory/improvement/rmse_speed/pooled/geometric"
            ] == pytest.approx(1 - gmean(1 - whole))
        else:
            assert whole.isna().all(), (
                "driver-specific parameters have seen the first part of the trajectory"
            )
    assert result.metrics["full_trajectory/rmse_gap/default"] > 0
    assert "full_trajectory/rmse_speed/driver_specific" not in result.metrics


def test_the_design_is_written_down(result: cfx.plugin.Result) -> None:
    notes = json.loads((result.folder / "data.json").read_text())["protocol"]
    assert (notes["folds"], notes["drivers"], notes["drivers_per_fold"]) == (3, 6, [2, 2, 2])
    assert 0 < notes["test_pairs_behind_a_training_driver"] <= 6


def test_trajectories_and_curves_are_kept(result: cfx.plugin.Result) -> None:
    drives = pd.read_parquet(result.folder / "trajectories.parquet")
    row = result.pairs[(result.pairs.method == "pooled")].iloc[0]
    own = drives[drives.pair_id == row.pair_id].iloc[1:]
    assert len(own) == row.frames
    assert math.sqrt(((own.speed_pooled - own.real_speed) ** 2).mean()) == pytest.approx(
        row.rmse_speed
    )
    assert {"t_r_policy", "t_i_driver_specific", "gap_default", "leader_speed", "real_gap"} <= set(
        own.columns
    )
    curves = pd.read_parquet(result.folder / "curves.parquet")
    assert set(curves.network) == {"fold 0", "fold 1", "fold 2", "all"}
    assert result.metrics["validation_loss/best"] == pytest.approx(
        curves.groupby("network").validation_loss.min().mean()
    )


def test_the_saved_policy_drives_unseen_drivers(result: cfx.plugin.Result) -> None:
    policy = cfx.load(result.folder).policy
    unseen = SyntheticDataset(pairs=2, frames=100, seed=9).load()
    assert networks_for(policy, unseen).tolist() == [3, 3]


def test_what_a_test_driver_does_changes_nothing_that_is_learned_for_them() -> None:
    """Another trajectory of a driver changes other folds' networks, never that of their own."""
    pairs = protocols.recording()
    slower: dict[str, Any] = {"follower_speed": pairs[0].follower_speed * 0.9}
    changed = replace(pairs, pairs=(replace(pairs[0], **slower), *pairs.pairs[1:]))
    before, after = (
        AcrossDrivers(folds=3, histories=()).run(protocols.context(one)) for one in (pairs, changed)
    )
    first, second = before.evaluation.table, after.evaluation.table
    fold = int(first.fold.iloc[0])
    assert fold == int(second.fold.iloc[0])
    one, two = before.policy.core.network.state_dict(), after.policy.core.network.state_dict()
    assert all(torch.equal(one[key][fold], two[key][fold]) for key in one)
    others = [k for k in range(3) if k != fold]
    assert all(any(not torch.equal(one[key][k], two[key][k]) for key in one) for k in others)
    same = (first.method == "pooled") & (first.fold == fold)
    columns = ["fold", "parameter_t_r"]
    pd.testing.assert_frame_equal(first[same][columns], second[same][columns])


@pytest.mark.parametrize("policy", [FixedPolicy(), DefaultPolicy()])
def test_a_baseline_as_policy_is_no_method_of_its_own(policy: Policy) -> None:
    context = protocols.context(protocols.recording(), policy=policy)
    found = AcrossDrivers(folds=2).run(context).evaluation
    found = replace(found, purpose=Purpose.of(Krauss(), policy)).distinct_methods()
    assert "rmse_speed/policy" not in found.metrics()
    assert set(found.table["method"]) == {"default", "pooled", "driver_specific"}


def test_short_pairs_are_learned_from_but_not_tested() -> None:
    """They change no fold of the others; no fold learns from a short pair of a driver it tests."""
    long = chained(*((str(k), str(k + 100)) for k in range(10)))
    extra = straight_pairs([60, 60])
    # One of a driver who is tested too, one of somebody else.
    short = (
        replace(extra[0], pair_id="s0", leader_id="77", follower_id="103"),
        replace(extra[1], pair_id="s1", leader_id="78", follower_id="500"),
    )
    pairs = PairSet((*long.pairs, *short), "test")
    protocol = AcrossDrivers(min_test_duration=10)
    fold = protocol.folds(pairs, seed=0)
    assert fold[:10].equal(AcrossDrivers().folds(long, seed=0))
    assert int(fold[10]) == -2 - int(fold[3])
    assert int(fold[11]) == -1


def test_too_few_long_pairs_are_refused() -> None:
    with pytest.raises(
        DataError, match=r"has only 0 drivers.*lower protocol\.min_test_duration=500 or"
    ):
        AcrossDrivers(min_test_duration=500).folds(chained(("1", "2"), ("2", "3")), seed=0)


def rollout(folder: Path, *changes: str) -> cfx.plugin.Result:
    small = [
        "learner=rollout",
        "learner.ensemble_size=2",
        "learner.epochs=2",
        "learner.steps=4",
        "learner.horizon=8",
        "protocol.folds=2",
    ]
    return cfx.run([*QUICK, "protocol=across_drivers", *small, f"hydra.run.dir={folder}", *changes])


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> cfx.plugin.Result:
    """A job that learns by rollout, and compares amounts of history."""
    folder = tmp_path_factory.mktemp("rollout") / "one"
    return rollout(folder, "protocol.histories=[0,5]", "data.platoon_size=4")


def test_a_job_learns_by_rollout_and_measures_how_much_history_matters(
    learned: cfx.plugin.Result,
) -> None:
    history = pd.read_parquet(learned.folder / "history.parquet")
    assert set(history["base"]) == {"driver_specific", "pooled"}
    assert list(dict.fromkeys(history["amount"])) == ["0 s", "5 s", "80 %"]
    whole = history[
        (history["base"] == "driver_specific") & (history["amount"] == "80 %")
    ].set_index("pair_id")["rmse_speed"]
    policy = learned.pairs[learned.pairs["method"] == "policy"].set_index("pair_id")["rmse_speed"]
    pd.testing.assert_series_equal(whole, policy, check_names=False, rtol=1e-9)
    again = cfx.load(learned.folder).policy
    assert again.base is not None
    assert torch.equal(again.base, learned.policy.base)  # type: ignore[arg-type]  # it has one
    assert again.context_rule.shrinkage == learned.policy.context_rule.shrinkage == 0.7
    assert isinstance(again.core.network, Ensemble)
    assert again.core.network.size == 2
    kept = learned.policy.core.network.state_dict()
    assert all(
        torch.equal(value, kept[key]) for key, value in again.core.network.state_dict().items()
    )
    assert {
        "hard_braking/policy",
        "jerk/policy",
        "at_bounds/policy",
        "platoon/collisions/policy",
    } <= learned.metrics.keys()


def test_less_history_is_what_the_plot_says(learned: cfx.plugin.Result, tmp_path: Path) -> None:
    none = ["protocol.history=0", "protocol.histories=[]"]
    other = rollout(tmp_path / "other", *none, "data.platoon_size=4")
    history = pd.read_parquet(learned.folder / "history.parquet")
    without = history[(history["base"] == "driver_specific") & (history["amount"] == "0 s")][
        "rmse_speed"
    ]
    policy = other.pairs[other.pairs["method"] == "policy"]["rmse_speed"].to_numpy()
    np.testing.assert_allclose(without, policy, rtol=1e-9)
    assert not np.allclose(learned.pairs[learned.pairs["method"] == "policy"]["rmse_speed"], policy)


@pytest.mark.parametrize(
    ("base", "shrinkage", "method"),
    [
        ("driver_specific", 0, "driver_specific"),
        ("driver_specific", 0.7, "shrunk"),
        ("driver_specific", 1, "default"),
        ("pooled", 0.7, "pooled"),
        ("default", 0.7, "default"),
    ],
)
def test_without_learning_the_policy_is_its_base(base: str, shrinkage: float, method: str) -> None:
    still = RolloutLearner(
        epochs=1, steps=1, horizon=2, ensemble_size=1, learning_rate=1e-12, weight_decay=0
    )
    protocol = AcrossDrivers(folds=2, base=base, shrinkage=shrinkage, histories=())
    found = protocol.run(protocols.context(protocols.recording(), learner=still)).evaluation
    rmse = found.table.set_index(["method", "pair_id"])["rmse_speed"]
    np.testing.assert_allclose(rmse["policy"], rmse[method], rtol=1e-5)
    # What drawing does on its own is shown where it was done.
    is_drawn = base == "driver_specific" and shrinkage > 0
    assert ("shrunk" in rmse.index.get_level_values(0)) == is_drawn
    assert ("improvement/rmse_speed/shrunk/geometric" in found.metrics()) == is_drawn
    assert "history" not in found.tables


def test_a_policy_reaches_farther_than_constant_parameters(tmp_path: Path) -> None:
    """Its base stays, its answers may leave the bounds of constant ones; saved equals loaded."""
    still = [
        "learner.epochs=1",
        "learner.steps=1",
        "learner.learning_rate=1e-12",
        "learner.weight_decay=0",
        "protocol.histories=[]",
    ]
    result = rollout(
        tmp_path / "one",
        "model.adaptation_bounds={t_r: [0.05, 60]}",
        "protocol.base=pooled",
        *still,
    )
    rmse = result.pairs.set_index(["method", "pair_id"])["rmse_speed"]
    np.testing.assert_allclose(rmse["policy"], rmse["pooled"], rtol=1e-5)
    for policy in (result.policy, cfx.load(tmp_path / "one").policy):
        largest = float(Krauss().space["t_r"].high)
        assert policy.space["t_r"].high == 60 > largest
        for weights in policy.core.network.parameters():
            weights.data.fill_(0.0)
        policy.core.network.get_parameter("members.b_out").data.fill_(
            20.0
        )  # as large an answer as there is
        silence = observed(
            *(torch.zeros((1, policy.windows.length), dtype=torch.float64) for _ in range(5))
        )
        anywhere = replace(policy, valid_range=None)  # it has learned nothing from silence
        answer, _ = anywhere.act(silence, anywhere.begin(torch.zeros(1, dtype=torch.long)))
        assert float(policy.space.unpack(answer)["t_r"]) == pytest.approx(60, rel=1e-3)


def test_a_reach_without_offsets_is_said_to_change_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    short = [
        "protocol=across_drivers",
        "protocol.folds=2",
        "learner.epochs=1",
        f"hydra.run.dir={tmp_path / 'one'}",
    ]
    result = cfx.run([*QUICK, *short, "model.adaptation_bounds={t_r: [0.05, 60]}"])
    assert "model.adaptation_bounds changes nothing here" in caplog.text
    assert result.policy.space == Krauss().space


class EnoughError(Exception):
    """Nothing after it is looked at."""


class Unwilling(RolloutLearner):
    """Ends a job where training would begin."""

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        raise EnoughError


def warnings_of(
    caplog: pytest.LogCaptureFixture,
    policy: Policy | None = None,
    cold_start_fraction: float = 0.5,
    **options: Any,
) -> str:
    """Returns what a protocol warns of before it trains."""
    learner = Unwilling(cold_start_fraction=cold_start_fraction)
    job = protocols.context(protocols.recording(), policy=policy, learner=learner)
    with pytest.raises(EnoughError):
        AcrossDrivers(folds=2, **options).run(job)
    return caplog.text


@pytest.mark.parametrize(
    ("options", "warned"),
    [
        ({"cold_start_fraction": 1.0}, True),
        ({"cold_start_fraction": 1.0, "history": 0}, True),  # and 10 and 30 s, for comparison
        ({"cold_start_fraction": 1.0, "history": 0, "histories": ()}, False),
        ({"cold_start_fraction": 0.9}, False),
    ],
)
def test_a_burn_in_without_history_in_training_is_warned_of(
    caplog: pytest.LogCaptureFixture, options: dict[str, Any], warned: bool
) -> None:
    said = warnings_of(caplog, **options)
    assert ("with history before it" in said) == warned


@pytest.mark.parametrize(
    ("options", "warned"),
    [
        ({"history": 0}, True),
        ({"cold_start_fraction": 1.0, "histories": ()}, True),
        ({}, False),
    ],
)
def test_driver_features_without_history_are_warned_of(
    caplog: pytest.LogCaptureFixture, options: dict[str, Any], warned: bool
) -> None:
    said = warnings_of(caplog, GruPolicy(driver_features="all"), **options)
    assert ("policy.driver_features are measured from a driver's history" in said) == warned


def test_trajectories_that_are_too_short_to_test_change_what_is_learned(tmp_path: Path) -> None:
    """All pairs are calibrated and learned from, the long ones alone stand in the results."""
    frames = [160, 200, 200, 200, 200]
    pairs = wavy_pairs(
        Krauss(),
        torch.tensor([[1.0, 0.1], [1.5, 0.1], [2.0, 0.1], [2.5, 0.1], [3.0, 0.1]]).double(),
        frames=200,
    )
    cut = []
    for pair, count in zip(pairs, frames, strict=True):
        signals: dict[str, Any] = {name: getattr(pair, name)[:count] for name in RECORDED}
        cut.append(replace(pair, **signals))
    write_tidy(PairSet(tuple(cut), "test"), tmp_path / "pairs.csv")
    options = [
        "data=tidy",
        f"data.path={tmp_path / 'pairs.csv'}",
        "protocol.min_test_duration=18",
        "data.min_duration=10",
    ]
    options.append("data.max_pairs=null")
    data = [option for option in QUICK if not option.startswith("data.")]
    small = [
        "learner=rollout",
        "learner.ensemble_size=1",
        "learner.epochs=1",
        "learner.steps=2",
        "learner.horizon=8",
        "protocol.folds=2",
    ]
    result = cfx.run(
        [*data, "protocol=across_drivers", *small, *options, f"hydra.run.dir={tmp_path / 'job'}"]
    )
    assert set(result.pairs["pair_id"]) == {"p1", "p2", "p3", "p4"}
    notes = json.loads((tmp_path / "job" / "data.json").read_text())["protocol"]
    assert notes["pairs_only_learned_from"] == 1

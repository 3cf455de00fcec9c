"""The contract of a learner, statement by statement. Letters as in `cfx.learners.base`.

The training data: three simulated drivers whose parameters are known and constant. Their networks start far from these, so that whoever
learns from the recorded drives, or from the window labels (which are the truth), drives nearer to them afterwards.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from cfx.agents.agent import Agent
from cfx.agents.core import AgentCore
from cfx.agents.heads import HEADS, head_name
from cfx.agents.heads.offset import NONE
from cfx.calibration.calibrator import Labels
from cfx.calibration.windows import Split, Windows, WindowSettings
from cfx.datasets.synthetic import SyntheticDataset
from cfx.evaluation.closed_loop import simulate_closed_loop
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult
from cfx.models.krauss import Krauss
from cfx.pairs import SIGNALS, PairBatch, PairSet
from cfx.policies.ensemble import Ensemble
from cfx.policies.features import measured_history, token_width
from cfx.policies.gru import GruPolicy
from cfx.simulation.rollout import MemoryStepper
from cfx.testing.contract import contract_of

PAIRS, FRAMES = 3, 126
WINDOWS = WindowSettings()
_POLICY = GruPolicy(hidden_size=8)


@cache
def _recording() -> PairSet:
    return SyntheticDataset(
        pairs=PAIRS, platoon_size=1, frames=FRAMES, variation=0.0, heterogeneity=1.0, seed=3
    ).load()


def training_data(
    *, needs_labels: bool = True, together: bool = False, seed: int = 0
) -> TrainingData:
    """Returns the training data, with window labels if they are needed: a network for each driver, or one for all of them together."""
    model = Krauss()
    pairs = _recording()
    batch = PairBatch.of(pairs)
    split = Split.of(pairs, WINDOWS, 0.8)
    windows = Windows.of(split.windows, WINDOWS)
    truth = torch.tensor(
        [[pair.truth[name][0] for name in model.space.names] for pair in pairs], dtype=torch.float64
    )
    unit = model.space.to_unit(truth)
    count = len(windows)
    labels = Labels(
        windows=windows,
        parameters=truth[windows.pair],
        loss=torch.zeros(count, dtype=torch.float64),
        sensitivity=torch.ones(count, dtype=torch.float64),
        diverged=torch.zeros(count, dtype=torch.int64),
    )
    return TrainingData(
        simulator=MemoryStepper(model, pairs.dt),
        batch=batch,
        split=split,
        windows=WINDOWS,
        fixed=model.space.from_unit((unit + 0.25).clamp(0.05, 0.95)),
        labels=labels if needs_labels else None,
        network=torch.zeros(PAIRS, dtype=torch.int64) if together else torch.arange(PAIRS),
        names=("all",) if together else tuple(pair.pair_id for pair in pairs),
        seed=seed,
    )


def delivers_networks_that_are_ready_to_drive(learner: Learner) -> None:
    for together in (False, True):
        dataset = training_data(needs_labels=learner.needs_labels, together=together)
        training_result = _fitted(learner, dataset)
        assert isinstance(training_result, TrainingResult), (
            f"`fit` must return a cfx.TrainingResult, not a {type(training_result).__name__}"
        )
        networks, width = len(dataset.names), _width(training_result, dataset)
        members = (
            training_result.network.size if isinstance(training_result.network, Ensemble) else 1
        )
        wanted = f"{networks} of {members} members" if members > 1 else str(networks)
        for name, value in [
            *training_result.network.named_parameters(),
            *training_result.network.named_buffers(),
        ]:
            assert value.shape[0] == networks * members, (
                f"{name} is for {value.shape[0]} networks, but the training data names {wanted}: `network` and `names` of the"
                " training data say how many there are and who learns in which"
            )
        assert (
            training_result.scaler.mean.shape
            == training_result.scaler.scale.shape
            == (networks, width)
        ), (
            f"the scaler must hold {(networks, width)} means and scales: each network's tokens are normalised on their own, with"
            " the base beside them where answers are offsets"
        )
        assert not training_result.network.training, (
            "the networks must be in evaluation mode (`network.eval()`): dropout would make a driver's parameters random"
        )
        answers = _answers(training_result, dataset)
        assert bool(((answers >= 0) & (answers <= 1)).all()), (
            "a trained policy answers in unit space, finite and within [0, 1]: nothing outside the model's bounds ever drives"
        )


def learns_something(learner: Learner) -> None:
    dataset = training_data(needs_labels=learner.needs_labels)
    training_result = _fitted(learner, dataset)
    space = dataset.simulator.model.space
    unit = space.to_unit(dataset.fixed).float()
    untrained = _POLICY.build(
        _width(training_result, dataset),
        space.to_unit(space.defaults()).float(),
        unit if training_result.base is None else torch.full_like(unit, NONE),
        torch.Generator().manual_seed(0),
    ).eval()
    before, after = (
        _rmse(replace(training_result, network=untrained), dataset),
        _rmse(training_result, dataset),
    )
    assert after < 0.7 * before, (
        "drivers with constant parameters are the easiest training data there is: in closed loop over the frames that were learned from,"
        " trained networks must be at least 30 % nearer to them than untrained ones; RMSE of speed was"
        f" {before:.3g} m/s before and is {after:.3g} m/s after"
    )


def the_same_seed_gives_the_same_networks(learner: Learner) -> None:
    states = []
    with torch.random.fork_rng(devices=[]):
        for attempt in (1, 2):
            torch.manual_seed(attempt)
            state = torch.get_rng_state()
            dataset = training_data(needs_labels=learner.needs_labels)
            states.append(
                _state(learner.fit(_POLICY, dataset) if attempt == 2 else _fitted(learner, dataset))
            )
            assert torch.equal(torch.get_rng_state(), state), (
                "the global random state must be left as it was (torch.random.fork_rng): others draw from it"
            )
    assert _equal(*states), (
        "the same training data twice gave two results: randomness must come from `training data.seed` alone"
    )


def another_seed_gives_other_networks(learner: Learner) -> None:
    one, two = (
        _state(_fitted(learner, training_data(needs_labels=learner.needs_labels, seed=seed)))
        for seed in (0, 1)
    )
    assert not _equal(one, two), (
        "seeds 0 and 1 gave the same networks: `training data.seed` must reach the initial weights, or repeating a study with other"
        " seeds shows a spread that is not there"
    )


def reads_no_frame_after_the_training_part(learner: Learner) -> None:
    dataset = training_data(needs_labels=learner.needs_labels)
    frames = torch.arange(dataset.batch.mask.shape[1])
    secret = frames > dataset.split.frame[:, None]
    changed: dict[str, Any] = {
        name: torch.where(
            secret, 3.0 + 0.5 * getattr(dataset.batch, name), getattr(dataset.batch, name)
        )
        for name in SIGNALS
    }
    poisoned = replace(dataset, batch=replace(dataset.batch, **changed))
    one, two = _state(_fitted(learner, dataset)), _state(learner.fit(_POLICY, poisoned))
    assert _equal(one, two), (
        "frames after `split.frame` were changed, and the networks or their scaler changed with them: that is the test part, and"
        " whoever learns from it proves nothing"
    )


def networks_are_independent(learner: Learner) -> None:
    dataset = training_data(needs_labels=learner.needs_labels)
    batch, first = dataset.batch, torch.arange(PAIRS)[:, None] == 0
    changed: dict[str, Any] = {
        name: torch.where(first, 1.0 + 0.8 * getattr(batch, name), getattr(batch, name))
        for name in (
            "leader_speed",
            "follower_speed",
            "leader_acceleration",
            "follower_acceleration",
        )
    }
    labels = dataset.labels
    if labels is not None:
        own = (labels.windows.pair == 0)[:, None]
        labels = replace(
            labels,
            parameters=torch.where(
                own, dataset.simulator.model.space.defaults(), labels.parameters
            ),
        )
    other = replace(dataset, batch=replace(batch, **changed), labels=labels)
    one, two = _state(_fitted(learner, dataset)), _state(learner.fit(_POLICY, other))
    message = "what a network learns must not depend on the drivers of another network: change one driver, and only his changes"
    for key in one:
        his = len(one[key]) // PAIRS  # rows of one network, more than one in an ensemble
        torch.testing.assert_close(
            one[key][his:], two[key][his:], rtol=1e-4, atol=1e-5, msg=f"{message} ({key})"
        )


def the_lesson_stays_as_it_is(learner: Learner) -> None:
    dataset, untouched = (
        training_data(needs_labels=learner.needs_labels),
        training_data(needs_labels=learner.needs_labels),
    )
    learner.fit(_POLICY, dataset)
    message = "must not be changed in place: the protocol still needs it for the evaluation"
    for name in (*SIGNALS, "gap"):
        torch.testing.assert_close(
            getattr(dataset.batch, name),
            getattr(untouched.batch, name),
            rtol=0,
            atol=0,
            msg=f"training data.batch.{name} {message}",
        )
    for name in ("fixed", "network"):
        assert torch.equal(getattr(dataset, name), getattr(untouched, name)), (
            f"training data.{name} {message}"
        )
    if dataset.labels is not None and untouched.labels is not None:
        assert torch.equal(dataset.labels.parameters, untouched.labels.parameters), (
            f"training data.labels {message}"
        )


def curves_tell_how_it_went(learner: Learner) -> None:
    dataset = training_data(needs_labels=learner.needs_labels)
    curves = _fitted(learner, dataset).curves
    assert list(curves.columns) == CURVE_COLUMNS, (
        f"curves have the columns {', '.join(CURVE_COLUMNS)}, for figures and MLflow read them; not {', '.join(curves.columns)}"
    )
    assert set(curves["network"]) == set(dataset.names), (
        "every network has its curve, under its name in the training data"
    )
    for name, own in curves.groupby("network"):
        assert own["epoch"].tolist() == list(range(len(own))), (
            f"epochs of network {name} are counted 0, 1, 2, ..., a row each"
        )
    assert bool(curves["train_loss"].notna().all()), (
        "the training loss is measured in every epoch; NaN is for validation alone"
    )


_fits: WeakKeyDictionary[Learner, dict[tuple[int, int], TrainingResult]] = WeakKeyDictionary()


def _fitted(learner: Learner, dataset: TrainingData) -> TrainingResult:
    """Fits the training data of that seed and number of networks once for all checks of one learner: training takes the time."""
    known = _fits.setdefault(learner, {})
    key = (len(dataset.names), dataset.seed)
    if key not in known:
        known[key] = learner.fit(_POLICY, dataset)
    return known[key]


def _answers(training_result: TrainingResult, dataset: TrainingData) -> Tensor:
    """Returns what the networks answer on the measured training parts, `(P, W, n)` in unit space."""
    policy = _ready(training_result, dataset)
    state = policy.begin(dataset.network)
    space, answers = dataset.simulator.model.space, []
    for first in range(0, int(dataset.split.frame.min()), WINDOWS.stride):
        seen = measured_history(
            dataset.batch, torch.arange(PAIRS), torch.full((PAIRS,), first), WINDOWS.length
        )
        chosen, state = policy.act(seen, state)
        answers.append(space.to_unit(chosen))
    return torch.stack(answers, dim=1)


def _rmse(training_result: TrainingResult, dataset: TrainingData) -> float:
    """Returns the RMSE of speed in closed loop over the training parts, m/s."""
    loop = simulate_closed_loop(
        dataset.simulator,
        _ready(training_result, dataset),
        dataset.batch,
        torch.zeros(PAIRS, dtype=torch.int64),
        dataset.network,
    )
    frames = torch.arange(loop.speed.shape[1])
    counted = (frames > 0) & (frames <= dataset.split.frame[:, None])
    error = (loop.speed - dataset.batch.follower_speed[:, : loop.speed.shape[1]])[counted]
    return float(error.square().mean().sqrt())


def _ready(training_result: TrainingResult, dataset: TrainingData) -> Agent:
    name = training_result.head or head_name(has_base=training_result.base is not None)
    head = HEADS[name].for_model(dataset.simulator.model)
    return Agent(
        core=AgentCore(_POLICY, training_result.network, training_result.scaler, head),
        model_node={},
        policy_node={},
        windows=WINDOWS,
        dt=dataset.simulator.dt,
        names=dataset.names,
        base=training_result.base,
    )


def _width(training_result: TrainingResult, dataset: TrainingData) -> int:
    """Returns f; where answers are offsets, the networks read the base too."""
    width = token_width(_POLICY.inputs, _POLICY.summary, WINDOWS.length)
    return width if training_result.base is None else width + len(dataset.simulator.model.space)


def _state(training_result: TrainingResult) -> dict[str, Tensor]:
    values = training_result.network.state_dict() | {
        f"scaler.{key}": value for key, value in training_result.scaler.state_dict().items()
    }
    return {key: value.detach().clone() for key, value in values.items()}


def _equal(one: dict[str, Tensor], two: dict[str, Tensor]) -> bool:
    return one.keys() == two.keys() and all(torch.equal(one[key], two[key]) for key in one)


CONTRACT = contract_of(
    __name__,
    "learner",
    slow=[another_seed_gives_other_networks, networks_are_independent, the_lesson_stays_as_it_is],
)

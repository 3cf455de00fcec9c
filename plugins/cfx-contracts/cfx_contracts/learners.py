"""The contract of a learner, statement by statement. Shapes as in `cfx.learners.base`.

The training data: three simulated drivers whose parameters are known and constant. Their networks
start far from these. A learner that learns from the trajectories, or from the labels (which are the
truth), comes nearer to them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from cfx.calibration.calibrator import WindowLabels
from cfx.core.contract import expect_close, once
from cfx.data.pairs import PairBatch, PairSet
from cfx.data.signals import RECORDED
from cfx.evaluation.closed_loop import Followers, simulate_closed_loop
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingPairs, TrainingResult
from cfx.models.krauss import Krauss
from cfx.policies.agent import Agent
from cfx.policies.core import AgentCore, Ensemble, features_read
from cfx.policies.gru import GruPolicy
from cfx.policies.heads import head_class, head_name
from cfx.policies.heads.base import ParameterHead
from cfx.policies.history import measured_history
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.synthetic import SyntheticDataset
from cfx.simulation.windows import Split, Windows, WindowSettings
from cfx_contracts import contract_of

PAIRS, FRAMES = 3, 126
WINDOWS = WindowSettings()
_POLICY = GruPolicy(hidden_size=8)


@cache
def _recording() -> PairSet:
    dataset = SyntheticDataset(
        pairs=PAIRS, platoon_size=1, frames=FRAMES, variation=0.0, heterogeneity=1.0, seed=3
    )
    return dataset.load()


def training_data(
    *, needs_labels: bool = True, together: bool = False, seed: int = 0
) -> TrainingData:
    """Returns the training data.

    Args:
        needs_labels: with labels.
        together: one network for all drivers, otherwise one for each.
        seed: of the training.
    """
    model = Krauss()
    pairs = _recording()
    split = Split.of(pairs, WINDOWS, 0.8)
    truth = _truth(pairs, model)
    network, names = torch.arange(PAIRS), tuple(pairs.ids)
    if together:
        network, names = torch.zeros_like(network), ("all",)
    return TrainingData(
        stepper=MemoryStepper(model, pairs.dt),
        recorded=PairBatch.of(pairs),
        pairs=TrainingPairs(
            index=torch.arange(PAIRS),
            split=split,
            network=network,
            start=model.space.from_unit((model.space.to_unit(truth) + 0.25).clamp(0.05, 0.95)),
            labels=_labels(split, truth) if needs_labels else None,
        ),
        windows=WINDOWS,
        names=names,
        seed=seed,
    )


def _truth(pairs: PairSet, model: Krauss) -> Tensor:
    """Returns the drivers' parameters, `(P, n)`, SI units."""
    rows = [[pair.truth[name][0] for name in model.space.names] for pair in pairs]
    return torch.tensor(rows, dtype=torch.float64)


def _labels(split: Split, truth: Tensor) -> WindowLabels:
    """Returns the drivers' parameters as labels of all windows."""
    windows = Windows.of(split.windows, WINDOWS)
    count = len(windows)
    return WindowLabels(
        windows=windows,
        parameters=truth[windows.pair],
        loss=torch.zeros(count, dtype=torch.float64),
        sensitivity=torch.ones(count, dtype=torch.float64),
        diverged=torch.zeros(count, dtype=torch.int64),
    )


_ANSWERS = (
    "a trained policy answers in unit space, finite and within [0, 1]: nothing outside the model's"
    " bounds ever drives"
)


def delivers_networks_that_are_ready_to_drive(learner: Learner) -> None:
    for together in (False, True):
        data = training_data(needs_labels=learner.needs_labels, together=together)
        result = _fitted(learner, data)
        assert isinstance(result, TrainingResult), (
            f"`fit` must return a cfx.plugin.TrainingResult, not a {type(result).__name__}"
        )
        networks, members = len(data.names), 1
        wanted = str(networks)
        if isinstance(result.network, Ensemble):
            members = result.network.size
            wanted = f"{networks} of {members} members"
        for name, value in result.network.state_dict().items():
            assert value.shape[0] == networks * members, (
                f"{name} is for {value.shape[0]} networks, but the training data names {wanted}:"
                " `network` and `names` of the training data say how many there are and what each"
                " learns from"
            )
            assert bool(value.isfinite().all()), f"{name} is not finite: {_ANSWERS}"
        head = _head(result, data)
        assert (result.base is not None) == head.needs_base, (
            "`base` and `head` of the result disagree: the offset head comes with the base of"
            " drivers without one of their own, the direct head with None"
        )
        shape = (networks, features_read(_POLICY, head, WINDOWS.length))
        assert result.scaler.mean.shape == result.scaler.scale.shape == shape, (
            f"the scaler must hold {shape} means and scales: what each network reads is normalised"
            " on its own, with the base beside the tokens where answers are offsets"
        )
        assert not result.network.training, (
            "the networks must be in evaluation mode (`network.eval()`): dropout would make a"
            " driver's parameters random"
        )
        answers = _answers(result, data)
        assert bool(((answers >= 0) & (answers <= 1)).all()), _ANSWERS


def learns_something(learner: Learner) -> None:
    data = training_data(needs_labels=learner.needs_labels)
    result = _fitted(learner, data)
    head = _head(result, data)
    default = head.space.to_unit(head.space.defaults()).float()
    start = head.untrained_answer(head.space.to_unit(data.pairs.start).float())
    features = features_read(_POLICY, head, WINDOWS.length)
    untrained = _POLICY.build(features, default, start, torch.Generator().manual_seed(0)).eval()
    before = _rmse(replace(result, network=untrained), data)
    after = _rmse(result, data)
    assert after < 0.7 * before, (
        "drivers with constant parameters are the easiest training data there is: in closed loop"
        " over the frames that were learned from, trained networks must be at least 30 % nearer to"
        f" them than untrained ones; RMSE of speed was {before:.3g} m/s before and is {after:.3g}"
        " m/s after"
    )


def the_same_seed_gives_the_same_networks(learner: Learner) -> None:
    data = training_data(needs_labels=learner.needs_labels)
    first = _state(_fitted(learner, data))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(20_027)
        state = torch.get_rng_state()
        second = _state(learner.fit(_POLICY, data))
        assert torch.equal(torch.get_rng_state(), state), (
            "the global random state must not be drawn from: other threads of the program do; draw"
            " from a torch.Generator (cfx.learners.batched.fit gives dropout one)"
        )
    assert _equal(first, second), (
        "the same training data twice gave two results: randomness must come from `seed` of the"
        " training data alone"
    )


def another_seed_gives_other_networks(learner: Learner) -> None:
    first = _fitted(learner, training_data(needs_labels=learner.needs_labels, seed=0))
    second = _fitted(learner, training_data(needs_labels=learner.needs_labels, seed=1))
    assert not _equal(_state(first), _state(second)), (
        "seeds 0 and 1 gave the same networks: `seed` of the training data must reach the initial"
        " weights, or repeating an experiment with other seeds shows less variation than there is"
    )


def reads_no_frame_after_the_training_part(learner: Learner) -> None:
    data = training_data(needs_labels=learner.needs_labels)
    frames = torch.arange(data.recorded.mask.shape[1])
    secret = frames > data.pairs.split.frame[:, None]
    changed: dict[str, Any] = {}
    for name in RECORDED:
        signal = getattr(data.recorded, name)
        changed[name] = torch.where(secret, 3.0 + 0.5 * signal, signal)
    poisoned = replace(data, recorded=replace(data.recorded, **changed))
    expected = _state(_fitted(learner, data))
    delivered = _state(learner.fit(_POLICY, poisoned))
    assert _equal(expected, delivered), (
        "frames after `split.frame` were changed, and the networks or their scaler changed with"
        " them: that is the test part, and results of a learner that reads it prove nothing"
    )


def networks_are_independent(learner: Learner) -> None:
    data = training_data(needs_labels=learner.needs_labels)
    first = torch.arange(PAIRS)[:, None] == 0
    changed: dict[str, Any] = {}
    for name in RECORDED:
        if not name.endswith("position"):
            signal = getattr(data.recorded, name)
            changed[name] = torch.where(first, 1.0 + 0.8 * signal, signal)
    other = replace(data, recorded=replace(data.recorded, **changed))
    labels = data.pairs.labels
    if labels is not None:
        of_first = (labels.windows.pair == 0)[:, None]
        default = data.stepper.model.space.defaults()
        parameters = torch.where(of_first, default, labels.parameters)
        labels = replace(labels, parameters=parameters)
        other = replace(other, pairs=replace(other.pairs, labels=labels))
    before, after = _state(_fitted(learner, data)), _state(learner.fit(_POLICY, other))
    message = (
        "what a network learns must not depend on the drivers of another network: one driver was"
        " changed, and another driver's network changed"
    )
    for key in before:
        rows = len(before[key]) // PAIRS  # rows of one network, more than one in an ensemble
        expect_close(
            before[key][rows:], after[key][rows:], rtol=1e-4, atol=1e-5, msg=f"{message} ({key})"
        )


def the_training_data_stays_as_it_is(learner: Learner) -> None:
    untouched = training_data(needs_labels=learner.needs_labels)
    _, data = _fit(learner, training_data(needs_labels=learner.needs_labels))
    message = "must not be changed in place: the protocol still needs it for the evaluation"
    for name in (*RECORDED, "gap"):
        after, before = getattr(data.recorded, name), getattr(untouched.recorded, name)
        assert torch.equal(after, before), f"recorded.{name} of the training data {message}"
    for name in ("start", "network"):
        after, before = getattr(data.pairs, name), getattr(untouched.pairs, name)
        assert torch.equal(after, before), f"{name} of the training data {message}"
    if data.pairs.labels is not None and untouched.pairs.labels is not None:
        assert torch.equal(data.pairs.labels.parameters, untouched.pairs.labels.parameters), (
            f"labels of the training data {message}"
        )


def curves_tell_how_it_went(learner: Learner) -> None:
    data = training_data(needs_labels=learner.needs_labels)
    curves = _fitted(learner, data).curves
    assert list(curves.columns) == CURVE_COLUMNS, (
        f"curves have the columns {', '.join(CURVE_COLUMNS)}, for figures and MLflow read them; not"
        f" {', '.join(curves.columns)}"
    )
    assert set(curves["network"]) == set(data.names), (
        "every network has its curve, under its name in the training data"
    )
    for name, curve in curves.groupby("network"):
        assert curve["epoch"].tolist() == list(range(len(curve))), (
            f"epochs of network {name} are counted 0, 1, 2, ..., a row each"
        )
    assert bool(curves["train_loss"].notna().all()), (
        "the training loss is measured in every epoch; NaN is for validation alone"
    )


def _fitted(learner: Learner, data: TrainingData) -> TrainingResult:
    """Fits each training data once for all checks of one learner: training takes the time."""
    return _fit(learner, data)[0]


def _fit(learner: Learner, data: TrainingData) -> tuple[TrainingResult, TrainingData]:
    """Returns the fit, and the training data that it was given, equal to these before it."""
    key = (len(data.names), data.seed)
    return once(learner, key, lambda: (learner.fit(_POLICY, data), data))


def _answers(result: TrainingResult, data: TrainingData) -> Tensor:
    """Returns the parameters chosen on the measured training parts, `(P, W, n)` in unit space."""
    agent = _agent(result, data)
    state = agent.begin(data.pairs.network)
    pairs, answers = torch.arange(PAIRS), []
    for first in range(0, int(data.pairs.split.frame.min()), WINDOWS.stride):
        frame = torch.full((PAIRS,), first)
        chosen, state = agent.act(measured_history(data.batch, pairs, frame, WINDOWS.length), state)
        answers.append(agent.space.to_unit(chosen))
    return torch.stack(answers, dim=1)


def _rmse(result: TrainingResult, data: TrainingData) -> float:
    """Returns the RMSE of speed in closed loop over the training parts, m/s."""
    first = torch.zeros(PAIRS, dtype=torch.int64)
    followers = Followers(data.batch, data.pairs.network)
    loop = simulate_closed_loop(data.stepper, _agent(result, data), followers, first)
    frames = torch.arange(loop.speed.shape[1])
    counted = (frames > 0) & (frames <= data.pairs.split.frame[:, None])
    error = (loop.speed - data.batch.follower_speed[:, : loop.speed.shape[1]])[counted]
    return float(error.square().mean().sqrt())


def _head(result: TrainingResult, data: TrainingData) -> ParameterHead:
    name = result.head or head_name(has_base=result.base is not None)
    return head_class(name).for_model(data.stepper.model)


def _agent(result: TrainingResult, data: TrainingData) -> Agent:
    return Agent(
        core=AgentCore(_POLICY, result.network, result.scaler, _head(result, data)),
        model_node={},
        policy_node={},
        windows=WINDOWS,
        dt=data.stepper.dt,
        names=data.names,
        base=result.base,
    )


def _state(result: TrainingResult) -> dict[str, Tensor]:
    scaler = {f"scaler.{key}": value for key, value in result.scaler.state_dict().items()}
    values = {**result.network.state_dict(), **scaler}
    return {key: value.detach().clone() for key, value in values.items()}


def _equal(weights: dict[str, Tensor], others: dict[str, Tensor]) -> bool:
    if weights.keys() != others.keys():
        return False
    return all(torch.equal(weights[key], others[key]) for key in weights)


CONTRACT = contract_of(
    __name__,
    "learner",
    slow=[
        another_seed_gives_other_networks,
        networks_are_independent,
        the_training_data_stays_as_it_is,
    ],
)

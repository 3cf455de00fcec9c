"""Small training data and what comes of it, for the tests of learners.

Small trajectories, eager code: what is tested is what is learned from, not how fast.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from cfx.data.pairs import PairBatch
from cfx.evaluation.closed_loop import ClosedLoop, Followers, simulate_closed_loop
from cfx.learners.base import TrainingData, TrainingPairs, TrainingResult
from cfx.learners.rollout import RolloutLearner, RolloutSettings
from cfx.learners.rollout.dataset import RolloutBatch, RolloutDataset
from cfx.learners.rollout.loss import BaseErrors
from cfx.learners.rollout.module import RolloutModule
from cfx.learners.rollout.shard import TrainingShard
from cfx.models.krauss import Krauss
from cfx.policies.agent import Agent
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.core import AgentCore
from cfx.policies.gru import GruPolicy
from cfx.policies.heads import head_class, head_name
from cfx.simulation.kernel import compiler
from cfx.simulation.rollout import MemoryStepper
from cfx.simulation.windows import Split, WindowSettings
from tests.drives import wavy_pairs

WINDOWS = WindowSettings()
INPUTS = ("leader_speed", "relative_speed", "gap")
QUICK: dict[str, Any] = {
    "ensemble_size": 1,
    "epochs": 6,
    "steps": 10,
    "learning_rate": 0.01,
    "horizon": 12,
    "burn_in_s": 2.0,
    "compile": "never",
}
COMPILED = QUICK | {"compile": "never" if compiler.find_compiler() is None else "always"}
"""Where cfx's own kernel has all that is trained, a training takes a fifth of the time in it."""

TRUE = torch.tensor(
    [[1.0, 0.1], [1.4, 0.3], [1.8, 0.5], [2.2, 0.0], [2.6, 0.2], [3.0, 0.4]]
).double()


def gru(**options: Any) -> Policy:
    return GruPolicy(inputs=INPUTS, hidden_size=12, **options)


def training_data(
    *, model: Any = None, networks: int = 2, frames: int = 260, **changes: Any
) -> TrainingData:
    """Six Krauss drivers. Each network learns from all, from a set that fits none of them."""
    driven = Krauss()
    model = model or driven
    pairs = wavy_pairs(driven, TRUE, frames=frames)
    index = torch.arange(len(pairs)).repeat(networks)
    start = model.space.defaults().expand(len(index), -1).clone()
    if isinstance(model, Krauss):
        start[:] = torch.tensor([4.0, 0.8])
    data = TrainingData(
        stepper=MemoryStepper(model, 0.1),
        recorded=PairBatch.of(pairs),
        pairs=TrainingPairs(
            index=index,
            split=Split.none(pairs, WINDOWS)[index],
            network=torch.arange(networks).repeat_interleave(len(pairs)),
            start=start,
            drivers=tuple(pair.driver for pair in pairs) * networks,
        ),
        windows=WINDOWS,
        names=tuple(f"n{number}" for number in range(networks)),
        seed=0,
    )
    of_pairs = {name: changes.pop(name) for name in set(changes) & set(vars(data.pairs))}
    return replace(data, pairs=replace(data.pairs, **of_pairs), **changes)


def ready(result: TrainingResult, data: TrainingData, policy: Policy) -> Agent:
    """Returns trained networks as an agent."""
    name = result.head or head_name(has_base=result.base is not None)
    head = head_class(name).for_model(data.stepper.model)
    return Agent(
        core=AgentCore(policy, result.network, result.scaler, head),
        model_node={},
        policy_node={},
        windows=WINDOWS,
        dt=0.1,
        names=data.names,
        base=result.base,
    )


def loop(
    result: TrainingResult,
    data: TrainingData,
    policy: Policy,
    first: int = 0,
    base: torch.Tensor | None = None,
    seed: int | None = None,
) -> ClosedLoop:
    """Returns the closed loop of evaluation from a frame on; with a seed, sampled."""
    frames = torch.full_like(data.pairs.network, first)
    agent = ready(result, data, policy)
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    return simulate_closed_loop(
        data.stepper,
        agent,
        Followers(data.batch, data.pairs.network, base=base),
        frames,
        generator=generator,
    )


def error(found: ClosedLoop, data: TrainingData, first: int = 0) -> float:
    """Returns the RMSE of speed, m/s."""
    measured = data.batch.follower_speed[:, first:]
    return float((found.speed - measured)[found.counted].square().mean().sqrt())


def untrained(data: TrainingData, policy: Policy, **options: Any) -> TrainingResult:
    """Returns what one gradient step without a rate leaves."""
    still = {"epochs": 1, "steps": 1, "learning_rate": 1e-12, "weight_decay": 0.0}
    return RolloutLearner(**(QUICK | still | options)).fit(policy, data)


def placed(
    data: TrainingData,
    policy: Policy,
    share: float = 0.25,
    seed: int = 0,
    head: str = "offset",
    ensemble_size: int = 1,
) -> RolloutDataset:
    """Returns the training data placed on networks."""
    generator = torch.Generator().manual_seed(seed)
    made = head_class(head).for_model(data.stepper.model)
    settings = RolloutSettings(validation=share, ensemble_size=ensemble_size)
    return RolloutDataset.of(data, policy, made, settings, generator)


def module_with(
    network: PolicyNetwork,
    dataset: RolloutDataset,
    data: TrainingData,
    settings: RolloutSettings,
    policy: Policy | None = None,
) -> RolloutModule:
    """Returns what trains a network on placed data."""
    errors, weights = BaseErrors.of(data, dataset, settings.horizon), network.state_dict()
    return RolloutModule(TrainingShard(settings, policy or gru(), data, dataset, errors, weights))


def module_of(data: TrainingData, policy: Policy | None = None, **options: Any) -> RolloutModule:
    """Returns a module whose networks answer at random, so that they do something."""
    policy, settings = policy or gru(), RolloutSettings(**(QUICK | options))
    generator = torch.Generator().manual_seed(0)
    head = head_class(settings.head).for_model(data.stepper.model)
    dataset = RolloutDataset.of(data, policy, head, settings, generator)
    blank = torch.full((len(dataset.pair), 2), 0.5)
    network = policy.build(dataset.scaler.mean.shape[-1], blank[0], blank, generator)
    with torch.no_grad():
        network.get_parameter("w_out").uniform_(-1.0, 1.0, generator=generator)
    return module_with(network.to(data.device), dataset, data, settings, policy)


def batch_of(
    dataset: RolloutDataset,
    start: torch.Tensor,
    cold_start: torch.Tensor | None = None,
    last: torch.Tensor | None = None,
) -> RolloutBatch:
    """Returns a trajectory of each of one network's six drivers, `(1, 6)`; all have weight."""
    place = torch.arange(6)[None]
    if cold_start is None:
        cold_start = torch.zeros_like(place).bool()
    if last is None:
        last = dataset.last
    return RolloutBatch(place, start, cold_start, last, torch.ones_like(place).float())

"""Networks that begin as those of a finished job, instead of untrained.

Shapes: N networks (each member of an ensemble counts), M networks of the job's ensemble.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from cfx.core import registry
from cfx.core.errors import ConfigError, DataError
from cfx.learners.base import TrainingData
from cfx.learners.rollout.dataset import RolloutDataset
from cfx.policies import checkpoint
from cfx.policies.agent import Agent
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.features import Scaler
from cfx.policies.heads.base import ParameterHead
from cfx.policies.ready import folder_of_ready_made, is_ready_made


def start_policy(start: str) -> Agent:
    """Returns the policy that networks begin as, with one network.

    Args:
        start: the folder of a finished job, or `cfx://NAME`; its network for unseen drivers, or the
            one that `#NETWORK` behind it names.

    Raises:
        DataError: there is no such policy, or none with such a network.
    """
    place, _, name = start.partition("#")
    folder = folder_of_ready_made(place) if is_ready_made(place) else Path(place).expanduser()
    try:
        agent = checkpoint.load(folder / "policy")
        if not name:
            return agent.for_unseen_drivers()
        if name not in agent.names:
            raise DataError(f"it has no network '{name}', but {', '.join(agent.names)}")
    except DataError as error:
        raise DataError(f"learner.start={start}: {error}") from None
    return agent.only(torch.tensor([agent.names.index(name)]))


def check_start(
    start: str, agent: Agent, policy: Policy, training_data: TrainingData, head: ParameterHead
) -> None:
    """Checks that networks of this training can begin as an agent's.

    Raises:
        ConfigError: the policy, the model, the head, windows or the time step are others.
    """
    model, windows = training_data.simulator.model, training_data.windows
    unlike: list[tuple[str, object]] = []
    if agent.policy.identity() != policy.identity():
        unlike.append(("policy", agent.policy_node))
    is_other = not isinstance(model, registry.get("model", str(agent.model_node.get("name"))))
    if is_other or agent.model_space.names != model.space.names:
        unlike.append(("model", agent.model_node))
    if agent.head.name != head.name:
        unlike.append(("learner.head", agent.head.name))
    if agent.windows != windows:
        unlike.append(("windows", agent.windows.model_dump()))
    if abs(agent.dt - training_data.simulator.dt) > 1e-6:
        unlike.append(("data.time_step", agent.dt))
    if unlike:
        key, value = unlike[0]
        raise ConfigError(
            f"learner.start={start}: its {key} is {_in_words(value)} with other settings than"
            f" here; set {key} as that job's config.yaml has it (experiment=fine_tune fits"
            " cfx://idm-history)"
        )


def begun(
    agent: Agent, network: PolicyNetwork, dataset: RolloutDataset
) -> tuple[PolicyNetwork, RolloutDataset]:
    """Gives networks an agent's weights, and the data its scaler.

    Args:
        agent: with one network, of M.
        network: N untrained networks, changed in place.
        dataset: what they learn from.

    Raises:
        ConfigError: the agent has another number of networks in its ensemble.
    """
    size = agent.core.ensemble_size
    if size != dataset.ensemble_size:
        raise ConfigError(
            f"learner.start: that policy's ensemble has {size} networks; set"
            f" learner.ensemble_size={size}"
        )
    weights: dict[str, Tensor] = {}
    for name, value in agent.network.state_dict().items():
        repeated = value.repeat(len(dataset.pair) // size, *[1] * (value.dim() - 1))
        weights[name.removeprefix("members.") if size > 1 else name] = repeated
    network.load_state_dict(weights)
    mean, scale = agent.scaler.mean, agent.scaler.scale
    networks = len(dataset.pair)
    scaler = Scaler(mean.expand(networks, -1).clone(), scale.expand(networks, -1).clone())
    return network, replace(dataset, scaler=scaler.to(dataset.pair.device))


def _in_words(value: object) -> str:
    if isinstance(value, Mapping):
        return str(value.get("name", dict(value)))
    return str(value)

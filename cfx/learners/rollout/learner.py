"""The learner `rollout`.

Where the data do not determine the labels of windows, their average means little
(`cfx.learners.imitation`).
Here nothing is labelled: from random measured states on, the policy drives in closed loop behind
the measured leader, and the job's objective is propagated back through the simulation into the
network.

Shapes: N networks (each member of an ensemble counts), M networks of the ensemble that others begin
as, n tuned parameters.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
import torch
from torch import Tensor

from cfx.core import registry
from cfx.core.component import Settings
from cfx.core.progress import Task
from cfx.errors import ConfigError, DataError
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingData, TrainingResult, learned_range
from cfx.learners.curves import warn_of_nothing_learned
from cfx.learners.rollout.dataset import RolloutDataset, time_gaps
from cfx.learners.rollout.sampling import augmentation
from cfx.learners.rollout.settings import RolloutSettings
from cfx.learners.rollout.shard import (
    TrainedShard,
    cut,
    epochs,
    networks_of_shards,
    shard_checkpoints,
    training_key,
    untrained,
)
from cfx.learners.rollout.simulated import with_simulated_drivers
from cfx.policies import checkpoint as saved
from cfx.policies.agent import Agent
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.core import Ensemble
from cfx.policies.features import Scaler
from cfx.policies.heads import head_class
from cfx.policies.heads.base import ParameterHead
from cfx.policies.ready import folder_of_ready_made, is_ready_made

log = logging.getLogger(__name__)


class RolloutLearner(Learner):
    """Back-propagates the job's objective through closed-loop simulation into the policy.

    Networks answer offsets (`cfx.policies.heads.offset`): untrained, each driver is driven by their
    base parameters, so training starts from a fixed model. With `head=residual` they also choose
    how the model takes over from the acceleration at the start (`cfx.policies.heads.residual`).

    Before a trajectory the policy observes the driver's measured history; cold starts, as of unseen
    drivers, have none. The drivers of all networks (at most `drivers` of each) are simulated at
    once, from random measured states. The switches of models with regimes are smoothed meanwhile;
    validation is exact. Networks can first imitate experts that set the acceleration
    (`distillation_epochs`).

    A trajectory's loss is the objective plus `gap_weight` times the gap's RMSE, each divided by
    what the base parameters have there, plus `jerk_weight` times the RMS jerk.

    Training goes on where it was interrupted, and gives the same then, if the training data has a
    workspace.

    Differences from the paper: the paper imitates labels.
    """

    schema: ClassVar[type[Settings]] = RolloutSettings
    settings: RolloutSettings
    needs_gradients = True
    uses_driver_features = True
    trial: ClassVar[Mapping[str, Any]] = {
        "ensemble_size": 2,
        "distillation_epochs": 1,
        "epochs": 3,
        "steps": 6,
        "horizon": 5,
        "learning_rate": 0.1,
    }

    @property
    def reads_history(self) -> bool:
        return self.settings.cold_start_fraction < 1.0

    @property
    def learned_before(self) -> Mapping[str, str]:
        # Of one network among several nobody knows which pairs it was kept from.
        start = self.settings.start
        if start is None or "#" in start:
            return {}
        return start_policy(start).trained_on.pairs

    def fit(self, policy: Policy, training_data: TrainingData) -> TrainingResult:
        """As `Learner.fit`.

        Raises:
            ConfigError: the simulator or the model has no gradients.
        """
        stepper, s = training_data.stepper, self.settings
        if policy.adapts:
            self.require_gradients(stepper.model, stepper.differentiable)
        if not {"gap", "time_headway"} & set(policy.inputs):
            log.info(
                "The policy does not see the gap; policy.inputs=situation gives smaller errors"
            )
        training_data = with_simulated_drivers(
            training_data, s.simulated_drivers, s.simulated_queues
        )
        generator = torch.Generator().manual_seed(training_data.seed)
        head = head_class(s.head).for_model(stepper.model)
        dataset = RolloutDataset.of(training_data, policy, head, s, generator)
        network = untrained(policy, dataset, head, generator)
        start = None
        if s.start is not None:
            start = start_policy(s.start).to(training_data.device)
            check_start(s.start, start, policy, training_data, head)
            network, dataset = begun(start, network, dataset)
        curves, dispersion = pd.DataFrame(columns=CURVE_COLUMNS), None
        if any(parameter.requires_grad for parameter in network.parameters()):
            curves, dispersion = self._train(policy, training_data, network, dataset)
        augment = None
        if training_data.pairs.base is not None and s.cold_start_fraction > 0:
            generator = torch.Generator().manual_seed(training_data.seed)
            augment = augmentation(s, time_gaps(training_data), generator)
        valid_range = learned_range(training_data, augment)
        if start is not None and start.valid_range is not None:
            valid_range = valid_range.joined(start.valid_range)
        first = slice(None, None, s.ensemble_size)
        if s.ensemble_size > 1:
            network = Ensemble(network, s.ensemble_size)
        return TrainingResult(
            network=network.eval(),
            scaler=Scaler(dataset.scaler.mean[first].clone(), dataset.scaler.scale[first].clone()),
            curves=curves,
            base=head.space.from_unit(dataset.pooled[first].to(training_data.pairs.start.dtype)),
            head=head.name,
            valid_range=valid_range,
            dispersion=dispersion,
        )

    def _train(
        self,
        policy: Policy,
        training_data: TrainingData,
        network: PolicyNetwork,
        dataset: RolloutDataset,
    ) -> tuple[pd.DataFrame, Tensor | None]:
        """Trains all networks in place, in shards.

        Returns:
            The learning curves, and the dispersion of each ensemble's noise; None for a head
            without noise.
        """
        # Where nothing is trained, its imports would only take time and memory.
        from cfx.learners.rollout.module import train

        s = self.settings
        training = training_key(self.identity(), policy, training_data)
        networks = networks_of_shards(s, dataset)
        files = shard_checkpoints(training_data.workspace, training, networks)
        shards = cut(s, policy, training_data, dataset, network, networks, files)
        count, at_most = len(networks), epochs(s)
        title = f"Training ({len(dataset.pair)} networks, at most {at_most} epochs)"
        with Task(title, at_most * count) as task:
            trained: dict[int, TrainedShard] = dict(
                training_data.engine.map(train, shards, task.advance, shares_cores=count == 1)
            )
        in_order = [trained[number] for number in range(count)]
        weights = {}
        for name in network.state_dict():
            weights[name] = torch.cat([shard.weights[name] for shard in in_order])
        network.load_state_dict(weights)
        curves = pd.concat([shard.curves for shard in in_order], ignore_index=True)
        curves = curves.sort_values("epoch", kind="stable", ignore_index=True)
        warn_of_nothing_learned(curves)
        factors = [shard.dispersion for shard in in_order if shard.dispersion is not None]
        dispersion = None
        if factors:
            # The geometric mean of an ensemble's members.
            dispersion = torch.cat(factors).log().view(-1, s.ensemble_size).mean(1).exp()
        return curves, dispersion


def start_policy(start: str) -> Agent:
    """Returns the policy that networks begin as, with one network.

    Args:
        start: the folder of a finished job, or `cfx://NAME`; its network for unseen drivers, or the
            one that `#NETWORK` behind it names.

    Raises:
        DataError: there is no such policy, or none with such a network.
    """
    place, _, name = start.partition("#")
    folder = Path(place).expanduser()
    if is_ready_made(place):
        folder = folder_of_ready_made(place)
    try:
        agent = saved.load_agent(folder / "policy")
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
    model, windows = training_data.stepper.model, training_data.windows
    unlike: list[tuple[str, object]] = []
    if agent.core.policy.identity() != policy.identity():
        unlike.append(("policy", agent.policy_node))
    is_other = not isinstance(model, registry.get("model", str(agent.model_node.get("name"))))
    if is_other or agent.core.head.model_space.names != model.space.names:
        unlike.append(("model", agent.model_node))
    if agent.core.head.name != head.name:
        unlike.append(("learner.head", agent.core.head.name))
    if agent.windows != windows:
        unlike.append(("windows", agent.windows.model_dump()))
    if abs(agent.dt - training_data.stepper.dt) > 1e-6:
        unlike.append(("data.time_step", agent.dt))
    if unlike:
        key, value = unlike[0]
        if isinstance(value, Mapping):
            value = value.get("name", dict(value))
        raise ConfigError(
            f"learner.start={start}: its {key} is {value} with other settings than here; set {key}"
            " as that job's config.yaml has it (experiment=fine_tune fits cfx://idm-history)"
        )


def begun(
    agent: Agent, network: PolicyNetwork, dataset: RolloutDataset
) -> tuple[PolicyNetwork, RolloutDataset]:
    """Starts networks with a trained agent's weights; the data take over its scaler.

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
    for name, value in agent.core.network.state_dict().items():
        repeated = value.repeat(len(dataset.pair) // size, *[1] * (value.dim() - 1))
        key = name
        if size > 1:
            # Trained one by one, networks are not yet the members of an ensemble.
            key = name.removeprefix("members.")
        weights[key] = repeated
    network.load_state_dict(weights)
    mean, scale = agent.core.scaler.mean, agent.core.scaler.scale
    networks = len(dataset.pair)
    scaler = Scaler(mean.expand(networks, -1).clone(), scale.expand(networks, -1).clone())
    return network, replace(dataset, scaler=scaler.to(dataset.pair.device))

"""Agents of constant parameters and of trained networks, as protocols test them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from cfx.core import registry
from cfx.data.pairs import PairBatch, PairSet
from cfx.errors import PluginError
from cfx.learners.base import CURVE_COLUMNS, Learner, TrainingResult
from cfx.policies.agent import Agent, TrainedOn
from cfx.policies.base import Policy
from cfx.policies.core import AgentCore
from cfx.policies.features import Scaler, token_width
from cfx.policies.heads import head_class, head_name
from cfx.policies.heads.base import ParameterHead
from cfx.policies.population import DriverPopulation
from cfx.policies.valid_range import recorded_quantiles
from cfx.simulation.base import Stepper
from cfx.simulation.windows import WindowSettings

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class AgentBuilder:
    """Makes agents, and writes into them what they were made of.

    Attributes:
        pairs, batch: the trajectories that they are calibrated on or learn from.
        model_node, policy_node: config nodes, kept with each agent.
        stepper: the driving model and its time step.
        learner: what trained the networks; named where they break their contract.
        windows: how trajectories are cut.
        seed: of the weights of networks that are not trained.
    """

    pairs: PairSet
    batch: PairBatch
    model_node: Mapping[str, Any]
    policy_node: Mapping[str, Any]
    stepper: Stepper
    learner: Learner
    windows: WindowSettings
    seed: int

    def constant(self, policy: Policy, parameters: Tensor) -> Agent:
        """Returns an agent of a policy as built, without training: the baselines.

        Args:
            policy: the component.
            parameters: `(N, n)`, SI units: what `policy=fixed` answers, and recurrent networks
                start from; one network for each row.
        """
        names = tuple(str(number) for number in range(len(parameters)))
        return self.trained(policy, self.untrained(policy, parameters), names)

    def untrained(self, policy: Policy, parameters: Tensor) -> TrainingResult:
        """Returns a policy's networks as built; see `constant`.

        They are in double precision, so that constant parameters stay what calibration
        found.
        """
        space = self.stepper.model.space
        width = token_width(policy.inputs, policy.summary, self.windows.length)
        unit = space.to_unit(parameters.cpu())
        network = policy.build(
            width, space.to_unit(space.defaults()), unit, torch.Generator().manual_seed(self.seed)
        )
        scaler = Scaler(unit.new_zeros((len(unit), width)), unit.new_ones((len(unit), width)))
        device = parameters.device
        return TrainingResult(
            network.to(device).eval(),
            scaler.to(device),
            pd.DataFrame(columns=CURVE_COLUMNS),
            head=policy.untrained_head,
        )

    def trained(
        self, policy: Policy, training_result: TrainingResult, names: tuple[str, ...]
    ) -> Agent:
        """Returns an agent of a learner's networks; `names` says what each is for.

        Raises:
            PluginError: the learner or the policy did not deliver such networks.
        """
        who = registry.origin(self.learner if policy.trainable else policy)
        if not isinstance(training_result, TrainingResult):
            raise PluginError(
                f"{who}: fit must return a cfx.plugin.TrainingResult, but returned a"
                f" {type(training_result).__name__}"
            )
        head = self._head(policy, training_result)
        _check_networks(who, training_result, len(names), head.answers)
        return Agent(
            core=AgentCore(policy, training_result.network, training_result.scaler, head),
            model_node=self.model_node,
            policy_node=self.policy_node,
            windows=self.windows,
            dt=self.stepper.dt,
            names=names,
            base=training_result.base,
            trained_on=self._trained_on(policy),
            valid_range=training_result.valid_range,
            dispersion=training_result.dispersion,
        )

    @cached_property
    def _quantiles(self) -> dict[str, tuple[float, ...]]:
        """`TrainedOn.quantiles` of all agents here."""
        return recorded_quantiles(self.batch)

    def _trained_on(self, policy: Policy) -> TrainedOn:
        """Returns what an agent's parameters were found on."""
        # Constant parameters are calibrated on these pairs, too.
        learned_from = {pair.likeness: pair.driver for pair in self.pairs}
        drivers = None
        if policy.trainable:
            drivers = DriverPopulation.of(self.batch, policy.driver_features, self.pairs.drivers)
        return TrainedOn(learned_from, self._quantiles, drivers=drivers)

    def _head(self, policy: Policy, training_result: TrainingResult) -> ParameterHead:
        """Returns the head that the learner trained its networks for."""
        has_base = training_result.base is not None
        name = training_result.head or head_name(has_base=has_base)
        if name not in registry.names("head"):
            raise PluginError(
                f"{registry.origin(self.learner)} breaks its contract: there is no head '{name}';"
                f" write one of {', '.join(registry.names('head'))}"
            )
        model = self.stepper.model
        head = head_class(name).for_model(model, training_result.scaler.mean.device)
        if policy.trainable and head.model_space != model.adaptation_space:
            log.info(
                "model.adaptation_bounds changes nothing here: this policy answers parameters,"
                " not offsets (learner=rollout, or learner.head=offset)"
            )
        return head


@torch.no_grad()
def _check_networks(
    who: str, training_result: TrainingResult, networks: int, parameters: int
) -> None:
    """Asks the networks about one window, so that a wrong shape or dtype ends in a sentence.

    Raises:
        PluginError: their number, the shape or dtype of an answer is wrong, or it is not finite.
    """
    mean = training_result.scaler.mean
    if mean.shape[0] != networks:
        raise PluginError(
            f"{who} breaks its contract: its scaler is for {mean.shape[0]} networks where"
            f" {networks} are wanted"
        )
    tokens = mean.new_zeros((networks, 1, 1, mean.shape[1]))
    state = training_result.network.initial_state(networks, 1)
    answer, _ = training_result.network(tokens, state)
    expected = (networks, 1, 1, parameters)
    if answer.shape != expected or answer.dtype != mean.dtype:
        raise PluginError(
            f"{who} breaks its contract: its networks answer {tuple(answer.shape)} in"
            f" {answer.dtype} where {expected} in {mean.dtype} are wanted"
        )
    if not bool(answer.isfinite().all() and mean.isfinite().all()):
        raise PluginError(
            f"{who}: its networks answer numbers that are not finite; train with a smaller"
            " learner.learning_rate, or repair it"
        )

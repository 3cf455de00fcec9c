"""Each statement of the contract fails for a policy that breaks it, and says so."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn

from cfx.policies import contract as first
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.gru import GruPolicy
from cfx_contracts import policies as checks

Change = Callable[[nn.Module, Tensor], Tensor]


class Network(PolicyNetwork):
    """Answers from the present token, and lets itself be spoiled."""

    def __init__(
        self, features: int, fixed: Tensor, draw: Callable[..., Tensor], change: Change | None
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(draw((len(fixed), features, fixed.shape[1])))
        self.change = change

    def initial_state(self, networks: int, drivers: int) -> Tensor:
        return self.weight.new_zeros((networks, drivers, 1))

    def forward(self, tokens: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        logits = torch.einsum("nbwf,nfp->nbwp", tokens, self.weight)
        return (
            logits.sigmoid() if self.change is None else self.change(self, logits)
        ), state + tokens.shape[2]


class Simple(Policy):
    change: ClassVar[Any] = None

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        def draw(shape: tuple[int, ...]) -> Tensor:
            return torch.randn(shape, generator=generator)

        network = Network(features, fixed, draw, type(self).change)
        self.finish(network)
        return network

    def finish(self, network: Network) -> None:
        """Changes a network once it is built."""


def spoiled(change: Change) -> Policy:
    return type("Spoiled", (Simple,), {"change": staticmethod(change)})()


def counted(network: nn.Module, logits: Tensor) -> Tensor:
    network.calls = getattr(network, "calls", 0) + 1
    return (logits + network.calls).sigmoid()


class Shared(Simple):
    def finish(self, network: Network) -> None:
        network.register_parameter("bias", nn.Parameter(torch.zeros(1)))


class Global(Simple):
    def finish(self, network: Network) -> None:
        network.weight = nn.Parameter(torch.randn(network.weight.shape))


class Forgetful(Simple):
    change = staticmethod(lambda network, logits: (logits + network.hidden).sigmoid())

    def finish(self, network: Network) -> None:
        network.hidden = float(network.weight.detach().sum())


class Idle(Simple):
    def finish(self, network: Network) -> None:
        network.register_parameter("unused", nn.Parameter(torch.zeros(len(network.weight))))


class Untrainable(Simple):
    trainable = False


def smeared(_: nn.Module, logits: Tensor) -> Tensor:
    return logits.mean(2, keepdim=True).expand_as(logits).sigmoid()


STREAMING = checks.streaming_equals_the_whole_sequence
BROKEN: dict[str, tuple[Policy, Any, str]] = {
    "unbounded": (spoiled(lambda _, x: x), checks.outputs_lie_within_the_bounds, "outside the model's bounds"),
    "NaN": (spoiled(lambda _, x: x.log()), checks.outputs_lie_within_the_bounds, "outside the model's bounds"),
    "one answer": (spoiled(lambda _, x: x[:, :, :1].sigmoid()), first.answers_in_the_precision_of_a_job, r"must give \(networks, drivers, windows, parameters\)"),
    "restarting": (spoiled(lambda _, x: x.cumsum(2).sigmoid()), STREAMING, "both must give the same"),
    "mean": (spoiled(smeared), checks.a_policy_does_not_look_ahead, "later windows"),
    "mixing": (spoiled(lambda _, x: (x + x.mean(0)).sigmoid()), checks.networks_are_independent, "read only slice i"),
    "shared": (Shared(), checks.networks_are_independent, "first dimension of bias"),
    "counting": (spoiled(counted), checks.state_is_passed_not_kept, "keeps state on itself"),
    "global": (Global(), checks.the_same_generator_gives_the_same_weights, "from the generator alone"),
    "forgetful": (Forgetful(), checks.saved_equals_loaded, "everything that the answers depend on"),
    "idle": (Idle(), checks.a_trainable_policy_has_gradients, "needs a finite gradient"),
    "untrainable": (Untrainable(), checks.a_trainable_policy_has_gradients, "anything to train"),
}  # fmt: skip


@pytest.mark.parametrize("broken", BROKEN)
def test_it_fails(broken: str) -> None:
    component, check, sentence = BROKEN[broken]
    with pytest.raises(AssertionError, match=sentence):
        check(component)


def test_every_statement_has_a_policy_that_breaks_it() -> None:
    assert {check for _, check, _ in BROKEN.values()} == set(checks.CONTRACT.checks)


@pytest.mark.parametrize("check", checks.CONTRACT.checks)
def test_sound_policies_hold_it(check: Any) -> None:
    check(Simple())
    check(GruPolicy(hidden_size=4))

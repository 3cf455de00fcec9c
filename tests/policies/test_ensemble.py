"""An ensemble is a policy's network like any other; it answers its networks' median."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cfx.policies.base import ConstantNetwork, Policy, PolicyNetwork
from cfx.policies.core import Ensemble
from cfx.policies.gru import GruPolicy
from cfx.policies.heads.offset import NONE
from cfx_contracts import policies as checks


class Three(GruPolicy):
    """Builds ensembles of three."""

    def build(
        self, features: int, default: Tensor, fixed: Tensor, generator: torch.Generator
    ) -> PolicyNetwork:
        return Ensemble(
            super().build(features, default, fixed.repeat_interleave(3, 0), generator), 3
        )


@pytest.mark.parametrize(
    "statement",
    [
        checks.outputs_lie_within_the_bounds,
        checks.streaming_equals_the_whole_sequence,
        checks.a_policy_does_not_look_ahead,
        checks.state_is_passed_not_kept,
        checks.saved_equals_loaded,
    ],
)
def test_it_keeps_what_the_contract_says_of_driving(statement: Callable[[Policy], None]) -> None:
    """Not what it says of training: members are trained, and put together then."""
    statement(Three(hidden_size=8))


def test_two_networks_answer_the_mean_of_their_logits() -> None:
    policy, generator = GruPolicy(hidden_size=6, start="middle"), torch.Generator().manual_seed(0)
    network = policy.build(5, torch.zeros(3), torch.zeros((4, 3)), generator).double()
    tokens = torch.randn((2, 3, 7, 5), generator=generator, dtype=torch.float64)
    ensemble = Ensemble(network, 2)
    together, state = ensemble(tokens, ensemble.initial_state(2, 3))
    alone, states = network(tokens[[0, 0, 1, 1]], network.initial_state(4, 3))
    torch.testing.assert_close(
        torch.logit(together), torch.logit(alone).view(2, 2, 3, 7, 3).mean(1)
    )
    torch.testing.assert_close(state[1, 2], torch.cat([states[2, 2], states[3, 2]]))


def test_networks_that_all_leave_the_base_leave_it_exactly() -> None:
    blank = torch.full((4, 3), NONE)
    ensemble = Ensemble(GruPolicy().build(5, blank[0], blank, torch.Generator().manual_seed(0)), 2)
    answer, _ = ensemble(torch.randn((2, 3, 1, 5)), ensemble.initial_state(2, 3))
    assert bool((answer == NONE).all())


def test_networks_without_a_memory_answer_together_too() -> None:
    unit = torch.tensor([[0.2, 0.5], [0.8, 0.5], [0.1, 0.9], [0.1, 0.9]])
    ensemble = Ensemble(ConstantNetwork(unit), 2)
    answer, state = ensemble(torch.zeros((2, 3, 4, 5)), ensemble.initial_state(2, 3))
    assert state.shape == (2, 3, 0)
    torch.testing.assert_close(answer[:, 0, 0], torch.tensor([[0.5, 0.5], [0.1, 0.9]]))


def test_an_answer_far_out_does_not_count() -> None:
    unit = torch.tensor([[0.4], [0.45], [0.55], [1e-5]])
    answer, _ = (ensemble := Ensemble(ConstantNetwork(unit), 4))(
        torch.zeros((1, 1, 1, 5)), ensemble.initial_state(1, 1)
    )
    assert 0.4 < float(answer) < 0.45

"""Every built-in policy holds the contract, and the batched recurrent networks are torch's."""

from __future__ import annotations

import pytest
import torch

from cfx.data.signals import OBSERVED
from cfx.errors import ConfigError
from cfx.policies.base import Policy
from cfx.policies.features import Scaler, token_width, tokens
from cfx.policies.gru import GruPolicy
from cfx.policies.inputs import INPUT_SETS, policy_inputs
from cfx.policies.lstm import LstmPolicy
from cfx.policies.recurrent import RecurrentNetwork
from cfx_contracts import check_contract


@pytest.mark.parametrize("component", [GruPolicy, LstmPolicy])
def test_contract_of_two_layers_and_other_inputs(component: type[Policy]) -> None:
    inputs = ("gap", "relative_speed")
    check_contract(component(layers=2, hidden_size=8, inputs=inputs, summary="mean_std"))


@pytest.mark.parametrize(
    ("component", "reference"), [(GruPolicy, torch.nn.GRU), (LstmPolicy, torch.nn.LSTM)]
)
def test_recurrent_networks_are_torchs(
    component: type[Policy], reference: type[torch.nn.RNNBase]
) -> None:
    policy = component(layers=2, hidden_size=6, start="middle")
    network = policy.build(
        5, torch.zeros(3), torch.zeros((2, 3)), torch.Generator().manual_seed(0)
    ).double()
    assert isinstance(network, RecurrentNetwork)
    x = torch.randn((2, 3, 9, 5), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    ours, _ = network(x, network.initial_state(2, 3))
    for i in range(2):
        theirs = reference(5, 6, num_layers=2, batch_first=True).double()
        with torch.no_grad():
            for k, layer in enumerate(network.layers):
                getattr(theirs, f"weight_ih_l{k}").copy_(layer.w_input[i].T)
                getattr(theirs, f"weight_hh_l{k}").copy_(layer.w_hidden[i].T)
                getattr(theirs, f"bias_ih_l{k}").copy_(layer.b_input[i, 0])
                getattr(theirs, f"bias_hh_l{k}").copy_(layer.b_hidden[i, 0])
            expected = (theirs(x[i])[0] @ network.w_out[i] + network.b_out[i]).sigmoid()
        torch.testing.assert_close(ours[i], expected)


@pytest.mark.parametrize("component", [GruPolicy, LstmPolicy])
def test_an_acting_bias_tells_acting_from_observing_and_begins_without_effect(
    component: type[Policy],
) -> None:
    generator = torch.Generator().manual_seed(0)
    fixed = torch.rand((2, 3), generator=generator)
    tokens = torch.randn((2, 4, 5, 6), generator=generator)
    seeds = [torch.Generator().manual_seed(1) for _ in range(2)]
    plain = component().build(6, fixed[0], fixed, seeds[0])
    network = component(acting_bias=True).build(6, fixed[0], fixed, seeds[1])
    assert isinstance(network, RecurrentNetwork)
    state = network.initial_state(2, 4)
    assert torch.equal(network(tokens, state)[1], plain(tokens, state)[1])
    assert network.b_acting is not None
    with torch.no_grad():
        network.b_acting.normal_(generator=generator)
    observed = network.observe(tokens, state)
    assert torch.equal(observed, plain.observe(tokens, state))
    assert not torch.allclose(network(tokens, state)[1], observed, atol=1e-3)


def test_tokens_have_the_declared_width_and_are_finite_at_standstill() -> None:
    history = {name: torch.zeros((2, 5)) for name in OBSERVED}
    inputs = policy_inputs((*INPUT_SETS["motion"], "inverse_time_to_collision", "follower_speed"))
    for summary in ("frames", "last", "mean", "mean_std"):
        out = tokens(history, inputs, summary)
        assert out.shape == (2, token_width(inputs, summary, 5))
        assert bool(out.isfinite().all())


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (("leader_sped",), "Did you mean 'leader_speed'"),
        ((), "give at least one"),
        (("gap", "gap"), "stands twice"),
    ],
)
def test_wrong_inputs_are_named(inputs: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        GruPolicy(inputs=inputs)


@pytest.mark.parametrize(
    ("name", "message"), [("situatoin", "Did you mean 'situation'"), ("gap", r"Write \[gap\]")]
)
def test_a_set_of_inputs_goes_by_its_name(name: str, message: str) -> None:
    listed = GruPolicy(inputs=INPUT_SETS["situation"])
    assert GruPolicy(inputs="situation").identity() == listed.identity()
    with pytest.raises(ConfigError, match=message):
        GruPolicy(inputs=name)
    more = GruPolicy(inputs=("situation", "leader_jerk"))
    assert more.inputs == (*INPUT_SETS["situation"], "leader_jerk")
    with pytest.raises(ConfigError, match="stands twice"):
        GruPolicy(inputs=("situation", "gap"))


@pytest.mark.parametrize("component", [GruPolicy, LstmPolicy])
def test_an_untrained_network_is_the_fixed_model(component: type[Policy]) -> None:
    fixed = torch.tensor([[0.1, 0.5], [0.9, 0.0]])
    network = component().build(4, torch.full((2,), 0.5), fixed, torch.Generator().manual_seed(0))
    out, _ = network(torch.randn((2, 3, 5, 4)), network.initial_state(2, 3))
    expected = fixed.clamp(0.02, 0.98)[:, None, None].expand_as(out)
    torch.testing.assert_close(out, expected)


def test_a_scaler_measures_drivers_in_shards() -> None:
    """The number of drivers that are read at once changes nothing but rounding."""
    generator = torch.Generator().manual_seed(0)
    values = 3.0 + torch.randn((2, 7, 5, 3), dtype=torch.float64, generator=generator)
    mask = torch.rand((2, 7, 5), generator=generator) > 0.3
    whole = Scaler.of(values, mask)
    cuts = (slice(0, 4), slice(4, 7))
    parts = Scaler.of_shards(lambda: [(values[:, cut], mask[:, cut]) for cut in cuts])
    for network in range(2):
        counted = values[network][mask[network]]
        torch.testing.assert_close(parts.mean[network], counted.mean(0))
        torch.testing.assert_close(parts.scale[network], counted.std(0, correction=0))
    torch.testing.assert_close(parts.scale, whole.scale)

"""The contract of a policy, statement by statement. Shapes as in `cfx.policies.base`."""

from __future__ import annotations

import torch

from cfx.core.contract import expect_close
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.contract import (
    DRIVERS,
    FIRST,
    NETWORKS,
    WINDOWS,
    build,
    features_of,
    random_tokens,
)
from cfx_contracts import contract_of


def _network(policy: Policy) -> PolicyNetwork:
    """Returns freshly built networks in evaluation mode, float64."""
    return build(policy, features_of(policy), seed=1).double().eval()


def outputs_lie_within_the_bounds(policy: Policy) -> None:
    network = _network(policy)
    tokens = random_tokens(policy)
    out, _ = network(1e3 * tokens, network.initial_state(NETWORKS, DRIVERS))
    assert bool(((out >= 0) & (out <= 1)).all()), (
        "a policy answers in unit space: no parameter is ever outside the model's bounds"
    )


def streaming_equals_the_whole_sequence(policy: Policy) -> None:
    network = _network(policy)
    tokens = random_tokens(policy)
    whole, last = network(tokens, network.initial_state(NETWORKS, DRIVERS))
    state = network.initial_state(NETWORKS, DRIVERS)
    pieces = []
    for k in range(WINDOWS):
        piece, state = network(tokens[:, :, k : k + 1], state)
        pieces.append(piece)
    message = (
        "training reads whole sequences, simulation one window at a time: both must give the same"
    )
    expect_close(torch.cat(pieces, dim=2), whole, msg=message)
    expect_close(state, last, msg=message)


def a_policy_does_not_look_ahead(policy: Policy) -> None:
    network = _network(policy)
    tokens = random_tokens(policy)
    changed = tokens.clone()
    changed[:, :, WINDOWS // 2 :] += 1.0
    before, _ = network(tokens, network.initial_state(NETWORKS, DRIVERS))
    after, _ = network(changed, network.initial_state(NETWORKS, DRIVERS))
    half = WINDOWS // 2
    assert torch.equal(before[:, :, :half], after[:, :, :half]), (
        "the parameters of a window depend on later windows, which a driver has not seen yet"
    )


def networks_are_independent(policy: Policy) -> None:
    network = _network(policy)
    tokens = random_tokens(policy)
    changed = tokens.clone()
    changed[0] += 1.0
    before, _ = network(tokens, network.initial_state(NETWORKS, DRIVERS))
    after, _ = network(changed, network.initial_state(NETWORKS, DRIVERS))
    expect_close(
        before[1:],
        after[1:],
        msg="network i must read only slice i of its tokens: drivers would learn from one another",
    )
    for name, value in [*network.named_parameters(), *network.named_buffers()]:
        assert value.shape[0] == NETWORKS, (
            f"the first dimension of {name} must be the networks, so that the learner can treat"
            " each on its own"
        )


def state_is_passed_not_kept(policy: Policy) -> None:
    network = _network(policy)
    tokens = random_tokens(policy)
    first, _ = network(tokens, network.initial_state(NETWORKS, DRIVERS))
    again, _ = network(tokens, network.initial_state(NETWORKS, DRIVERS))
    assert torch.equal(first, again), (
        "two calls with the same tokens and state differ: the network keeps state on itself, and"
        " one simulation would change the next"
    )


def the_same_generator_gives_the_same_weights(policy: Policy) -> None:
    features = features_of(policy)
    first = build(policy, features, seed=3).state_dict()
    second = build(policy, features, seed=3).state_dict()
    assert all(torch.equal(first[key], second[key]) for key in first), (
        "initial weights must come from the generator alone, or no training can be repeated"
    )


def saved_equals_loaded(policy: Policy) -> None:
    features = features_of(policy)
    network = _network(policy)
    tokens = random_tokens(policy)
    other = build(policy, features, seed=4).double().eval()
    other.load_state_dict(network.state_dict())
    mine, _ = network(tokens, network.initial_state(NETWORKS, DRIVERS))
    theirs, _ = other(tokens, other.initial_state(NETWORKS, DRIVERS))
    assert torch.equal(mine, theirs), (
        "the state dict must hold everything that the answers depend on: it is all that a saved"
        " policy keeps"
    )


def a_trainable_policy_has_gradients(policy: Policy) -> None:
    network = _network(policy)
    tokens = random_tokens(policy)
    parameters = [parameter for parameter in network.parameters() if parameter.requires_grad]
    assert bool(parameters) == policy.trainable, (
        "`trainable` must say whether there is anything to train: labels and training cost a job"
        " its time"
    )
    if policy.trainable:
        network(tokens, network.initial_state(NETWORKS, DRIVERS))[0].square().sum().backward()
        assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in parameters), (
            "every weight needs a finite gradient"
        )


CONTRACT = contract_of(__name__, "policy", first=FIRST)

"""The contract of a policy, statement by statement. Shapes as in `cfx.policies.base`."""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.contracts import contract_of, expect_close, expect_tensor
from cfx.models.idm import IDM
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.features import token_width
from cfx.simulation.settings import WindowSettings

NETWORKS, DRIVERS, WINDOWS, PARAMETERS, LENGTH = 3, 2, 7, 5, 5
"""As many parameters as IDM has, for which a policy is built."""

DT = 0.1
"""Time step, s."""


def _features(policy: Policy) -> int:
    """Returns f for windows of five frames."""
    return token_width(policy.inputs, policy.summary, LENGTH)


def _network(policy: Policy) -> PolicyNetwork:
    """Returns freshly built networks in evaluation mode, float64."""
    return _build(policy, _features(policy), seed=1).double().eval()


def _tokens(policy: Policy) -> Tensor:
    """Returns random tokens."""
    return 3 * torch.randn(
        (NETWORKS, DRIVERS, WINDOWS, _features(policy)),
        generator=torch.Generator().manual_seed(2),
        dtype=torch.float64,
    )


def answers_in_the_precision_of_a_job(policy: Policy) -> None:
    # A learner trains in single precision; what needs no training computes in double precision, so
    # that constants stay what they are.
    dtype = torch.float32 if policy.trainable else torch.float64
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        network = _build(policy, _features(policy), seed=1, dtype=dtype)
        assert isinstance(network, PolicyNetwork), (
            f"build returns a {type(network).__name__} and no PolicyNetwork"
        )
        state = network.initial_state(NETWORKS, DRIVERS)
        answer, after = network.eval()(_tokens(policy).to(dtype), state)
    known = isinstance(state, Tensor) and state.dim() == 3
    shape = (NETWORKS, DRIVERS, state.shape[2] if known else 0)
    words = "(networks, drivers, s)"
    expect_tensor(state, "initial_state", shape, getattr(state, "dtype", dtype), words)
    expect_tensor(after, "the state after the last window", shape, state.dtype, words)
    wanted = (NETWORKS, DRIVERS, WINDOWS, PARAMETERS)
    expect_tensor(answer, "forward", wanted, dtype, "(networks, drivers, windows, parameters)")
    assert bool(((answer >= 0) & (answer <= 1)).all()), (  # written so that NaN fails too
        "forward answers NaN or a number outside [0, 1]; parameters are chosen in unit space"
    )


def outputs_lie_within_the_bounds(policy: Policy) -> None:
    network = _network(policy)
    tokens = _tokens(policy)
    out, _ = network(1e3 * tokens, network.initial_state(NETWORKS, DRIVERS))
    assert bool(((out >= 0) & (out <= 1)).all()), (
        "a policy answers in unit space: no parameter is ever outside the model's bounds"
    )


def streaming_equals_the_whole_sequence(policy: Policy) -> None:
    network = _network(policy)
    tokens = _tokens(policy)
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
    tokens = _tokens(policy)
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
    tokens = _tokens(policy)
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
    tokens = _tokens(policy)
    first, _ = network(tokens, network.initial_state(NETWORKS, DRIVERS))
    again, _ = network(tokens, network.initial_state(NETWORKS, DRIVERS))
    assert torch.equal(first, again), (
        "two calls with the same tokens and state differ: the network keeps state on itself, and"
        " one simulation would change the next"
    )


def the_same_generator_gives_the_same_weights(policy: Policy) -> None:
    features = _features(policy)
    one = _build(policy, features, seed=3).state_dict()
    two = _build(policy, features, seed=3).state_dict()
    assert all(torch.equal(one[key], two[key]) for key in one), (
        "initial weights must come from the generator alone, or no training can be repeated"
    )


def saved_equals_loaded(policy: Policy) -> None:
    features = _features(policy)
    network = _network(policy)
    tokens = _tokens(policy)
    other = _build(policy, features, seed=4).double().eval()
    other.load_state_dict(network.state_dict())
    mine, _ = network(tokens, network.initial_state(NETWORKS, DRIVERS))
    theirs, _ = other(tokens, other.initial_state(NETWORKS, DRIVERS))
    assert torch.equal(mine, theirs), (
        "the state dict must hold everything that the answers depend on: it is all that a saved"
        " policy keeps"
    )


def a_trainable_policy_has_gradients(policy: Policy) -> None:
    network = _network(policy)
    tokens = _tokens(policy)
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


def _build(
    policy: Policy, features: int, *, seed: int, dtype: torch.dtype = torch.float32
) -> PolicyNetwork:
    policy = policy.for_model(IDM(), DT, WindowSettings(length=LENGTH, stride=LENGTH))
    generator = torch.Generator().manual_seed(seed)
    fixed = torch.rand((NETWORKS, PARAMETERS), generator=torch.Generator().manual_seed(0)).to(dtype)
    return policy.build(features, torch.full((PARAMETERS,), 0.5, dtype=dtype), fixed, generator)


CONTRACT = contract_of(__name__, "policy", first=[answers_in_the_precision_of_a_job])

"""The first statement of a policy's contract. Shapes as in `cfx.policies.base`."""

from __future__ import annotations

import torch
from torch import Tensor

from cfx.core.contract import expect_tensor
from cfx.models.idm import IDM
from cfx.policies.base import Policy, PolicyNetwork
from cfx.policies.features import token_width
from cfx.simulation.settings import WindowSettings

NETWORKS, DRIVERS, WINDOWS, PARAMETERS, LENGTH = 3, 2, 7, 5, 5
"""As many parameters as IDM has, for which a policy is built."""

DT = 0.1
"""Time step, s."""


def features_of(policy: Policy) -> int:
    """Returns f for windows of five frames."""
    return token_width(policy.inputs, policy.summary, LENGTH)


def random_tokens(policy: Policy) -> Tensor:
    """Returns random tokens."""
    return 3 * torch.randn(
        (NETWORKS, DRIVERS, WINDOWS, features_of(policy)),
        generator=torch.Generator().manual_seed(2),
        dtype=torch.float64,
    )


def answers_in_the_precision_of_a_job(policy: Policy) -> None:
    # A learner trains in single precision; what needs no training computes in double precision, so
    # that constant parameters stay what they are.
    dtype = torch.float64
    if policy.trainable:
        dtype = torch.float32
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        network = build(policy, features_of(policy), seed=1, dtype=dtype)
        assert isinstance(network, PolicyNetwork), (
            f"build returns a {type(network).__name__} and no PolicyNetwork"
        )
        state = network.initial_state(NETWORKS, DRIVERS)
        answer, after = network.eval()(random_tokens(policy).to(dtype), state)
    width = 0
    if isinstance(state, Tensor) and state.dim() == 3:
        width = state.shape[2]
    shape = (NETWORKS, DRIVERS, width)
    words = "(networks, drivers, s)"
    expect_tensor(state, "initial_state", shape, getattr(state, "dtype", dtype), words)
    expect_tensor(after, "the state after the last window", shape, state.dtype, words)
    words = "(networks, drivers, windows, parameters)"
    shape_of_answers = (NETWORKS, DRIVERS, WINDOWS, PARAMETERS)
    expect_tensor(answer, "forward", shape_of_answers, dtype, words)
    assert bool(((answer >= 0) & (answer <= 1)).all()), (  # written so that NaN fails too
        "forward answers NaN or a number outside [0, 1]; parameters are chosen in unit space"
    )


def build(
    policy: Policy, features: int, *, seed: int, dtype: torch.dtype = torch.float32
) -> PolicyNetwork:
    """Returns networks for IDM, with weights of a seed."""
    policy = policy.for_model(IDM(), DT, WindowSettings(length=LENGTH, stride=LENGTH))
    generator = torch.Generator().manual_seed(seed)
    fixed = torch.rand((NETWORKS, PARAMETERS), generator=torch.Generator().manual_seed(0)).to(dtype)
    return policy.build(features, torch.full((PARAMETERS,), 0.5, dtype=dtype), fixed, generator)


FIRST = (answers_in_the_precision_of_a_job,)

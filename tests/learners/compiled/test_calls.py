"""Calls of compiled code do what PyTorch's operations do, window by window."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from cfx.learners.compiled.calls import Calls, Operand
from cfx.learners.rollout.window import GradientPath, LoopState
from cfx.simulation.kernel import compiler

pytestmark = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C++ compiler")

NETWORKS, WINDOWS = 2, 3


def normal(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(sum(shape)))


def rows(values: Tensor) -> Operand:
    """Returns `(windows, N, D, width)` as the operand of a window, `(N, 1, D, width)`."""
    return Operand.over(values.unsqueeze(2))


@pytest.mark.parametrize("accumulates", [False, True])
@pytest.mark.parametrize(("count", "inner", "outer"), [(1, 3, 1), (9, 5, 16), (15, 20, 37)])
def test_a_product_is_that_of_pytorch(
    count: int, inner: int, outer: int, accumulates: bool
) -> None:
    """For numbers of rows and columns that fill the vector registers and that do not."""
    given, weights = normal(WINDOWS, NETWORKS, count, inner), normal(NETWORKS, inner, outer)
    to = normal(WINDOWS, NETWORKS, count, outer)
    expected = given @ weights
    if accumulates:
        expected = expected + to
    calls = Calls()
    calls.product(rows(given), weights, rows(to), accumulates=accumulates)
    calls.run(range(WINDOWS), slice(0, NETWORKS))
    torch.testing.assert_close(to, expected, rtol=1e-5, atol=1e-5)


def test_calls_change_the_chosen_networks_and_windows_alone() -> None:
    given, weights = normal(WINDOWS, NETWORKS, 4, 3), normal(NETWORKS, 3, 2)
    to = torch.zeros((WINDOWS, NETWORKS, 4, 2))
    calls = Calls()
    calls.product(rows(given), weights, rows(to))
    calls.run(range(2, 0, -1), slice(1, 2))
    assert bool((to[0] == 0).all())
    assert bool((to[:, 0] == 0).all())
    torch.testing.assert_close(to[1:, 1], given[1:, 1] @ weights[1], rtol=1e-5, atol=1e-5)


def test_what_bounds_gradients_is_what_autograd_does_between_windows() -> None:
    gradient = normal(WINDOWS, NETWORKS, 4, 2)
    gradient[0, 0, 0] = torch.tensor([torch.nan, torch.inf])
    expected = gradient.clone()
    path = GradientPath(decay=0.8, clip=0.5)
    for window in (0, 2):
        values = torch.zeros_like(expected[window]).requires_grad_()
        nothing = torch.zeros(0, requires_grad=True)
        state: Any = path.after_window(LoopState(values, *[nothing] * 5))
        state.position.backward(gradient[window])
        assert values.grad is not None
        expected[window] = values.grad
    calls = Calls()
    calls.bound(rows(gradient), path.decay, path.clip, except_window=1)
    calls.run(range(WINDOWS), slice(0, NETWORKS))
    torch.testing.assert_close(gradient, expected, rtol=0, atol=0)


def test_one_operand_is_added_to_another() -> None:
    to, added = normal(WINDOWS, NETWORKS, 4, 2), normal(WINDOWS, NETWORKS, 2, 4).mT
    expected = to + added
    calls = Calls()
    calls.add(rows(to), rows(added))
    calls.run(range(WINDOWS), slice(0, NETWORKS))
    assert torch.equal(to, expected)

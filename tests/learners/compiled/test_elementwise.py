"""Elementwise functions as compiled code: values and gradients are PyTorch's."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from cfx.learners.compiled.elementwise import Elementwise
from cfx.simulation.kernel import compiler
from cfx.simulation.kernel.columns import Unsupported

pytestmark = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C++ compiler")


def smooth(a: Tensor, b: Tensor) -> list[Tensor]:
    x, y, z = a.unbind(-1)
    w = b[..., 0]
    first = x.tanh() * y.exp() / (z.square() + 1.0) - torch.sigmoid(x * y)
    second = torch.log(z.abs() + 0.5) + torch.sqrt(y.square() + 0.1) - torch.expm1(x) ** 3
    third = (x.abs() + 0.2) ** (y * 0.3) + torch.atan(x) * torch.sin(y) * torch.cos(z)
    return [torch.stack([first, second], -1), (third * w - torch.lerp(x, y, w))[..., None]]


def kinks(a: Tensor, b: Tensor) -> list[Tensor]:
    x, y, z = a.unbind(-1)
    w = b[..., 0]
    chosen = torch.where(x > y, x * w, torch.minimum(y, z)) + torch.maximum(x, w) * z.relu()
    bounded = x.clamp(-0.5, 0.5) + y.clamp(min=0.0) * z.clamp(max=0.2) + torch.logit(w, eps=0.3)
    return [torch.stack([chosen, bounded], -1), ((x - z).abs() * w)[..., None]]


def equal(a: Tensor, b: Tensor) -> list[Tensor]:
    """Equal operands share the gradient, and bounds pass it on."""
    x, w = a[..., 0], b[..., 0]
    same = torch.minimum(x, x + 0.0) + torch.maximum(w, w * 1.0)
    at_bound = (x - x).clamp(0.0, 1.0) * w
    return [torch.stack([same, at_bound], -1), (x * w)[..., None]]


@pytest.mark.parametrize("function", [smooth, kinks, equal])
def test_values_and_gradients_are_those_of_pytorch(
    function: Callable[[Tensor, Tensor], Sequence[Tensor]],
) -> None:
    """For any strides, and more elements than one block has."""
    generator = torch.Generator().manual_seed(0)
    a = torch.randn((3, 2, 3, 70), generator=generator).movedim(1, -1)
    b = torch.rand((2, 1, 70, 1), generator=generator).expand(2, 3, 70, 1)
    a = a.movedim(-1, 0)[0][None].expand(2, 3, 3, 70).transpose(-1, -2).clone()
    leaves = a.clone().requires_grad_(), b.clone().requires_grad_()
    expected = function(*leaves)
    given = [torch.randn(one.shape, generator=generator) for one in expected]
    wanted = torch.autograd.grad(list(expected), leaves, given)
    compiled = Elementwise(function, (3, 1), (0, 1))
    values = [torch.empty_like(one) for one in expected]
    compiled.forward((a, b), *values)
    # Written column first, as closed loops keep their states.
    gradients = [torch.empty((3, 2, 3, 70)).movedim(0, -1), torch.empty(b.shape)]
    compiled.backward((a, b), given, *gradients)
    for one, two in zip((*values, *gradients), (*expected, *wanted), strict=True):
        torch.testing.assert_close(one, two.detach(), rtol=1e-4, atol=1e-5)


def test_a_result_without_gradient_counts_as_zero() -> None:
    a, b = torch.rand((1, 1, 5, 3)), torch.rand((1, 1, 5, 1))
    compiled = Elementwise(lambda x, y: [x * y, x[..., :1]], (3, 1), (1,))
    gradient = torch.empty_like(b)
    compiled.backward((a, b), [None, torch.ones((1, 1, 5, 1))], gradient)
    assert bool((gradient == 0).all())


def test_what_is_not_elementwise_is_refused() -> None:
    with pytest.raises(Unsupported):
        Elementwise(lambda x: [x - x.mean()], (2,), (0,))
    with pytest.raises(Unsupported, match="a gradient that is cut"):
        Elementwise(lambda x: [x * x.detach()], (2,), (0,))
    with pytest.raises(Unsupported, match="the derivative of"):
        Elementwise(lambda x, y: [huber_loss(x, y, reduction="none")], (2, 2), (0,))

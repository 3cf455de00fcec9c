"""The ways that gradients take back."""

from __future__ import annotations

import pytest
import torch

from cfx.learners.rollout.window import GradientPath, LoopState

MEMORY = GradientPath(0.5, 1.0, through_motion=False)


def a_state() -> LoopState:
    generator = torch.Generator().manual_seed(0)
    values = []
    for _ in range(len(LoopState._fields)):
        values.append(torch.randn((2, 3, 4), generator=generator).requires_grad_())
    return LoopState(*values)


@pytest.mark.parametrize("path", [GradientPath(0.5, 1.0), MEMORY])
def test_values_stay_as_they_are(path: GradientPath) -> None:
    state = a_state()
    for after in (path.after_window(state), path.after_segment(state)):
        for one, two in zip(state, after, strict=True):
            assert torch.equal(one, two)


def test_gradients_decay_and_are_clipped() -> None:
    state = a_state()
    after = GradientPath(0.5, 1.0).after_window(state)
    factors = torch.tensor([0.4, -1.6, 6.0, torch.nan])
    (after.speed * factors).sum().backward()
    assert state.speed.grad is not None
    expected = torch.tensor([0.2, -0.8, 1.0, 0.0]).expand(2, 3, 4)
    torch.testing.assert_close(state.speed.grad, expected)


def test_through_memory_no_gradient_comes_back_through_the_motion() -> None:
    state = a_state()
    after = MEMORY.after_window(state)
    torch.stack(list(after)).sum().backward()
    assert state.state.grad is not None
    for value in state[:4]:
        assert value.grad is None


def test_segments_are_cut_apart() -> None:
    path = GradientPath(0.5, 1.0, cut_after=4)
    state = a_state()
    torch.stack(list(path.after_segment(state))).sum().backward()
    for value in state:
        assert value.grad is None

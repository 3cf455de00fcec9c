"""The contract of parameter heads, for every head there is."""

from __future__ import annotations

import pytest
import torch

from cfx.core import registry
from cfx.core.component import validate
from cfx.errors import ConfigError, PluginError
from cfx.learners.imitation import ImitationSettings
from cfx.learners.rollout.settings import RolloutSettings
from cfx.models.w99 import W99
from cfx.policies.heads import head_class
from cfx.policies.heads.base import ParameterHead

MODEL = W99()


@pytest.fixture(params=registry.names("head"))
def head(request: pytest.FixtureRequest) -> ParameterHead:
    return head_class(request.param).for_model(MODEL)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_it_goes_by_the_name_that_it_is_saved_under(head: ParameterHead) -> None:
    assert head_class(head.name) is type(head)


def test_no_answer_leaves_the_bounds(head: ParameterHead) -> None:
    n, answers = len(head.space), head.answers
    unit = head.unit_parameters(random(50, answers), random(50, n, seed=1))
    assert unit.shape == (50, n)
    assert bool(((unit >= 0) & (unit <= 1)).all())
    ends = torch.tensor([0.0, 1.0]).double()[:, None].expand(2, answers)
    edges = head.unit_parameters(ends, random(n))
    assert bool(edges.isfinite().all())


def test_an_untrained_network_is_what_the_head_starts_from(head: ParameterHead) -> None:
    """What an untrained head answers, or the base; with these being the same, both are it."""
    fixed = random(3, head.answers)
    unit = head.unit_parameters(head.untrained_answer(fixed), fixed)
    torch.testing.assert_close(unit[:, : head.answers], fixed, rtol=0, atol=1e-12)


def test_it_says_how_wide_its_conditioning_is(head: ParameterHead) -> None:
    conditioning = head.condition(random(2, 3, len(head.space)))
    assert conditioning.shape == (2, 3, head.width)
    assert bool(conditioning.isfinite().all())
    assert head.needs_base == (head.width > 0)


def test_a_batch_is_the_loop_over_it(head: ParameterHead) -> None:
    n = len(head.space)
    answer, base = random(4, 3, head.answers), random(4, 3, n, seed=1)
    together = head.unit_parameters(answer, base)
    for i in range(4):
        alone = head.unit_parameters(answer[i], base[i])
        torch.testing.assert_close(together[i], alone, rtol=0, atol=1e-15)


def test_gradients_reach_the_answer(head: ParameterHead) -> None:
    n = len(head.space)
    answer = random(2, head.answers).requires_grad_()
    base = 0.1 + 0.8 * random(2, n, seed=1)
    assert torch.autograd.gradcheck(lambda a: head.unit_parameters(a, base), (answer,))


def test_single_precision_agrees_with_double(head: ParameterHead) -> None:
    n = len(head.space)
    answer, base = random(20, head.answers), random(20, n, seed=1)
    single = head.unit_parameters(answer.float(), base.float())
    assert single.dtype == torch.float32
    double = head.unit_parameters(answer, base)
    torch.testing.assert_close(single.double(), double, rtol=0, atol=1e-5)


def test_a_learner_takes_the_heads_that_it_trains() -> None:
    assert ImitationSettings(head="offset").head == "offset"
    with pytest.raises(ConfigError, match=r"head='residual': should be one of direct, .*offset"):
        validate(ImitationSettings, {"head": "residual"}, where="learner")
    with pytest.raises(ConfigError, match=r"should be one of .*offset, residual, stochastic"):
        validate(RolloutSettings, {"head": "direct"}, where="learner")


def test_a_head_that_is_not_there() -> None:
    with pytest.raises(PluginError, match=r"there is no head 'mixture'\. Known: direct, "):
        head_class("mixture")

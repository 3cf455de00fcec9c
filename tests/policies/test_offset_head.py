from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from cfx.core.parameters import squashed
from cfx.models.krauss import Krauss
from cfx.policies.heads.offset import NONE, moved, shrunk

unit = st.floats(0.0, 1.0)


@given(unit)
def test_no_offset_leaves_the_base_exactly(base: float) -> None:
    value = torch.tensor([base], dtype=torch.float64)
    assert torch.equal(moved(value, torch.full_like(value, NONE)), value)


@given(unit, unit)
def test_no_answer_leaves_the_bounds(base: float, answer: float) -> None:
    result = moved(torch.tensor(base).double(), torch.tensor(answer).double())
    assert 0.0 <= float(result) <= 1.0


@given(unit, unit, unit)
def test_a_larger_answer_gives_a_larger_parameter(base: float, one: float, other: float) -> None:
    low, high = sorted((one, other))
    value = torch.tensor(base).double()
    assert (
        float(moved(value, torch.tensor(low).double()))
        <= float(moved(value, torch.tensor(high).double())) + 1e-12
    )


@given(st.floats(0.01, 0.99), st.floats(0.01, 0.99))
def test_offsets_add_up_on_logits(base: float, answer: float) -> None:
    """Inside the bounds the squashed space is the logit: the closed form."""
    b, a = torch.tensor(base).double(), torch.tensor(answer).double()
    torch.testing.assert_close(
        moved(b, a), torch.sigmoid(torch.logit(b) + 3.0 * torch.logit(a)), rtol=0, atol=1e-12
    )


SPACE = Krauss().space


def krauss(unit: float) -> torch.Tensor:
    return SPACE.from_unit(torch.full((1, len(SPACE)), unit, dtype=torch.float64))


@given(unit)
def test_without_shrinkage_a_set_stays_exactly_and_with_all_of_it_is_the_default(
    own: float,
) -> None:
    values = krauss(own)
    assert torch.equal(shrunk(SPACE, values, 0.0), values)
    torch.testing.assert_close(shrunk(SPACE, values, 1.0)[0], SPACE.defaults(), rtol=0, atol=1e-9)


@given(unit, st.floats(0.001, 1.0), st.floats(0.001, 1.0))
def test_more_shrinkage_brings_a_set_nearer_to_the_default(
    own: float, one: float, other: float
) -> None:
    less, more = sorted((one, other))
    far, near = ((shrunk(SPACE, krauss(own), s) - SPACE.defaults()).abs() for s in (less, more))
    assert bool((near <= far + 1e-9).all())


def test_a_base_at_its_bound_can_be_moved_and_has_finite_coordinates() -> None:
    base = torch.tensor([0.0, 1.0])
    assert bool(squashed(base).isfinite().all())
    answer = torch.tensor([0.9, 0.1], requires_grad=True)
    result = moved(base, answer)
    assert float(result[0].detach()) > 0.02
    assert float(result[1].detach()) < 0.98
    result.sum().backward()
    assert answer.grad is not None
    assert bool((answer.grad > 0).all())

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from cfx.models.base import DrivingModel, Follower, Leader
from cfx.models.krauss import Krauss
from cfx.models.regimes import where_below, where_up_to
from cfx.models.w99 import W99

numbers = st.floats(-50.0, 50.0)


@given(numbers, numbers)
def test_without_softness_the_choice_is_exact(value: float, threshold: float) -> None:
    yes, no = torch.tensor([1.0, 2.0], dtype=torch.float64)
    v, t = torch.tensor([value, threshold], dtype=torch.float64)
    assert float(where_below(v, t, yes, no, scale=1.0, temperature=0.0)) == (
        1.0 if value < threshold else 2.0
    )
    assert float(where_up_to(v, t, yes, no, scale=1.0, temperature=0.0)) == (
        1.0 if value <= threshold else 2.0
    )


@given(numbers, numbers, st.floats(0.05, 3.0))
def test_a_soft_choice_is_the_logistic_mixture(
    value: float, threshold: float, temperature: float
) -> None:
    yes, no = torch.tensor([1.0, 2.0], dtype=torch.float64)
    v, t = torch.tensor([value, threshold], dtype=torch.float64)
    weight = torch.sigmoid((t - v) / (2.0 * temperature))
    torch.testing.assert_close(
        where_below(v, t, yes, no, scale=2.0, temperature=temperature), 2.0 - weight
    )


def states(count: int = 400) -> tuple[Follower, Leader]:
    draw = torch.Generator().manual_seed(0)

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, generator=draw, dtype=torch.float64)

    speed, leader_speed = uniform(2, 20), uniform(2, 20)
    leader = Leader(
        uniform(100, 100.1), leader_speed, uniform(-1, 1), torch.full((count,), 5.0).double()
    )
    follower = Follower(
        leader.position - 5 - uniform(1, 60), speed, uniform(-1, 1), speed.new_zeros((count, 0))
    )
    return follower, leader


def check_that_it_tends_to_the_exact_one(model: DrivingModel) -> None:
    """All but the states that lie on a threshold give the same speed as temperature goes to 0."""
    follower, leader = states()
    p = model.space.unpack(model.space.defaults())
    exact = model.next_speed(follower, leader, p, 0.1)
    gaps = [
        (model.at_temperature(s).next_speed(follower, leader, p, 0.1) - exact).abs()
        for s in (1.0, 0.1, 1e-4)
    ]
    assert float(gaps[0].mean()) > float(gaps[1].mean()) > float(gaps[2].mean())
    assert float((gaps[2] < 1e-9).double().mean()) > 0.99
    assert model.temperature == 0


def check_that_only_smoothing_gives_gradients(model: DrivingModel, names: tuple[str, ...]) -> None:
    """Parameters of thresholds have more gradients in the smoothed model than in the exact one."""
    follower, leader = states()
    shares = []
    for used in (model, model.at_temperature(torch.tensor(1.0))):
        values = model.space.defaults().expand(400, -1).clone().requires_grad_()
        used.next_speed(follower, leader, model.space.unpack(values), 0.1).sum().backward()
        assert values.grad is not None
        assert bool(values.grad.isfinite().all())
        columns = [model.space.names.index(name) for name in names]
        shares.append(float((values.grad[:, columns].abs() > 1e-6).double().mean()))
    assert shares[1] > 1.5 * shares[0]


def test_a_smoothed_model_tends_to_the_exact_one() -> None:
    check_that_it_tends_to_the_exact_one(W99())


def test_thresholds_have_a_gradient_only_in_the_smoothed_model() -> None:
    check_that_only_smoothing_gives_gradients(W99(), ("cc1", "cc2", "cc4", "cc5"))


def test_a_model_without_regimes_stays_as_it_is() -> None:
    follower, leader = states()
    model = Krauss()
    p = model.space.unpack(model.space.defaults())
    assert torch.equal(
        model.at_temperature(1.0).next_speed(follower, leader, p, 0.1),
        model.next_speed(follower, leader, p, 0.1),
    )

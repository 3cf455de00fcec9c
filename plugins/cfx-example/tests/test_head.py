"""What the head makes of a network's answers."""

import cfx
import pytest
import torch

from cfx_example.head import LARGEST_STEP, Nearby


@pytest.fixture
def head():
    return Nearby.for_model(cfx.get("model", "idm")())


@pytest.fixture
def base(head):
    generator = torch.Generator().manual_seed(0)
    return torch.rand((20, len(head.space)), generator=generator, dtype=torch.float64)


def test_cfx_finds_it(head):
    found = cfx.get("head", "nearby")
    assert found is Nearby, "install it first: pip install --editable ."
    assert head.name == "nearby", "policies are saved under the name of the entry point"


def test_an_untrained_network_leaves_the_base(head, base):
    unit = head.unit_parameters(head.untrained_answer(base), base)
    torch.testing.assert_close(unit, base)


def test_no_parameter_moves_far_or_leaves_its_bounds(head, base):
    for answer in (0.0, 1.0):
        unit = head.unit_parameters(torch.full_like(base, answer), base)
        assert bool(((unit - base).abs() <= LARGEST_STEP + 1e-12).all())
        assert bool(((unit >= 0) & (unit <= 1)).all())


def test_gradients_reach_the_answer(head, base):
    inside = 0.1 + 0.8 * base
    answer = torch.full_like(inside, 0.4).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: head.unit_parameters(a, inside), (answer,))


def test_networks_read_as_many_features_of_the_base_as_it_says(head, base):
    assert head.condition(base).shape == (20, head.width)

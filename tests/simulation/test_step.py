"""One step of one vehicle, and that nothing else takes such steps."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import cfx
from cfx.models.base import Follower, Leader
from cfx.models.krauss import Krauss
from cfx.models.w99 import W99
from cfx.simulation.step import advance_vehicle

PACKAGE = Path(cfx.__file__).parent

MAY_CALL_THE_MODEL = ("simulation/step.py", "contracts/")
"""Besides the step itself: checks, which look at the model's answers one by one."""


EQUATIONS = ("next_speed", "next_memory")


def calls_of_the_model(path: Path) -> Iterator[int]:
    """Yields the lines that call a model's equations; a model may call another's to wrap it."""
    text = path.read_text(encoding="utf-8")
    if not any(name in text for name in EQUATIONS):
        return
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        if node.func.attr in EQUATIONS:
            yield node.lineno


def test_only_one_place_integrates() -> None:
    wrong = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        lines = list(calls_of_the_model(path))
        if lines and not name.startswith((*MAY_CALL_THE_MODEL, "models/")):
            wrong[name] = lines
    assert not wrong, f"these lines call a model; take cfx.simulation.step instead: {wrong}"
    assert len(list(calls_of_the_model(PACKAGE / "simulation/step.py"))) == 2


def test_a_step_is_forward_euler_with_the_new_speed() -> None:
    values = torch.tensor([[0.0, 10.0, 0.5], [5.0, 12.0, -1.0]], dtype=torch.float64)
    position, speed, acceleration = values.unbind(1)
    model = Krauss()
    follower = Follower(position, speed, acceleration, model.initial_memory(speed))
    leader = Leader(position + 30.0, speed - 2.0, acceleration, torch.tensor(4.5))
    p = model.space.unpack(model.space.defaults())
    after = advance_vehicle(model, follower, leader, p, 0.1)
    expected = model.next_speed(follower, leader, p, 0.1)
    assert torch.equal(after.speed, expected)
    assert after.position.tolist() == pytest.approx((position + 0.1 * expected).tolist())
    assert after.acceleration.tolist() == pytest.approx(((expected - speed) / 0.1).tolist())


def test_a_step_carries_the_memory_of_the_model() -> None:
    class Counting(W99):
        """Counts its steps in its memory."""

        memory_size = 1

        def next_memory(self, follower, leader, p, dt, speed):  # type: ignore[no-untyped-def]
            return follower.memory + 1.0

    model, speed = Counting(), torch.tensor([10.0], dtype=torch.float64)
    follower = Follower(torch.zeros_like(speed), speed, torch.zeros_like(speed), torch.zeros(1, 1))
    leader = Leader(torch.tensor([30.0]), speed, torch.zeros_like(speed), torch.tensor(4.5))
    p = model.space.unpack(model.space.defaults())
    for _ in range(3):
        follower = advance_vehicle(model, follower, leader, p, 0.1)
    assert follower.memory.tolist() == [[3.0]]

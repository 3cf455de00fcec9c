"""The first statements of a driving model's contract. Letters as in `cfx.models.base`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import torch
from torch import Tensor

from cfx.core.contract import NotApplicable, expect_tensor
from cfx.models.base import DrivingModel, Follower, Leader

DT = 0.1
LENGTH = 5.0
DRIVES = 64  # random states and parameter sets of the ordinary kind

Step = tuple[Follower, Leader, dict[str, Tensor]]


def require_equations(model: DrivingModel) -> None:
    """Leaves out a model without equations in Python."""
    if model.needs_simulator:
        raise NotApplicable(f"the model has equations in {model.needs_simulator} only")


def ordinary(model: DrivingModel) -> Step:
    """Returns states as traffic has them and parameters drawn within the bounds, float64."""
    require_equations(model)
    draw = torch.Generator().manual_seed(0)
    unit = torch.rand((DRIVES, len(model.space)), generator=draw, dtype=torch.float64)
    return (*_states(model, draw), model.space.unpack(model.space.from_unit(unit)))


def keeps_shape_dtype_and_device(model: DrivingModel) -> None:
    states = ordinary(model)
    for dtype in (torch.float64, torch.float32):
        follower, leader, p = in_dtype(states, dtype)
        speed = model.next_speed(follower, leader, p, DT)
        expect_tensor(speed, "next_speed", (DRIVES,), dtype, "(*batch,)")
        assert speed.device == follower.speed.device, (
            "the speed must stay on the device of the states: a step on a GPU must not wait for a"
            " copy"
        )
        memories = {
            "next_memory": model.next_memory(follower, leader, p, DT, speed),
            "initial_memory": model.initial_memory(speed),
        }
        for what, memory in memories.items():
            shape = (DRIVES, model.memory_size)
            expect_tensor(memory, what, shape, dtype, "(*batch, memory_size)")


def steps_are_finite_and_never_negative(model: DrivingModel) -> None:
    for dtype in (torch.float64, torch.float32):
        follower, leader, p = in_dtype(ordinary(model), dtype)
        standing = torch.arange(DRIVES) < 3
        stopping = (torch.arange(DRIVES) > 0) & (torch.arange(DRIVES) < 5)
        follower = follower._replace(speed=follower.speed.masked_fill(standing, 0.0))
        leader = leader._replace(speed=leader.speed.masked_fill(stopping, 0.0))
        speed = model.next_speed(follower, leader, p, DT)
        wrong = ~(speed.isfinite() & (speed >= 0))
        assert not bool(wrong.any()), (
            f"next_speed gives {speed[wrong][0].item():g} m/s in {int(wrong.sum())} of {DRIVES}"
            " ordinary states; it must give finite speeds, not negative"
        )
        memory = model.next_memory(follower, leader, p, DT, speed)
        assert bool(memory.isfinite().all()), (
            "next_memory gives a number that is not finite in an ordinary state"
        )


def reads_the_parameters_that_it_declares(model: DrivingModel) -> None:
    follower, leader, values = ordinary(model)
    p = _ReadParameters(values)
    speed = model.next_speed(follower, leader, p, DT)
    model.next_memory(follower, leader, p, DT, speed)
    for name, field in model.schema.model_fields.items():
        default = field.get_default(call_default_factory=True)
        if name != "parameters" and model.settings.__dict__[name] != default:
            return  # a variant may leave some out
    names = model.parameters.for_settings(model.settings).names
    unread = [name for name in names if name not in p.read]
    assert not unread, (
        f"it declares {len(names)} tuned parameters ({', '.join(names)}),"
        f" but next_speed never reads {', '.join(unread)}"
    )


def is_pure(model: DrivingModel) -> None:
    follower, leader, p = ordinary(model)
    inputs = {f"follower.{name}": value for name, value in follower._asdict().items()}
    inputs |= {f"leader.{name}": value for name, value in leader._asdict().items()}
    inputs |= {f"p['{name}']": value for name, value in p.items()}
    before = {name: value.clone() for name, value in inputs.items()}
    first = model.next_speed(follower, leader, p, DT)
    for name, value in before.items():
        assert torch.equal(value, inputs[name]), (
            f"a step changes {name} in place; compute new tensors, for others read these"
        )
    assert torch.equal(first, model.next_speed(follower, leader, p, DT)), (
        "the same state must give the same speed: a step draws no random numbers and keeps no state"
    )


class _ReadParameters(Mapping[str, Tensor]):
    """Parameters by name that remembers which were read; reading all at once reads each."""

    def __init__(self, values: dict[str, Tensor]) -> None:
        self._values = values
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Tensor:
        assert name in self._values, (
            f"next_speed reads the parameter '{name}',"
            f" which is not in its `parameters` ({', '.join(self._values)})"
        )
        self.read.add(name)
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __or__(self, other: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {**self, **other}


def _states(model: DrivingModel, draw: torch.Generator) -> tuple[Follower, Leader]:
    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(DRIVES, generator=draw, dtype=torch.float64)

    gap, leader_speed = uniform(1, 40), uniform(1, 20)
    leader = Leader(uniform(100, 200), leader_speed, uniform(-1, 0.9), uniform(4, 6))
    speed = (leader_speed + uniform(-3, 3)).clamp(min=0.1)
    position, memory = leader.position - leader.length - gap, model.initial_memory(speed)
    return Follower(position, speed, uniform(-1, 1), memory), leader


def on_all(step: Step, change: Callable[[Tensor], Tensor]) -> Step:
    """Returns a step of which every tensor was changed in the same way."""
    follower, leader, p = step
    return (
        Follower(*(change(x) for x in follower)),
        Leader(*(change(x) for x in leader)),
        {name: change(value) for name, value in p.items()},
    )


def in_dtype(step: Step, dtype: torch.dtype) -> Step:
    """Returns a step in another dtype."""
    return on_all(step, lambda x: x.to(dtype))


FIRST = (
    reads_the_parameters_that_it_declares,
    keeps_shape_dtype_and_device,
    steps_are_finite_and_never_negative,
    is_pure,
)

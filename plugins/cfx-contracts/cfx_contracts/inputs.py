"""The contract of an input of policies, statement by statement.

Shapes: B drivers, L frames of a token.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cfx.core.contract import NotApplicable, expect_close, expect_tensor, once
from cfx.data.signals import SIGNALS, Signal
from cfx.policies.history import History, changed
from cfx.policies.inputs.base import PolicyInput
from cfx_contracts import contract_of

DRIVERS, FRAMES = 4, 6

_FAR_M = 1e6
"""Gap of a free road, as drivers elsewhere give it (`cfx.plugin.FREE_ROAD_M`)."""

_USUAL = {
    "position": (0.0, 1000.0),
    "gap": (2.0, 60.0),
    "speed": (0.0, 35.0),
    "acceleration": (-4.0, 3.0),
    "other": (-10.0, 10.0),
}
"""Values of each quantity on ordinary roads, SI units."""


def history(input: PolicyInput, dtype: torch.dtype = torch.float64) -> History:
    """Returns made-up frames of every signal that an input reads, `(B, L)` each."""
    generator = torch.Generator().manual_seed(7)
    frames = {}
    signals = dict(SIGNALS)
    for further in input.further_signals():
        signals[further.name] = further
    for signal in signals.values():
        low, high = _range(signal)
        share = torch.rand((DRIVERS, FRAMES), generator=generator, dtype=torch.float64)
        frames[signal.name] = (low + (high - low) * share).to(dtype)
    return frames


def _range(signal: Signal) -> tuple[float, float]:
    """Returns usual values of a signal, within what is physically possible."""
    low, high = _USUAL[signal.quantity]
    if math.isfinite(signal.low):
        low = signal.low
    if math.isfinite(signal.high):
        high = signal.high
    if low >= high and math.isfinite(signal.high):
        low = high - 1.0
    elif low >= high:
        high = low + 1.0
    return low, high


def _values(input: PolicyInput) -> Tensor:
    """Returns what an input makes of made-up frames, `(B, L)`."""
    return once(input, "values", lambda: input.values(history(input)))


def it_says_what_it_is(input: PolicyInput) -> None:
    complaint = type(input).complaint()
    assert not complaint, f"the input{complaint}"


def it_gives_one_number_for_each_frame(input: PolicyInput) -> None:
    for dtype in (torch.float64, torch.float32):
        frames = history(input, dtype)
        words = "a number for each frame of each driver"
        expect_tensor(input.values(frames), "values", (DRIVERS, FRAMES), dtype, words)
        alone = changed(frames, lambda values: values[:, -1:])
        expect_tensor(input.values(alone), "values of a single frame", (DRIVERS, 1), dtype, words)


def it_reads_the_signals_that_it_declares(input: PolicyInput) -> None:
    frames = history(input)
    declared = {signal.name: frames[signal.name] for signal in input.signals}
    try:
        values = input.values(declared)
    except KeyError as error:
        raise AssertionError(
            f"it reads {error}, which `signals` does not name: what is not named is not there in a"
            " job"
        ) from None
    expect_close(values, _values(input), msg="signals that it does not name change its values")


def leading_dimensions_do_not_matter(input: PolicyInput) -> None:
    """One driver gives what they give among others, also in a grid."""
    frames = history(input)
    together = _values(input)
    for driver in range(DRIVERS):
        alone = input.values({name: values[driver] for name, values in frames.items()})
        expect_close(alone, together[driver], msg="a driver's values depend on the others'")
    grid = input.values(changed(frames, lambda values: values.reshape(2, DRIVERS // 2, FRAMES)))
    expect_close(
        grid.reshape(DRIVERS, FRAMES),
        together,
        msg="values depend on how drivers are arranged; use the last dimension alone",
    )


def it_is_finite_at_standstill(input: PolicyInput) -> None:
    frames = dict(history(input))
    for signal in input.signals:
        if signal.quantity != "other":
            frames[signal.name] = torch.zeros_like(frames[signal.name])
    assert bool(input.values(frames).isfinite().all()), (
        "it is NaN or infinite for vehicles that stand bumper to bumper; clamp what is divided by"
    )


def it_is_finite_on_a_free_road(input: PolicyInput) -> None:
    frames = dict(history(input))
    gaps = [signal.name for signal in input.signals if signal.quantity == "gap"]
    if not gaps:
        raise NotApplicable
    for name in gaps:
        frames[name] = torch.full_like(frames[name], _FAR_M)
    assert bool(input.values(frames).isfinite().all()), (
        f"it is NaN or infinite where nobody is ahead, which is a gap of {_FAR_M:g} m"
    )


def it_is_differentiable(input: PolicyInput) -> None:
    """Networks learn through the simulation, whose signals depend on earlier answers."""
    frames = changed(history(input), lambda values: values.requires_grad_())
    values = input.values(frames)
    if not values.requires_grad:
        raise NotApplicable
    read = [frames[signal.name] for signal in input.signals]
    gradients = torch.autograd.grad(values.sum(), read, allow_unused=True)
    for signal, gradient in zip(input.signals, gradients, strict=True):
        assert gradient is None or bool(gradient.isfinite().all()), (
            f"its gradient by {signal.name} is NaN or infinite; clamp before a root, a logarithm or"
            " a quotient, not after it"
        )


def single_precision_agrees_with_double(input: PolicyInput) -> None:
    single = input.values(history(input, torch.float32)).double()
    expect_close(
        single,
        _values(input),
        rtol=1e-3,
        atol=1e-3,
        msg="its values in single precision, in which networks learn, differ from those in double",
    )


def frames_stay_as_they_are(input: PolicyInput) -> None:
    frames = history(input)
    before = changed(frames, torch.Tensor.clone)
    input.values(frames)
    for name, values in frames.items():
        assert torch.equal(values, before[name]), (
            f"`values` changed {name}, which other inputs read too; make new tensors"
        )


CONTRACT = contract_of(__name__, "input")

"""Trajectories in closed loop by compiled code, without gradients and with them.

A trajectory is one function for autograd: networks observe what was measured before, then they
drive. Within, gradients are computed by hand, window by window (`backward`). No Python runs between
windows; threads take some of the networks each, which changes no bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from cfx.core.threads import share
from cfx.learners.compiled.backward import BackwardPass
from cfx.learners.compiled.forward import CarriedState, ForwardPass, WindowInputs
from cfx.learners.compiled.window import CompiledWindow
from cfx.learners.rollout.dataset import RolloutBatch, RolloutDataset
from cfx.learners.rollout.window import GradientPath, RolloutInputs, Segment, WindowStep

_BACK_THROUGH = 10
"""Observed windows through which gradients go back, as they go back through a similar number of
driven ones (`gradient_decay`). With all windows the gradients of a recurrent network of 64 units
differ by a thousandth."""

_NONE, _ALL = slice(0, 0), slice(None)


class RecurrentLoop:
    """A window step of recurrent networks, compiled, repeated along trajectories.

    Args:
        step: the window, in single precision, on the CPU.
        temperature: of the model, `()`; None: regimes switch exactly.
        trains: whether `gradients` is called.

    Raises:
        Unsupported: as `CompiledWindow`.
    """

    def __init__(self, step: WindowStep, temperature: Tensor | None, *, trains: bool) -> None:
        self.step = step
        self.window = CompiledWindow(step, temperature, trains=trains)

    def trajectories(
        self,
        dataset: RolloutDataset,
        batch: RolloutBatch,
        windows: int,
        burn_in_windows: int | None,
    ) -> Segment:
        """Simulates trajectories; arguments are those of `cfx.learners.rollout.loop.simulate`."""
        with torch.no_grad():
            recorded, read, state = self._begin(dataset, batch, windows, burn_in_windows)
            simulated = ForwardPass(self.window, read, state, keeps=False)
            simulated.run()
            return Segment(simulated.speed, simulated.gap, recorded.measured_at(_ALL), None)

    def gradients(
        self,
        dataset: RolloutDataset,
        batch: RolloutBatch,
        windows: int,
        path: GradientPath,
        burn_in_windows: int | None,
    ) -> Iterator[Segment]:
        """As `trajectories`; yields segments whose speeds and gaps autograd goes back through."""
        step, network = self.step, self.step.core.network
        recorded, read, state = self._begin(dataset, batch, windows, burn_in_windows)
        observed = _ALL
        if len(read.present) > _BACK_THROUGH:
            observed = slice(-_BACK_THROUGH, None)
            earlier = read.windows(slice(-_BACK_THROUGH), _NONE)
            simulated = ForwardPass(self.window, earlier, state, keeps=False)
            with torch.no_grad():
                simulated.run()
            state = simulated.after
        length = path.windows_of_segment(windows)
        weights = tuple(network.parameters())
        for first in range(0, windows, length):
            driven = slice(first, min(first + length, windows))
            simulated = ForwardPass(self.window, read.windows(observed, driven), state, keeps=True)
            speed, gap = _Differentiable.apply(simulated, path, *weights)  # type: ignore[no-untyped-call]
            frames = slice(first * step.stride, driven.stop * step.stride)
            yield Segment(speed, gap, recorded.measured_at(frames), None, frames.start)
            # The next segment goes on from there, and observes nothing more.
            state, observed = simulated.after, _NONE

    def _begin(
        self,
        dataset: RolloutDataset,
        batch: RolloutBatch,
        windows: int,
        burn_in_windows: int | None,
    ) -> tuple[RolloutInputs, WindowInputs, CarriedState]:
        """Returns recorded values, what windows read, and the state before the first of them."""
        network, conditioning = self.window.network, dataset.condition(batch)
        pairs, pair = dataset.recordings.batch, conditioning.pair
        recorded = RolloutInputs.of(pairs, pair, batch, self.step, windows)
        read = WindowInputs.of(dataset, batch, conditioning, recorded, burn_in_windows)
        # (3, N, D, L) -> (3 L, N, D), with the model's memory behind it: (M, N, D).
        follower = recorded.follower.permute(0, 3, 1, 2).flatten(0, 1)
        motion = torch.cat([follower, recorded.memory.permute(2, 0, 1)])
        carried = network.initial_state(*pair.shape).chunk(len(network.layers), -1)
        return recorded, read, CarriedState(motion, carried)


class _Differentiable(torch.autograd.Function):
    """A forward pass as a function of the networks' weights."""

    @staticmethod
    def forward(
        ctx: Any, simulated: ForwardPass, path: GradientPath, *_weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        ctx.simulated, ctx.path = simulated, path
        simulated.run()
        return simulated.speed, simulated.gap

    @staticmethod
    def backward(ctx: Any, speed: Tensor, gap: Tensor) -> tuple[Tensor | None, ...]:
        back = BackwardPass(ctx.simulated, ctx.path, speed, gap)
        back.run()
        del ctx.simulated
        return None, None, *back.by_weight.values()


def compile_windows(
    training: WindowStep, temperature: Tensor | None, validation: WindowStep
) -> dict[WindowStep, RecurrentLoop]:
    """Compiles the windows of a training, on all cores.

    Args:
        training: the window that gradients go through, in single precision, on the CPU.
        temperature: of its model, `()`; None: regimes switch exactly.
        validation: the window of validation, whose regimes switch exactly.

    Returns:
        Each window's loop, whose `trajectories` and `gradients` take the place of
        `cfx.learners.rollout.loop.simulate`.

    Raises:
        Unsupported: networks are not recurrent, a model, head or input is not elementwise, or there
            is no C++ compiler.
    """
    loops = {
        training: RecurrentLoop(training, temperature, trains=True),
        validation: RecurrentLoop(validation, None, trains=False),
    }
    codes = {}
    for loop in loops.values():
        for function in (loop.window.features, loop.window.drive, loop.window.cell):
            # Both windows have some functions in common.
            codes[function.code.source] = function.code
    share(lambda code: code.compiled, list(codes.values()), level="compiler")
    return loops

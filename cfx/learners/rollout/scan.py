"""The closed loop of recurrent networks as compiled code, forwards and backwards.

A trajectory is one function for autograd: networks observe what was measured before, then they
drive. Within, gradients are computed by hand, window by window. What is elementwise (features, a
recurrent cell, the steps of a window) is code recorded from its one definition
(`cfx.simulation.kernel.elementwise`); the rest are matrix products, those for gradients of weights
of several windows at once.

Shapes: N networks, D trajectories of each, B windows that are observed, H windows that are driven,
L frames of a token, S steps of a window, F features that networks read, n answers, h hidden units,
c numbers that a layer carries (h, or 2 h), G = gates h, M = 3 L + width of the model's memory.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cfx.core.memory import keep_freed_memory
from cfx.learners.rollout.dataset import Conditioning
from cfx.learners.rollout.inputs import RolloutInputs
from cfx.learners.rollout.window import (
    GradientPath,
    LeaderWindow,
    LoopState,
    ThroughMemory,
    ThroughTime,
    WindowStep,
)
from cfx.policies.features import token_width
from cfx.policies.recurrent import RecurrentLayer, RecurrentNetwork
from cfx.simulation.kernel.columns import Unsupported
from cfx.simulation.kernel.elementwise import Elementwise

_TOGETHER = 10
"""Windows whose gradients by weights are one product; more would take more memory."""

_REMEMBERED = 10
"""Observed windows through which gradients go back, as they go back through a similar number of
driven ones (`gradient_decay`). With all windows the gradients of a recurrent network of 64 units
differ by a thousandth."""


class Observed(NamedTuple):
    """What networks observe before they drive.

    Attributes:
        features: not normalised, `(B, N, D, F)`.
        present: 1 where a trajectory has this window, else 0, `(B, N, D)`.
    """

    features: Tensor
    present: Tensor


class Stand(NamedTuple):
    """Where trajectories stand between two windows.

    Attributes:
        motion: position, speed and acceleration of the last L frames, then the memory, `(M, N, D)`.
        carried: of each layer, `(N, D, c)`.
    """

    motion: Tensor
    carried: tuple[Tensor, ...]


class _Part:
    """An elementwise part, its arguments by name; those without columns are left out."""

    def __init__(
        self,
        function: Callable[[Mapping[str, Tensor]], Sequence[Tensor]],
        widths: Mapping[str, int],
        wanted: Sequence[str],
        key: object,
    ) -> None:
        self.names = [name for name, width in widths.items() if width > 0]
        numbers = [self.names.index(name) for name in wanted if name in self.names]

        def of_values(*values: Tensor) -> Sequence[Tensor]:
            nothing = values[0][..., :0]
            known = dict.fromkeys(widths, nothing) | dict(zip(self.names, values, strict=True))
            return function(known)

        used = [widths[name] for name in self.names]
        self.compiled = Elementwise(of_values, used, numbers, key)

    def forward(self, given: Mapping[str, Tensor], *to: Tensor) -> None:
        """Computes the part of tensors `(A, B, C, width)`; writes its results."""
        self.compiled.forward([given[name] for name in self.names], *to)

    def backward(
        self, given: Mapping[str, Tensor], gradients: Sequence[Tensor | None], *to: Tensor
    ) -> None:
        """Writes the gradients by the wanted arguments."""
        self.compiled.backward([given[name] for name in self.names], gradients, *to)


class Scan:
    """A window step of recurrent networks, compiled.

    Args:
        step: the window, in single precision, on the CPU.
        temperature: of the model, `()`; None: regimes switch exactly.
        key: what the step depends on; None: it is recorded anew in each process.
        trains: whether gradients are wanted.

    Raises:
        Unsupported: networks are not recurrent, a part is not elementwise, or there is no compiler.
    """

    def __init__(
        self, step: WindowStep, temperature: Tensor | None, key: object, *, trains: bool
    ) -> None:
        keep_freed_memory()
        network, core = step.core.network, step.core
        if not isinstance(network, RecurrentNetwork) or network.dropout.p > 0:
            raise Unsupported("networks that are not recurrent, or have dropout")
        self.step, self.network, self.temperature = step, network, temperature
        length = step.length
        motion = {"position": length, "speed": length, "acceleration": length}
        leader = {f"leader_{name}": length + step.stride for name in motion}
        around = {**motion, **leader, "leader_length": 1}
        width = core.scaler.mean.shape[-1]
        known = width - token_width(core.inputs, core.summary, length)
        read = {**around, "conditioning": known, "mean": width, "scale": width}
        self.features = _Part(self._read, read, list(motion), [key, "features"])
        moved = {**around, "memory": step.model.memory_size, "base": len(core.head.space)}
        moved |= {"logits": core.head.answers, "bias": core.head.answers}
        moved |= {"temperature": 0 if temperature is None else 1}
        wanted = [*motion, "memory", "logits"] if trains else []
        self.drive = _Part(self._moved, moved, wanted, [key, "drive", temperature is None])
        gates = {"projected": network.gates, "recurrent": network.gates, "carried": network.states}
        more = {"input_bias": network.gates, "hidden_bias": network.gates, "present": 1}
        self.cell = _Part(self._cell, gates | more, list(gates), [key, "cell"])

    def simulate(
        self,
        inputs: RolloutInputs,
        observed: Observed,
        conditioning: Conditioning,
        windows: int,
        path: GradientPath,
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Simulates trajectories in closed loop.

        Args:
            inputs: what was measured.
            observed: before they begin.
            conditioning: of these trajectories.
            windows: H.
            path: the way that gradients take back.

        Yields:
            Speed (m/s) and gap (m) between two cuts of the gradients, `(N, D, frames)` each.
        """
        networks, trajectories = conditioning.pair.shape
        follower = inputs.follower.permute(0, 3, 1, 2).flatten(0, 1)
        motion = torch.cat([follower, inputs.memory.permute(2, 0, 1)])
        carried = self.network.initial_state(networks, trajectories)
        stand = Stand(motion, carried.chunk(len(self.network.layers), -1))
        if torch.is_grad_enabled() and len(observed.present) > _REMEMBERED:
            earlier = Observed(observed.features[:-_REMEMBERED], observed.present[:-_REMEMBERED])
            observed = Observed(observed.features[-_REMEMBERED:], observed.present[-_REMEMBERED:])
            with torch.no_grad():
                stand = self._observe(inputs, earlier, conditioning, stand, path)
        length = path.segment_length(windows)
        weights = tuple(self.network.parameters())
        for first in range(0, windows, length):
            driven = slice(first, min(first + length, windows))
            loop = _Loop(self, _Known.of(inputs, observed, conditioning, driven), stand, path)
            speed, gap = _Trajectory.apply(loop, *weights)  # type: ignore[no-untyped-call]
            yield speed, gap
            stand = loop.after
            observed = Observed(observed.features[:0], observed.present[:0])

    def _observe(
        self,
        inputs: RolloutInputs,
        observed: Observed,
        conditioning: Conditioning,
        stand: Stand,
        path: GradientPath,
    ) -> Stand:
        """Lets networks observe windows; returns where trajectories stand behind them."""
        known = _Known.of(inputs, observed, conditioning, slice(0, 0))
        loop = _Loop(self, known, stand, path)
        loop.forward()
        return loop.after

    def _read(self, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        """Returns normalised features."""
        now, leader = _stand(given), _leader(given)
        length = given["leader_length"][..., 0]
        features = self.step.features(now, leader, length, given["conditioning"])
        return [(features - given["mean"]) / given["scale"]]

    def _moved(self, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        """Returns where trajectories stand after a window, and speed and gap in it."""
        step = self.step
        if self.temperature is not None:
            step = copy.copy(step)
            step.model = step.model.at_temperature(given["temperature"][..., 0])
        answer = (given["logits"] + given["bias"]).sigmoid()
        length = given["leader_length"][..., 0]
        after, speed, gap = step.steer(answer, _stand(given), _leader(given), length, given["base"])
        moved = [after.position, after.speed, after.acceleration]
        if after.memory.shape[-1] > 0:
            moved.append(after.memory)
        return [*moved, speed, gap]

    def _cell(self, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        """Returns what a layer carries after a window."""
        projected = given["projected"] + given["input_bias"]
        recurrent = given["recurrent"] + given["hidden_bias"]
        after = self.network.cell(projected, recurrent, given["carried"])
        return [torch.where(given["present"] > 0, after, given["carried"])]


def _stand(given: Mapping[str, Tensor]) -> LoopState:
    nothing = given["position"][..., :0]
    memory = given.get("memory", nothing)
    return LoopState(
        given["position"], given["speed"], given["acceleration"], memory, nothing, nothing
    )


def _leader(given: Mapping[str, Tensor]) -> LeaderWindow:
    return LeaderWindow(
        given["leader_position"], given["leader_speed"], given["leader_acceleration"]
    )


class _Known(NamedTuple):
    """What a part of the loop reads that no network changes.

    Attributes:
        observed: before it.
        leader: `(3, H, N, D, L + S)`.
        leader_length: `(N, D)`.
        conditioning: `(N, D, c)`.
        base: `(N, D, n)`.
    """

    observed: Observed
    leader: Tensor
    leader_length: Tensor
    conditioning: Tensor
    base: Tensor

    @classmethod
    def of(
        cls, inputs: RolloutInputs, observed: Observed, conditioning: Conditioning, driven: slice
    ) -> _Known:
        """Returns what some windows read."""
        leader, length = inputs.leader[:, driven], inputs.leader_length
        return cls(observed, leader, length, conditioning.features, conditioning.base)


class _Cell(NamedTuple):
    """What a layer's cell reads and writes.

    Attributes:
        projected, recurrent: of each slot, `(slots, N, D, h, gates)`.
        carried: `(N, slots, D, h, c / h)`.
        observing, acting, hidden_bias: biases, `(N, D, h, gates)`.
    """

    projected: Tensor
    recurrent: Tensor
    carried: Tensor
    observing: Tensor
    acting: Tensor
    hidden_bias: Tensor


class _Loop:
    """Some windows in a row: B that are observed, then H that are driven, and what they leave.

    Where gradients are recorded every window is kept, else two.
    """

    def __init__(self, scan: Scan, known: _Known, stand: Stand, path: GradientPath) -> None:
        self.scan, self.known, self.path = scan, known, path
        network, step = scan.network, scan.step
        self.observed, self.driven = len(known.observed.present), known.leader.shape[1]
        self.windows = self.observed + self.driven
        self.keeps = torch.is_grad_enabled()
        self.shape = networks, trajectories = known.leader_length.shape
        new = stand.motion.new_empty
        self.slots = self.windows + 1 if self.keeps else 2
        moved = self.driven + 1 if self.keeps else 2
        self.motion = new((moved, len(stand.motion), networks, trajectories))
        self.motion[0] = stand.motion
        features = scan.step.core.scaler.mean.shape[-1]
        self.read = new((networks, self.slots, trajectories, features))
        gates = network.gates * network.hidden
        self.carried, self.projected, self.recurrent = [], [], []
        for before in stand.carried:
            kept = new((networks, self.slots, trajectories, before.shape[-1]))
            kept[:, 0] = before
            self.carried.append(kept)
            self.projected.append(new((self.slots, networks, trajectories, gates)))
            self.recurrent.append(new((self.slots, networks, trajectories, gates)))
        self.logits = new((self.slots, networks, trajectories, step.core.head.answers))
        frames = self.driven * step.stride
        self.speed = new((networks, trajectories, frames))
        self.gap = new((networks, trajectories, frames))
        self._views(stand.motion.new_ones(()))

    def _views(self, one: Tensor) -> None:
        """Arranges what all windows share as the compiled parts read it."""
        known, scan, network = self.known, self.scan, self.scan.network
        scaler, everywhere = scan.step.core.scaler, (self.shape[0], 1, self.shape[1], -1)
        self.shared = {
            "leader_length": known.leader_length[:, None, :, None],
            "conditioning": known.conditioning[:, None],
            "base": known.base[:, None],
            "mean": scaler.mean[:, None, None].expand(everywhere),
            "scale": scaler.scale[:, None, None].expand(everywhere),
            "bias": network.b_out.detach()[:, None].expand(everywhere),
        }
        if scan.temperature is not None:
            self.shared["temperature"] = scan.temperature.expand(everywhere[:-1]).unsqueeze(-1)
        self.leader = known.leader.unsqueeze(3).unbind(0)
        units = (*self.shape, network.hidden, 1)
        self.present = known.observed.present[..., None, None].expand(-1, *units)
        self.always = one.expand(units)
        self.cells = []
        for number, layer in enumerate(self.layers):
            observing = acting = layer.b_input.detach()
            if number == 0 and network.b_acting is not None:
                acting = observing + network.b_acting.detach()[:, 0]
            self.cells.append(
                _Cell(
                    projected=self.units(self.projected[number]),
                    recurrent=self.units(self.recurrent[number]),
                    carried=self.units(self.carried[number]),
                    observing=self.units(observing.expand(*self.shape, -1)),
                    acting=self.units(acting.expand(*self.shape, -1)),
                    hidden_bias=self.units(layer.b_hidden.detach().expand(*self.shape, -1)),
                )
            )

    @property
    def after(self) -> Stand:
        """Where trajectories stand behind the last window."""
        slot = self.windows % self.slots
        carried = tuple(kept[:, slot] for kept in self.carried)
        return Stand(self.motion[self.driven % len(self.motion)], carried)

    @property
    def layers(self) -> list[RecurrentLayer]:
        """The recurrent layers."""
        found = []
        for layer in self.scan.network.layers:
            assert isinstance(layer, RecurrentLayer)
            found.append(layer)
        return found

    def forward(self) -> None:
        """Simulates the windows."""
        scan, network = self.scan, self.scan.network
        mean, scale = scan.step.core.scaler.mean, scan.step.core.scaler.scale
        for window in range(self.windows):
            slot, driven = window % self.slots, window - self.observed
            if driven < 0:
                features = self.known.observed.features[window]
                torch.sub(features, mean[:, None], out=self.read[:, slot])
                self.read[:, slot].div_(scale[:, None])
            else:
                scan.features.forward(self.around(driven), self.read[:, slot, None])
            for number, layer in enumerate(self.layers):
                torch.bmm(
                    self.seen(number, window), layer.w_input, out=self.projected[number][slot]
                )
                before = self.carried[number][:, slot, :, : network.hidden]
                torch.bmm(before, layer.w_hidden, out=self.recurrent[number][slot])
                to = self.cells[number].carried[:, (window + 1) % self.slots]
                scan.cell.forward(self.gates(number, window), to)
            if driven >= 0:
                torch.bmm(self.output(window), network.w_out, out=self.logits[slot])
                moved = self.columns(self.motion[(driven + 1) % len(self.motion)])
                scan.drive.forward(self.around(driven), *moved.values(), *self.frames(driven))

    def seen(self, number: int, window: int) -> Tensor:
        """Returns what a layer reads in a window."""
        if number == 0:
            return self.read[:, window % self.slots]
        below = self.carried[number - 1][:, (window + 1) % self.slots]
        return below[..., : self.scan.network.hidden]

    def output(self, window: int) -> Tensor:
        """Returns the outputs of the last layer, `(N, D, h)`."""
        return self.carried[-1][:, (window + 1) % self.slots, :, : self.scan.network.hidden]

    def frames(self, driven: int) -> tuple[Tensor, Tensor]:
        """Returns where speeds and gaps of a window stand, `(N, 1, D, S)` each."""
        stride = self.scan.step.stride
        own = slice(driven * stride, (driven + 1) * stride)
        return self.speed[:, None, :, own], self.gap[:, None, :, own]

    def columns(self, motion: Tensor) -> dict[str, Tensor]:
        """Returns motion `(M, N, D)` by name, `(N, 1, D, width)` each."""
        length = self.scan.step.length
        last = motion.permute(1, 2, 0)[:, None]
        names = ("position", "speed", "acceleration")
        found = {name: last[..., k * length : (k + 1) * length] for k, name in enumerate(names)}
        if last.shape[-1] > 3 * length:
            found["memory"] = last[..., 3 * length :]
        return found

    def around(self, driven: int) -> dict[str, Tensor]:
        """Returns all that the features and the steps of a window depend on."""
        given = self.shared | self.columns(self.motion[driven % len(self.motion)])
        position, speed, acceleration = self.leader
        given["leader_position"] = position[driven]
        given["leader_speed"] = speed[driven]
        given["leader_acceleration"] = acceleration[driven]
        given["logits"] = self.logits[(driven + self.observed) % self.slots][:, None]
        return given

    def units(self, values: Tensor) -> Tensor:
        """Returns `(*batch, k h)` as `(*batch, h, k)`."""
        hidden = self.scan.network.hidden
        shape = (*values.shape[:-1], values.shape[-1] // hidden, hidden)
        return values.view(shape).transpose(-1, -2)

    def gates(self, number: int, window: int) -> dict[str, Tensor]:
        """Returns all that a layer's cell depends on in a window."""
        cell, slot = self.cells[number], window % self.slots
        observes = window < self.observed
        return {
            "projected": cell.projected[slot],
            "recurrent": cell.recurrent[slot],
            "carried": cell.carried[:, slot],
            "input_bias": cell.observing if observes else cell.acting,
            "hidden_bias": cell.hidden_bias,
            "present": self.present[window] if observes else self.always,
        }


class _Gradients:
    """Back-propagation through a loop.

    Args:
        loop: what was simulated.
        speed, gap: gradients by its results, `(N, D, frames)`.
    """

    def __init__(self, loop: _Loop, speed: Tensor, gap: Tensor) -> None:
        self.loop = loop
        self.speed, self.gap = speed, gap
        network = loop.scan.network
        self.of: dict[Tensor, Tensor] = {}
        for weight in network.parameters():
            self.of[weight] = torch.zeros_like(weight)
        self.motion = torch.zeros_like(loop.motion[0])
        self.carried = [torch.zeros_like(kept[:, 0]) for kept in loop.carried]
        networks, trajectories = loop.shape
        gates = network.gates * network.hidden
        new = speed.new_empty
        shape = (networks, _TOGETHER, trajectories)
        self.projected = [new((*shape, gates)) for _ in loop.carried]
        self.recurrent = [new((*shape, gates)) for _ in loop.carried]
        self.logits = new((*shape, network.w_out.shape[-1]))

    def backward(self) -> None:
        """Goes back through all windows."""
        loop = self.loop
        cuts = [*range(loop.windows, loop.observed, -_TOGETHER), loop.observed]
        cuts += [*range(loop.observed - _TOGETHER, 0, -_TOGETHER), 0]
        for last, first in itertools.pairwise(cuts):
            for window in range(last - 1, first - 1, -1):
                self._through(window, window - first)
            self._add(first, last)

    def _through(self, window: int, place: int) -> None:
        """Goes back through a window, whose gradients by gates stand at a place."""
        loop, scan = self.loop, self.loop.scan
        network, hidden = scan.network, scan.network.hidden
        driven = window - loop.observed
        motion = torch.empty_like(self.motion)
        if driven >= 0:
            assert isinstance(loop.path, ThroughTime)
            if window < loop.windows - 1:
                self._bound(loop.path)
            given = loop.around(driven)
            stride = scan.step.stride
            own = slice(driven * stride, (driven + 1) * stride)
            gradients = [*loop.columns(self.motion).values()]
            gradients += [self.speed[:, None, :, own], self.gap[:, None, :, own]]
            logits = self.logits[:, place]
            to = [*loop.columns(motion).values(), logits[:, None]]
            scan.drive.backward(given, gradients, *to)
            self.carried[-1][..., :hidden].baddbmm_(logits, network.w_out.mT)
        for number in reversed(range(len(self.carried))):
            layer = loop.layers[number]
            projected = self.projected[number][:, place]
            recurrent = self.recurrent[number][:, place]
            before = torch.empty_like(self.carried[number])
            to = [loop.units(projected), loop.units(recurrent), loop.units(before)]
            scan.cell.backward(loop.gates(number, window), [loop.units(self.carried[number])], *to)
            before[..., :hidden].baddbmm_(recurrent, layer.w_hidden.mT)
            self.carried[number] = before
            if number > 0:
                self.carried[number - 1][..., :hidden].baddbmm_(projected, layer.w_input.mT)
            elif driven >= 0:
                read = torch.bmm(projected, layer.w_input.mT)
                seen = torch.empty_like(motion)
                names = ("position", "speed", "acceleration")
                to = [loop.columns(seen)[name] for name in names]
                scan.features.backward(given, [read[:, None]], *to)
                frames = 3 * scan.step.length
                motion[:frames] += seen[:frames]
        self.motion = motion

    def _bound(self, path: ThroughTime) -> None:
        """Bounds the gradients that come back through a window."""
        if isinstance(path, ThroughMemory):
            self.motion.zero_()
        for gradient in (self.motion, *self.carried):
            gradient.nan_to_num_(0.0, 0.0, 0.0).mul_(path.decay).clamp_(-path.clip, path.clip)

    def _add(self, first: int, last: int) -> None:
        """Adds what some windows give to the gradients of weights."""
        loop, network = self.loop, self.loop.scan.network
        count = last - first
        for number, layer in enumerate(loop.layers):
            projected = self.projected[number][:, :count].flatten(1, 2)
            recurrent = self.recurrent[number][:, :count].flatten(1, 2)
            if number == 0:
                read = loop.read[:, first:last]
            else:
                read = loop.carried[number - 1][:, first + 1 : last + 1, :, : network.hidden]
            before = loop.carried[number][:, first:last, :, : network.hidden]
            self.of[layer.w_input].baddbmm_(read.flatten(1, 2).mT, projected)
            self.of[layer.w_hidden].baddbmm_(before.flatten(1, 2).mT, recurrent)
            bias = projected.sum(1, keepdim=True)
            self.of[layer.b_input] += bias
            self.of[layer.b_hidden] += recurrent.sum(1, keepdim=True)
            if number == 0 and first >= loop.observed and network.b_acting is not None:
                self.of[network.b_acting] += bias[:, None]
        if first >= loop.observed:
            outputs = loop.carried[-1][:, first + 1 : last + 1, :, : network.hidden].flatten(1, 2)
            logits = self.logits[:, :count].flatten(1, 2)
            self.of[network.w_out].baddbmm_(outputs.mT, logits)
            self.of[network.b_out] += logits.sum(1, keepdim=True)


class _Trajectory(torch.autograd.Function):
    """A loop as a function of the networks' weights."""

    @staticmethod
    def forward(ctx: Any, loop: _Loop, *_weights: Tensor) -> tuple[Tensor, Tensor]:
        ctx.loop = loop
        loop.forward()
        return loop.speed, loop.gap

    @staticmethod
    def backward(ctx: Any, speed: Tensor, gap: Tensor) -> tuple[Tensor | None, ...]:
        gradients = _Gradients(ctx.loop, speed, gap)
        gradients.backward()
        del ctx.loop
        return None, *gradients.of.values()

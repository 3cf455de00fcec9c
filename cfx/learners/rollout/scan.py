"""The closed loop of recurrent networks as compiled code, forwards and backwards.

A trajectory is one function for autograd: networks observe what was measured before, then they
drive. Within, gradients are computed by hand, window by window. What is elementwise (features, a
recurrent cell, the steps of a window) is code recorded from its one definition
(`cfx.simulation.kernel.elementwise`); the rest are matrix products. No Python runs between windows
(`cfx.simulation.kernel.sequence`); only gradients by weights are products of all windows at once.
Threads take some of the networks each, which changes no bit.

Shapes: N networks, D trajectories of each, B windows that are observed, H windows that are driven,
L frames of a token, S steps of a window, F features that networks read, n answers, h hidden units,
c numbers that a layer carries (h, or 2 h), G = gates h, M = 3 L + width of the model's memory.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cfx.core.memory import keep_freed_memory
from cfx.core.threads import cores, share
from cfx.learners.rollout.dataset import Conditioning, RolloutBatch, RolloutDataset
from cfx.learners.rollout.window import (
    GradientPath,
    LeaderWindow,
    LoopState,
    RolloutInputs,
    Segment,
    WindowStep,
)
from cfx.policies.features import token_width
from cfx.policies.recurrent import RecurrentLayer, RecurrentNetwork
from cfx.simulation.kernel.columns import Unsupported
from cfx.simulation.kernel.elementwise import Elementwise
from cfx.simulation.kernel.sequence import Calls, Operand

_REMEMBERED = 10
"""Observed windows through which gradients go back, as they go back through a similar number of
driven ones (`gradient_decay`). With all windows the gradients of a recurrent network of 64 units
differ by a thousandth."""

_MOTION = ("position", "speed", "acceleration")
"""What is simulated of a vehicle, in the order of `LoopState`."""


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
        **options: int,
    ) -> None:
        self.names = [name for name, width in widths.items() if width > 0]
        numbers = [self.names.index(name) for name in wanted if name in self.names]

        def of_values(*values: Tensor) -> Sequence[Tensor]:
            nothing = values[0][..., :0]
            known = dict.fromkeys(widths, nothing) | dict(zip(self.names, values, strict=True))
            return function(known)

        used = [widths[name] for name in self.names]
        self.code = Elementwise(of_values, used, numbers, key, **options)

    def forward(self, calls: Calls, given: Mapping[str, Operand], to: Sequence[Operand]) -> None:
        """Adds the call that computes the part and writes its results."""
        calls.elementwise(self.code.compiled.forward, [*self._of(given), *to])

    def backward(
        self,
        calls: Calls,
        given: Mapping[str, Operand],
        gradients: Sequence[Operand],
        to: Sequence[Operand],
    ) -> None:
        """Adds the call that writes the gradients by the wanted arguments."""
        calls.elementwise(self.code.compiled.backward, [*self._of(given), *gradients, *to])

    def _of(self, given: Mapping[str, Operand]) -> list[Operand]:
        return [given[name] for name in self.names]


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
        motion = dict.fromkeys(_MOTION, length)
        self.around_names = [f"leader_{name}" for name in _MOTION]
        for signal in core.further_signals:
            self.around_names.append(f"around_{signal.name}")
        leader = dict.fromkeys(self.around_names, length + step.stride)
        around = {**motion, **leader, "leader_length": 1}
        width = core.scaler.mean.shape[-1]
        known = width - token_width(core.inputs, core.summary, length)
        read = {**around, "conditioning": known, "mean": width, "scale": width}
        self.features = _Part(self._read, read, _MOTION, [key, "features"])
        moved = {**around, "memory": step.model.memory_size, "base": len(core.head.space)}
        moved |= {"logits": core.head.answers, "bias": core.head.answers}
        moved |= {"temperature": 0 if temperature is None else 1}
        wanted = [*_MOTION, "memory", "logits"] if trains else []
        self.drive = _Part(self._moved, moved, wanted, [key, "drive", temperature is None])
        gates = {"projected": network.gates, "recurrent": network.gates, "carried": network.states}
        more = {"input_bias": network.gates, "hidden_bias": network.gates, "present": 1}
        self.cell = _Part(
            self._cell, gates | more, list(gates), [key, "cell"], together=network.hidden
        )

    @staticmethod
    def compile(scans: Sequence[Scan]) -> None:
        """Compiles several windows, on all cores.

        Raises:
            Unsupported: the compiler fails.
        """
        codes = {}
        for scan in scans:
            for part in (scan.features, scan.drive, scan.cell):
                codes[part.code.source] = part.code
        share(lambda code: code.compiled, list(codes.values()), level="compiler")

    def simulate(
        self,
        dataset: RolloutDataset,
        batch: RolloutBatch,
        windows: int,
        path: GradientPath | None,
        burn_in_windows: int | None,
    ) -> Iterator[Segment]:
        """Simulates trajectories in closed loop; arguments are those of `loop.simulate`."""
        step, network = self.step, self.network
        conditioning = dataset.condition(batch)
        pairs, shape = dataset.recordings.batch, conditioning.pair.shape
        inputs = RolloutInputs.of(pairs, conditioning.pair, batch, step, windows)
        known = _Known.of(dataset, batch, conditioning, inputs, burn_in_windows)
        follower = inputs.follower.permute(0, 3, 1, 2).flatten(0, 1)
        motion = torch.cat([follower, inputs.memory.permute(2, 0, 1)])
        carried = network.initial_state(*shape).chunk(len(network.layers), -1)
        stand, seen, nothing = Stand(motion, carried), slice(None), slice(0, 0)
        if torch.is_grad_enabled() and len(known.present) > _REMEMBERED:
            earlier, seen = slice(-_REMEMBERED), slice(-_REMEMBERED, None)
            with torch.no_grad():
                loop = _Loop(self, known.windows(earlier, nothing), stand, path)
                loop.forward()
            stand = loop.after
        length = windows if path is None or path.cut_after is None else path.cut_after
        weights = tuple(network.parameters())
        for first in range(0, windows, length):
            driven = slice(first, min(first + length, windows))
            loop = _Loop(self, known.windows(seen, driven), stand, path)
            speed, gap = _Trajectory.apply(loop, *weights)  # type: ignore[no-untyped-call]
            frames = slice(first * step.stride, driven.stop * step.stride)
            yield Segment(speed, gap, inputs.measured_at(frames), None, frames.start)
            stand, seen = loop.after, nothing

    def _read(self, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        """Returns normalised features."""
        features = self.step.features(*self._around(given), given["conditioning"])
        return [(features - given["mean"]) / given["scale"]]

    def _moved(self, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        """Returns where trajectories stand after a window, and speed and gap in it."""
        step = self.step
        if self.temperature is not None:
            step = copy.copy(step)
            step.model = step.model.at_temperature(given["temperature"][..., 0])
        answer = (given["logits"] + given["bias"]).sigmoid()
        after, speed, gap = step.steer(answer, *self._around(given), given["base"])
        moved = [after.position, after.speed, after.acceleration]
        if after.memory.shape[-1] > 0:
            moved.append(after.memory)
        return [*moved, speed, gap]

    def _around(self, given: Mapping[str, Tensor]) -> tuple[LoopState, LeaderWindow, Tensor]:
        """Returns where trajectories stand, and the leaders around a window with their lengths."""
        nothing = given["position"][..., :0]
        motion = (given["position"], given["speed"], given["acceleration"])
        now = LoopState(*motion, given.get("memory", nothing), nothing, nothing)
        position, speed, acceleration, *more = [given[name] for name in self.around_names]
        leader = LeaderWindow(position, speed, acceleration, tuple(more))
        return now, leader, given["leader_length"][..., 0]

    def _cell(self, given: Mapping[str, Tensor]) -> Sequence[Tensor]:
        """Returns what a layer carries after a window."""
        projected = given["projected"] + given["input_bias"]
        recurrent = given["recurrent"] + given["hidden_bias"]
        after = self.network.cell(projected, recurrent, given["carried"])
        return [torch.where(given["present"] > 0, after, given["carried"])]


class _Known(NamedTuple):
    """What some windows read that no network changes.

    Attributes:
        features: of observed windows, normalised, `(B, N, D, F)`.
        present: 1 where a trajectory has that window, else 0, `(B, N, D)`.
        leader: `(3 + E, H, N, D, L + S)`, as `RolloutInputs.leader`.
        leader_length: `(N, D)`.
        conditioning: `(N, D, c)`.
        base: `(N, D, n)`.
    """

    features: Tensor
    present: Tensor
    leader: Tensor
    leader_length: Tensor
    conditioning: Tensor
    base: Tensor

    @classmethod
    def of(
        cls,
        dataset: RolloutDataset,
        batch: RolloutBatch,
        conditioning: Conditioning,
        inputs: RolloutInputs,
        most: int | None,
    ) -> _Known:
        """Returns what trajectories read; `most` windows are observed before them at most."""
        tokens, present = dataset.observed_windows(batch, conditioning.pair, most)
        known, scaler = conditioning.features, dataset.scaler
        features = torch.cat([tokens, known.expand(len(tokens), -1, -1, -1)], -1)
        features.sub_(scaler.mean[:, None]).div_(scaler.scale[:, None])
        leader = (inputs.leader, inputs.leader_length)
        return cls(features, present.to(tokens.dtype), *leader, known, conditioning.base)

    def windows(self, observed: slice, driven: slice) -> _Known:
        """Returns what some of the windows read."""
        features, present = self.features[observed], self.present[observed]
        return self._replace(features=features, present=present, leader=self.leader[:, driven])


class _Layer(NamedTuple):
    """A recurrent layer and its values in windows.

    Attributes:
        weights: of the layer.
        carried: `(N, slots, D, c)`, the first of them before the first window.
        projected, recurrent: parts of the gates, `(N, slots, D, G)`.
    """

    weights: RecurrentLayer
    carried: Tensor
    projected: Tensor
    recurrent: Tensor


class _Loop:
    """Some windows in a row: B that are observed, then H that are driven, and what they leave.

    Where gradients are recorded every window is kept, else as few as there must be.
    """

    def __init__(self, scan: Scan, known: _Known, stand: Stand, path: GradientPath | None) -> None:
        self.scan, self.known, self.path = scan, known, path
        network, step = scan.network, scan.step
        self.observed, self.driven = len(known.present), known.leader.shape[1]
        networks, trajectories = self.shape
        new = stand.motion.new_empty
        windows, driven = self.windows, self.driven
        slots, moved = windows + 1, driven + 1
        if not torch.is_grad_enabled():
            windows, driven, slots, moved = 1, 1, 2, 2
        self.motion = new((moved, len(stand.motion), networks, trajectories))
        self.motion[0] = stand.motion
        self.read = new((networks, driven, trajectories, step.core.scaler.mean.shape[-1]))
        gates = (networks, windows, trajectories, network.gates * network.hidden)
        self.layers = []
        for weights, before in zip(network.layers, stand.carried, strict=True):
            assert isinstance(weights, RecurrentLayer)
            carried = new((networks, slots, trajectories, before.shape[-1]))
            carried[:, 0] = before
            self.layers.append(_Layer(weights, carried, new(gates), new(gates)))
        self.logits = new((networks, driven, trajectories, step.core.head.answers))
        self.speed = new((networks, trajectories, self.driven * step.stride))
        self.gap = torch.empty_like(self.speed)
        self.around = self._around() if self.driven > 0 else {}

    @property
    def shape(self) -> tuple[int, int]:
        """The networks, and the trajectories of each: N and D."""
        networks, trajectories = self.known.leader_length.shape
        return networks, trajectories

    @property
    def windows(self) -> int:
        """The number of windows."""
        return self.observed + self.driven

    @property
    def outputs(self) -> slice:
        """Which of the numbers that a layer carries are its output."""
        return slice(self.scan.network.hidden)

    def _around(self) -> dict[str, Operand]:
        """Returns all that the features and the steps of a window depend on."""
        known, scan = self.known, self.scan
        scaler, everywhere = scan.step.core.scaler, (self.shape[0], 1, self.shape[1], -1)
        shared = {
            "leader_length": known.leader_length[:, None, :, None],
            "conditioning": known.conditioning[:, None],
            "base": known.base[:, None],
            "mean": scaler.mean[:, None, None].expand(everywhere),
            "scale": scaler.scale[:, None, None].expand(everywhere),
            "bias": scan.network.b_out.detach()[:, None].expand(everywhere),
        }
        if scan.temperature is not None:
            shared["temperature"] = scan.temperature.expand(everywhere[:-1]).unsqueeze(-1)
        around = {name: Operand(value) for name, value in shared.items()}
        for name, signal in zip(scan.around_names, known.leader, strict=True):
            around[name] = Operand.over(signal.unsqueeze(2), -self.observed)
        around["logits"] = self.in_driven(self.logits)
        return around | self.columns(self.motion, -self.observed)

    def columns(self, motion: Tensor, offset: int) -> dict[str, Operand]:
        """Returns motion `(slots, M, N, D)` by name."""
        length = self.scan.step.length
        whole = Operand.over(motion.permute(0, 2, 3, 1).unsqueeze(2), offset)
        found = {}
        for k, name in enumerate(_MOTION):
            found[name] = whole.only(slice(k * length, (k + 1) * length))
        if motion.shape[1] > 3 * length:
            found["memory"] = whole.only(slice(3 * length, None))
        return found

    def frames(self, values: Tensor) -> Operand:
        """Returns the frames of a window, of values `(N, D, frames)`."""
        each = torch.unflatten(values, -1, (self.driven, self.scan.step.stride))
        return Operand.over(each.permute(2, 0, 1, 3).unsqueeze(2), -self.observed)

    def in_driven(self, values: Tensor) -> Operand:
        """Returns values `(N, H, D, width)` of a driven window."""
        return _rows(values, -self.observed)

    def output(self, number: int) -> Operand:
        """Returns the output of a layer in a window."""
        return _rows(self.layers[number].carried, 1).only(self.outputs)

    def seen(self, number: int, *, acts: bool) -> Operand:
        """Returns what a layer reads in a window."""
        if number > 0:
            return self.output(number - 1)
        if acts:
            return self.in_driven(self.read)
        return Operand.over(self.known.features.unsqueeze(2))

    def gates(self, number: int, *, acts: bool) -> dict[str, Operand]:
        """Returns all that a layer's cell depends on in a window."""
        layer, network = self.layers[number], self.scan.network
        weights = layer.weights
        bias, hidden = weights.b_input.detach(), weights.b_hidden.detach()
        if number == 0 and acts and network.b_acting is not None:
            bias = bias + network.b_acting.detach()[:, 0]
        units = (*self.shape, network.hidden, 1)
        present = Operand(self.motion.new_ones(()).expand(units))
        if not acts:
            observed = self.known.present[..., None, None]
            present = Operand.over(observed.expand(-1, *units))
        return {
            "projected": self.units(layer.projected),
            "recurrent": self.units(layer.recurrent),
            "carried": self.units(layer.carried),
            "input_bias": Operand(self._by_unit(bias.expand(*self.shape, -1))),
            "hidden_bias": Operand(self._by_unit(hidden.expand(*self.shape, -1))),
            "present": present,
        }

    def units(self, values: Tensor, offset: int = 0) -> Operand:
        """Returns values `(N, slots, D, k h)` of a window unit by unit."""
        return Operand.over(self._by_unit(values.transpose(0, 1)), offset)

    def _by_unit(self, values: Tensor) -> Tensor:
        """Returns `(*batch, k h)` as `(*batch, h, k)`."""
        return torch.unflatten(values, -1, (-1, self.scan.network.hidden)).transpose(-1, -2)

    @property
    def after(self) -> Stand:
        """Where trajectories stand behind the last window."""
        last = self.windows % self.layers[0].carried.shape[1]
        carried = tuple(layer.carried[:, last] for layer in self.layers)
        return Stand(self.motion[self.driven % len(self.motion)], carried)

    def forward(self) -> None:
        """Simulates all windows."""
        observing = self._calls(acts=False) if self.observed > 0 else Calls()
        acting = self._calls(acts=True) if self.driven > 0 else Calls()

        def simulate(networks: slice) -> None:
            observing.run(range(self.observed), networks)
            acting.run(range(self.observed, self.windows), networks)

        share(simulate, _parts(self.shape[0]), level="scan")

    def _calls(self, *, acts: bool) -> Calls:
        """Returns what is computed in a window."""
        calls, scan, network = Calls(), self.scan, self.scan.network
        if acts:
            scan.features.forward(calls, self.around, [self.in_driven(self.read)])
        for number, layer in enumerate(self.layers):
            seen, before = self.seen(number, acts=acts), _rows(layer.carried)
            calls.product(seen, layer.weights.w_input, _rows(layer.projected))
            calls.product(before.only(self.outputs), layer.weights.w_hidden, _rows(layer.recurrent))
            after = self.units(layer.carried, 1)
            scan.cell.forward(calls, self.gates(number, acts=acts), [after])
        if acts:
            calls.product(self.output(-1), network.w_out, self.in_driven(self.logits))
            moved = self.columns(self.motion, 1 - self.observed)
            results = [*moved.values(), self.frames(self.speed), self.frames(self.gap)]
            scan.drive.forward(calls, self.around, results)
        return calls


def _rows(values: Tensor, offset: int = 0) -> Operand:
    """Returns values `(N, slots, D, width)` of a window."""
    return Operand.over(values.transpose(0, 1).unsqueeze(2), offset)


def _parts(networks: int) -> list[slice]:
    """Returns which networks each core takes."""
    size = -(-networks // cores())
    return [slice(first, min(first + size, networks)) for first in range(0, networks, size)]


class _Gradients:
    """Back-propagation through a loop.

    Gradients by gates and answers take the places of these.

    Args:
        loop: what was simulated.
        speed, gap: gradients by its results, `(N, D, frames)`.
    """

    def __init__(self, loop: _Loop, speed: Tensor, gap: Tensor) -> None:
        self.loop = loop
        self.speed, self.gap = speed, gap
        self.of: dict[Tensor, Tensor] = {}
        for weight in loop.scan.network.parameters():
            self.of[weight] = torch.zeros_like(weight)
        # Of a window and of the one behind it.
        self.motion = speed.new_zeros((2, *loop.motion.shape[1:]))
        self.carried = [torch.zeros_like(layer.carried[:, :2]) for layer in loop.layers]

    def backward(self) -> None:
        """Goes back through all windows."""
        loop = self.loop
        acting = self._calls(acts=True) if loop.driven > 0 else Calls()
        observing = self._calls(acts=False) if loop.observed > 0 else Calls()

        def go_back(networks: slice) -> None:
            acting.run(range(loop.windows - 1, loop.observed - 1, -1), networks)
            observing.run(range(loop.observed - 1, -1, -1), networks)
            for first, last in ((loop.observed, loop.windows), (0, loop.observed)):
                if first < last:
                    self._add(first, last, networks)

        share(go_back, _parts(loop.shape[0]), level="scan")

    def _calls(self, *, acts: bool) -> Calls:
        """Returns what is computed in a window."""
        calls, loop, scan = Calls(), self.loop, self.loop.scan
        network, last = scan.network, len(self.carried) - 1
        if acts:
            self._bound(calls)
            gradients = [*loop.columns(self.motion, 1).values()]
            gradients += [loop.frames(self.speed), loop.frames(self.gap)]
            logits, to = loop.in_driven(loop.logits), loop.columns(self.motion, 0)
            scan.drive.backward(calls, loop.around, gradients, [*to.values(), logits])
            behind = _rows(self.carried[last], 1).only(loop.outputs)
            calls.product(logits, network.w_out.mT, behind, adds=True)
        for number in range(last, -1, -1):
            weights, _, projected, recurrent = loop.layers[number]
            carried = self.carried[number]
            to_cell = [loop.units(projected), loop.units(recurrent), loop.units(carried)]
            behind = loop.units(carried, 1)
            scan.cell.backward(calls, loop.gates(number, acts=acts), [behind], to_cell)
            before = _rows(carried).only(loop.outputs)
            calls.product(_rows(recurrent), weights.w_hidden.mT, before, adds=True)
            if number > 0:
                below = _rows(self.carried[number - 1], 1).only(loop.outputs)
                calls.product(_rows(projected), weights.w_input.mT, below, adds=True)
            elif acts:
                self._through_features(calls)
        return calls

    def _through_features(self, calls: Calls) -> None:
        """Adds what goes back from the first layer to the motion before a window."""
        loop, first = self.loop, self.loop.layers[0]
        read = Operand(torch.empty_like(loop.read[:, :1]))
        calls.product(_rows(first.projected), first.weights.w_input.mT, read)
        seen = loop.columns(torch.empty_like(self.motion[:1]), 0)
        seen.pop("memory", None)
        loop.scan.features.backward(calls, loop.around, [read], [*seen.values()])
        before = loop.columns(self.motion, 0)
        for name, gradient in seen.items():
            calls.add(before[name], gradient)

    def _bound(self, calls: Calls) -> None:
        """Adds what bounds the gradients that come back through a window."""
        path, last = self.loop.path, self.loop.windows - 1
        assert path is not None
        decay = path.decay if path.through_motion else 0.0
        for gradient in self.loop.columns(self.motion, 1).values():
            calls.bound(gradient, decay, path.clip, but=last)
        for carried in self.carried:
            calls.bound(_rows(carried, 1), path.decay, path.clip, but=last)

    def _add(self, first: int, last: int, networks: slice) -> None:
        """Adds what some windows give to the gradients of some networks' weights."""
        loop, network = self.loop, self.loop.scan.network
        drives = first >= loop.observed
        for number, layer in enumerate(loop.layers):
            weights = layer.weights
            projected = layer.projected[networks, first:last].flatten(1, 2)
            recurrent = layer.recurrent[networks, first:last].flatten(1, 2)
            if number > 0:
                below = loop.layers[number - 1].carried[networks, first + 1 : last + 1]
                read = below[..., : network.hidden]
            elif drives:
                read = loop.read[networks]
            else:
                read = loop.known.features[:, networks].transpose(0, 1)
            before = layer.carried[networks, first:last, :, : network.hidden]
            self._of(weights.w_input, networks).baddbmm_(read.flatten(1, 2).mT, projected)
            self._of(weights.w_hidden, networks).baddbmm_(before.flatten(1, 2).mT, recurrent)
            bias = projected.sum(1, keepdim=True)
            self._of(weights.b_input, networks).add_(bias)
            self._of(weights.b_hidden, networks).add_(recurrent.sum(1, keepdim=True))
            if number == 0 and drives and network.b_acting is not None:
                self._of(network.b_acting, networks).add_(bias[:, None])
        if drives:
            outputs = loop.layers[-1].carried[networks, first + 1 : last + 1, :, : network.hidden]
            logits = loop.logits[networks].flatten(1, 2)
            self._of(network.w_out, networks).baddbmm_(outputs.flatten(1, 2).mT, logits)
            self._of(network.b_out, networks).add_(logits.sum(1, keepdim=True))

    def _of(self, weight: Tensor, networks: slice) -> Tensor:
        """Returns the gradient by some networks' weights."""
        return self.of[weight][networks]


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

"""A row of windows, simulated by compiled code: windows that are observed, then windows driven.

Shapes: N networks, D trajectories of each, B windows that are observed, H windows that are driven,
L frames of a token, S steps of a window, F features that networks read, n answers, h hidden units,
c numbers that a layer carries (h, or 2 h), G = gates h, M = 3 L + width of the model's memory. A
slot is a place in memory for the values of one window.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cfx.core.threads import cores, share
from cfx.learners.compiled.calls import Calls, Operand
from cfx.learners.compiled.window import MOTION, CompiledWindow
from cfx.learners.rollout.dataset import Conditioning, RolloutBatch, RolloutDataset
from cfx.learners.rollout.window import RolloutInputs
from cfx.policies.recurrent import RecurrentLayer


class CarriedState(NamedTuple):
    """What trajectories carry from one window to the next.

    Attributes:
        motion: position, speed and acceleration of the last L frames, then the memory, `(M, N, D)`.
        carried: of each layer, `(N, D, c)`.
    """

    motion: Tensor
    carried: tuple[Tensor, ...]


class WindowInputs(NamedTuple):
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
        burn_in_windows: int | None,
    ) -> WindowInputs:
        """Returns what trajectories read; at most `burn_in_windows` are observed before them."""
        tokens, present = dataset.observed_windows(batch, conditioning.pair, burn_in_windows)
        context, scaler = conditioning.features, dataset.scaler
        features = torch.cat([tokens, context.expand(len(tokens), -1, -1, -1)], -1)
        features.sub_(scaler.mean[:, None]).div_(scaler.scale[:, None])
        leader = (inputs.leader, inputs.leader_length)
        return cls(features, present.to(tokens.dtype), *leader, context, conditioning.base)

    def windows(self, observed: slice, driven: slice) -> WindowInputs:
        """Returns what some of the windows read."""
        features, present = self.features[observed], self.present[observed]
        return self._replace(features=features, present=present, leader=self.leader[:, driven])


class LayerValues(NamedTuple):
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


class ForwardPass:
    """B windows that are observed, then H windows that are driven, and the values that they leave.

    Args:
        window: a window as compiled code.
        inputs: what these windows read.
        state: what trajectories carry into the first.
        keeps: whether the values of every window are kept, for a backward pass; without, windows
            take turns in as few slots as there must be.
    """

    def __init__(
        self, window: CompiledWindow, inputs: WindowInputs, state: CarriedState, *, keeps: bool
    ) -> None:
        self.window, self.inputs = window, inputs
        network, step = window.network, window.step
        self.observed, self.driven = len(inputs.present), inputs.leader.shape[1]
        networks, trajectories = self.shape
        windows, driven = self.windows, self.driven
        # States have a slot more than windows: the one before the first.
        carried_slots, motion_slots = windows + 1, driven + 1
        if not keeps:
            windows, driven, carried_slots, motion_slots = 1, 1, 2, 2
        new = state.motion.new_empty
        self.motion = new((motion_slots, len(state.motion), networks, trajectories))
        self.motion[0] = state.motion
        self.read = new((networks, driven, trajectories, step.core.scaler.mean.shape[-1]))
        gates = (networks, windows, trajectories, network.gates * network.hidden)
        self.layers = []
        for weights, before in zip(network.layers, state.carried, strict=True):
            assert isinstance(weights, RecurrentLayer)
            carried = new((networks, carried_slots, trajectories, before.shape[-1]))
            carried[:, 0] = before
            self.layers.append(LayerValues(weights, carried, new(gates), new(gates)))
        self.logits = new((networks, driven, trajectories, step.core.head.answers))
        self.speed = new((networks, trajectories, self.driven * step.stride))
        self.gap = torch.empty_like(self.speed)
        self.surroundings: dict[str, Operand] = {}
        """All that the features and the steps of a window depend on, by name."""
        if self.driven > 0:
            self.surroundings = self._surroundings()

    @property
    def shape(self) -> tuple[int, int]:
        """The networks, and the trajectories of each: N and D."""
        networks, trajectories = self.inputs.leader_length.shape
        return networks, trajectories

    @property
    def windows(self) -> int:
        """The number of windows, B + H."""
        return self.observed + self.driven

    @property
    def outputs(self) -> slice:
        """Where a layer's output stands in its state; an LSTM's state holds more."""
        return slice(self.window.network.hidden)

    def _surroundings(self) -> dict[str, Operand]:
        inputs, window = self.inputs, self.window
        scaler, everywhere = window.step.core.scaler, (self.shape[0], 1, self.shape[1], -1)
        # The same in all windows; elementwise code wants (N, 1, D, width).
        constant = {
            "leader_length": inputs.leader_length[:, None, :, None],
            "conditioning": inputs.conditioning[:, None],
            "base": inputs.base[:, None],
            "mean": scaler.mean[:, None, None].expand(everywhere),
            "scale": scaler.scale[:, None, None].expand(everywhere),
            "bias": window.network.b_out.detach()[:, None].expand(everywhere),
        }
        if window.temperature is not None:
            constant["temperature"] = window.temperature.expand(everywhere[:-1]).unsqueeze(-1)
        surroundings = {name: Operand(value) for name, value in constant.items()}
        for name, signal in zip(window.leader_names, inputs.leader, strict=True):
            surroundings[name] = Operand.over(signal.unsqueeze(2), -self.observed)
        surroundings["logits"] = self.in_driven(self.logits)
        return surroundings | self.columns(self.motion, -self.observed)

    def columns(self, motion: Tensor, offset: int) -> dict[str, Operand]:
        """Returns motion `(slots, M, N, D)` by name, as operands `(N, 1, D, width)`."""
        length = self.window.step.length
        all_columns = Operand.over(motion.permute(0, 2, 3, 1).unsqueeze(2), offset)
        by_name = {}
        for k, name in enumerate(MOTION):
            by_name[name] = all_columns.only(slice(k * length, (k + 1) * length))
        if motion.shape[1] > 3 * length:
            by_name["memory"] = all_columns.only(slice(3 * length, None))
        return by_name

    def frames(self, values: Tensor) -> Operand:
        """Returns the frames of a window, of values `(N, D, H S)`, as an operand `(N, 1, D, S)`."""
        by_window = torch.unflatten(values, -1, (self.driven, self.window.step.stride))
        return Operand.over(by_window.permute(2, 0, 1, 3).unsqueeze(2), -self.observed)

    def in_driven(self, values: Tensor) -> Operand:
        """Returns values `(N, H, D, width)` of a driven window."""
        return rows(values, -self.observed)

    def output(self, number: int) -> Operand:
        """Returns the output of a layer in a window."""
        return rows(self.layers[number].carried, 1).only(self.outputs)

    def layer_input(self, number: int, *, drives: bool) -> Operand:
        """Returns what a layer reads in a window."""
        if number > 0:
            return self.output(number - 1)
        if drives:
            return self.in_driven(self.read)
        return Operand.over(self.inputs.features.unsqueeze(2))

    def gates(self, number: int, *, drives: bool) -> dict[str, Operand]:
        """Returns the inputs of a layer's cell in a window, as operands `(N, D, h, k)`."""
        layer, network = self.layers[number], self.window.network
        weights = layer.weights
        bias, hidden = weights.b_input.detach(), weights.b_hidden.detach()
        if number == 0 and drives and network.b_acting is not None:
            bias = bias + network.b_acting.detach()[:, 0]
        units = (*self.shape, network.hidden, 1)
        present = Operand(self.motion.new_ones(()).expand(units))
        if not drives:
            observed = self.inputs.present[..., None, None]
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
        """Returns values `(N, slots, D, k h)` of a window unit by unit, `(N, D, h, k)`."""
        return Operand.over(self._by_unit(values.transpose(0, 1)), offset)

    def _by_unit(self, values: Tensor) -> Tensor:
        """Returns `(*batch, k h)` as `(*batch, h, k)`."""
        return torch.unflatten(values, -1, (-1, self.window.network.hidden)).transpose(-1, -2)

    @property
    def after(self) -> CarriedState:
        """What trajectories carry out of the last window."""
        last = self.windows % self.layers[0].carried.shape[1]
        carried = tuple(layer.carried[:, last] for layer in self.layers)
        return CarriedState(self.motion[self.driven % len(self.motion)], carried)

    def run(self) -> None:
        """Simulates all windows."""
        observe, drive = Calls(), Calls()
        if self.observed > 0:
            observe = self._calls(drives=False)
        if self.driven > 0:
            drive = self._calls(drives=True)

        def simulate(networks: slice) -> None:
            observe.run(range(self.observed), networks)
            drive.run(range(self.observed, self.windows), networks)

        share(simulate, shards_of_networks(self.shape[0]), level="scan")

    def _calls(self, *, drives: bool) -> Calls:
        """Returns what is computed in a window."""
        calls, window, network = Calls(), self.window, self.window.network
        if drives:
            window.features.forward(calls, self.surroundings, [self.in_driven(self.read)])
        for number, layer in enumerate(self.layers):
            weights, before = layer.weights, rows(layer.carried).only(self.outputs)
            layer_input = self.layer_input(number, drives=drives)
            calls.product(layer_input, weights.w_input, rows(layer.projected))
            calls.product(before, weights.w_hidden, rows(layer.recurrent))
            after = self.units(layer.carried, 1)
            window.cell.forward(calls, self.gates(number, drives=drives), [after])
        if drives:
            calls.product(self.output(-1), network.w_out, self.in_driven(self.logits))
            moved = self.columns(self.motion, 1 - self.observed)
            results = [*moved.values(), self.frames(self.speed), self.frames(self.gap)]
            window.drive.forward(calls, self.surroundings, results)
        return calls


def rows(values: Tensor, offset: int = 0) -> Operand:
    """Returns values `(N, slots, D, width)` of a window, as an operand `(N, 1, D, width)`."""
    return Operand.over(values.transpose(0, 1).unsqueeze(2), offset)


def shards_of_networks(networks: int) -> list[slice]:
    """Returns which networks each core takes."""
    size = -(-networks // cores())
    return [slice(first, min(first + size, networks)) for first in range(0, networks, size)]

"""A window step of recurrent networks as elementwise functions, which are recorded and compiled.

Between them are matrix products with the networks' weights alone: token -> features -> products ->
recurrent cell of each layer -> product -> the steps of the window.

Shapes: N networks, D trajectories of each, L frames of a token, S steps of a window, M = 3 L +
width of the model's memory.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from cfx.calibration import losses
from cfx.core import parameters
from cfx.core.component import folder_hash
from cfx.core.memory import keep_freed_memory
from cfx.learners.compiled.calls import Calls, Operand
from cfx.learners.compiled.elementwise import Elementwise
from cfx.learners.rollout import window
from cfx.learners.rollout.window import LeaderWindow, LoopState, WindowStep
from cfx.policies import features, inputs
from cfx.policies.features import token_width
from cfx.policies.recurrent import RecurrentNetwork
from cfx.simulation.kernel.columns import Unsupported
from cfx.simulation.kernel.run import component_code

MOTION = ("position", "speed", "acceleration")
"""What is simulated of a vehicle, in the order of `LoopState`."""


class NamedElementwise:
    """An elementwise function whose arguments have names; those without columns are left out.

    Args:
        function: of its arguments by name.
        widths: columns of each argument; 0: it is empty.
        differentiated: names of the arguments by which it is differentiated.
        key: as for `Elementwise`.
        together: as for `Elementwise`; None: no bound.
    """

    def __init__(
        self,
        function: Callable[[Mapping[str, Tensor]], Sequence[Tensor]],
        widths: Mapping[str, int],
        differentiated: Sequence[str],
        key: object,
        together: int | None = None,
    ) -> None:
        self.names = [name for name, width in widths.items() if width > 0]
        numbers = [self.names.index(name) for name in differentiated if name in self.names]

        def of_values(*values: Tensor) -> Sequence[Tensor]:
            empty = values[0][..., :0]
            arguments = dict.fromkeys(widths, empty)
            arguments.update(zip(self.names, values, strict=True))
            return function(arguments)

        used = [widths[name] for name in self.names]
        if together is None:
            self.code = Elementwise(of_values, used, numbers, key)
        else:
            self.code = Elementwise(of_values, used, numbers, key, together)

    def forward(
        self, calls: Calls, arguments: Mapping[str, Operand], to: Sequence[Operand]
    ) -> None:
        """Adds the call that computes the function and writes its results."""
        calls.elementwise(self.code.compiled.forward, [*self._in_order(arguments), *to])

    def backward(
        self,
        calls: Calls,
        arguments: Mapping[str, Operand],
        gradients: Sequence[Operand],
        to: Sequence[Operand],
    ) -> None:
        """Adds the call that writes the gradients by the arguments it is differentiated by."""
        operands = [*self._in_order(arguments), *gradients, *to]
        calls.elementwise(self.code.compiled.backward, operands)

    def _in_order(self, arguments: Mapping[str, Operand]) -> list[Operand]:
        return [arguments[name] for name in self.names]


class CompiledWindow:
    """The elementwise functions of a window step of recurrent networks.

    Args:
        step: the window, in single precision, on the CPU.
        temperature: of the model, `()`; None: regimes switch exactly.
        trains: whether gradients are needed.

    Attributes:
        features: what networks read, normalised, of motion and leaders.
        drive: the steps of the window, of the networks' answers, motion and leaders.
        cell: what a layer carries after the window, of the products with its weights.
        leader_names: of what is recorded around the follower, in the order of
            `RolloutInputs.leader`.

    Raises:
        Unsupported: networks are not recurrent, a function is not elementwise, or there is no
            compiler.
    """

    def __init__(self, step: WindowStep, temperature: Tensor | None, *, trains: bool) -> None:
        keep_freed_memory()
        core, network = step.core, step.core.network
        if not isinstance(network, RecurrentNetwork) or network.dropout.p > 0:
            raise Unsupported("networks that are not recurrent, or have dropout")
        self.step, self.network, self.temperature = step, network, temperature
        key, length = window_key(step), step.length
        self.leader_names = [f"leader_{name}" for name in MOTION]
        for signal in core.further_signals:
            self.leader_names.append(f"around_{signal.name}")
        around = dict.fromkeys(MOTION, length)
        around |= dict.fromkeys(self.leader_names, length + step.stride)
        around["leader_length"] = 1

        width = core.scaler.mean.shape[-1]
        conditioning = width - token_width(core.inputs, core.summary, length)
        read = around | {"conditioning": conditioning, "mean": width, "scale": width}
        self.features = NamedElementwise(self._features, read, MOTION, _part(key, "features"))

        driven = around | {"memory": step.model.memory_size, "base": len(core.head.space)}
        driven |= {"logits": core.head.answers, "bias": core.head.answers}
        driven["temperature"] = 0
        if temperature is not None:
            driven["temperature"] = 1
        differentiated = [*MOTION, "memory", "logits"] if trains else []
        drive_key = _part(key, "drive", temperature is None)
        self.drive = NamedElementwise(self._drive, driven, differentiated, drive_key)

        gates = {"projected": network.gates, "recurrent": network.gates, "carried": network.states}
        given = {"input_bias": network.gates, "hidden_bias": network.gates, "present": 1}
        cell_key = _part(key, "cell")
        self.cell = NamedElementwise(
            self._cell, gates | given, list(gates), cell_key, together=network.hidden
        )

    def _features(self, columns: Mapping[str, Tensor]) -> Sequence[Tensor]:
        """Returns normalised features."""
        values = self.step.features(*self._surroundings(columns), columns["conditioning"])
        return [(values - columns["mean"]) / columns["scale"]]

    def _drive(self, columns: Mapping[str, Tensor]) -> Sequence[Tensor]:
        """Returns motion and memory after a window, and speed and gap in it."""
        step = self.step
        if self.temperature is not None:
            # As an argument, not as the number that it is now: it falls from epoch to epoch.
            step = copy.copy(step)
            step.model = step.model.at_temperature(columns["temperature"][..., 0])
        answer = (columns["logits"] + columns["bias"]).sigmoid()
        after, speed, gap = step.steer(answer, *self._surroundings(columns), columns["base"])
        moved = [after.position, after.speed, after.acceleration]
        if after.memory.shape[-1] > 0:
            moved.append(after.memory)
        return [*moved, speed, gap]

    def _surroundings(
        self, columns: Mapping[str, Tensor]
    ) -> tuple[LoopState, LeaderWindow, Tensor]:
        """Returns where trajectories stand, and the leaders around a window with their lengths."""
        empty = columns["position"][..., :0]
        motion = (columns["position"], columns["speed"], columns["acceleration"])
        now = LoopState(*motion, columns.get("memory", empty), empty, empty)
        position, speed, acceleration, *more = [columns[name] for name in self.leader_names]
        leader = LeaderWindow(position, speed, acceleration, tuple(more))
        return now, leader, columns["leader_length"][..., 0]

    def _cell(self, columns: Mapping[str, Tensor]) -> Sequence[Tensor]:
        """Returns what a layer carries after a window; as before where there is no such window."""
        projected = columns["projected"] + columns["input_bias"]
        recurrent = columns["recurrent"] + columns["hidden_bias"]
        after = self.network.cell(projected, recurrent, columns["carried"])
        return [torch.where(columns["present"] > 0, after, columns["carried"])]


def _part(key: object, *names: object) -> object:
    """Returns the key of one of a window's functions; None where the window has none."""
    if key is None:
        return None
    return [key, *names]


def window_key(step: WindowStep) -> object:
    """Returns what a window depends on besides tensors; None if only this process knows."""
    core, code = step.core, []
    for component in (step.model, core.head, core.policy, *core.inputs):
        code.append(component_code(type(component)))
    if None in code:
        return None
    settings = [step.model.equations_key(), repr(step.space), step.length, step.stride, step.dt]
    read = [core.policy.inputs, core.summary, core.scaler.mean.shape[-1]]
    rooms = []
    for module in (features, inputs, parameters, losses, window):
        rooms.append(folder_hash(str(module.__file__)))
    return [code, settings, read, rooms, folder_hash(__file__)]

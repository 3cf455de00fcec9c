"""One step of drivers as an ONNX graph, whose tensors have names, meanings and units."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import onnx
import torch
from torch import Tensor, nn

import cfx
from cfx.errors import ConfigError
from cfx.plugin import DriverState, DriverStep, Motion

OPSET = 20

SIGNALS = {
    "ego_speed": ("m/s", "speed of the vehicle"),
    "ego_acceleration": ("m/s2", "its acceleration over the last step, (v(t) - v(t - dt)) / dt"),
    "leader_speed": ("m/s", "speed of the vehicle ahead"),
    "leader_acceleration": ("m/s2", "acceleration of the vehicle ahead"),
    "gap": ("m", "to the vehicle ahead, bumper to bumper; infinity: nobody is ahead"),
}
NOISE = ("1", "standard normal, new in each step; a driver whose window begins draws of it")
STATE = {
    "steps": ("1", "steps since the driver began"),
    "history": (
        "m/s, m/s2, m",
        "the signals at the last frames: the leader's, the driver's, the gap, then further ones",
    ),
    "parameters": ("as cfx.parameters says", "parameters that hold in this window"),
    "memory": ("SI", "what the driving model remembers"),
    "network": ("1", "what the network remembers"),
    "latent": ("1", "random numbers that a driver keeps from window to window"),
    "score": ("1", "how far outside what was learned the window began; up to 1 is inside"),
}
NEXT_SPEED = ("m/s", "speed one time step later")


class _Step(nn.Module):
    """The step with flat inputs and outputs; what is empty is left out."""

    def __init__(self, step: DriverStep) -> None:
        super().__init__()
        self.step = step
        self.network = step.agent.core.network  # so that its weights are the graph's
        self.kept = kept_of(step)

    def forward(self, signals: tuple[Tensor, ...], more: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        speed, acceleration, leader_speed, leader_acceleration, gap, *further = signals
        names = [signal.name for signal in self.step.further_signals]
        given = dict(zip(self.kept, more, strict=False))
        columns = []
        for name in DriverState._fields:
            columns.append(given.get(name, gap.new_zeros((gap.shape[0], 0))))
        noise = more[-1] if self.step.noise_width else None
        after_speed, after = self.step.unbranched(
            DriverState(*columns),
            Motion(speed, acceleration),
            Motion(leader_speed, leader_acceleration),
            gap,
            noise,
            dict(zip(names, further, strict=True)),
        )
        remembered = after._asdict()
        return after_speed, *(remembered[name].clone() for name in self.kept)


def kept_of(step: DriverStep) -> list[str]:
    """Returns the names of what drivers of this policy remember: the state that is not empty."""
    return [name for name, value in step.begin(1)._asdict().items() if value.numel()]


def signals_of(step: DriverStep) -> dict[str, tuple[str, str]]:
    """Returns unit and meaning of each signal that a step is given, by its name in the graph."""
    signals = dict(SIGNALS)
    for signal in step.further_signals:
        signals[signal.name] = (signal.unit or "1", signal.meaning)
    return signals


def graph_of(step: DriverStep, run: str, *, one_driver: bool = False) -> onnx.ModelProto:
    """Returns the graph of a step.

    Args:
        step: of the drivers.
        run: where the policy comes from, for the graph's metadata.
        one_driver: for one driver, all shapes known, instead of for any number.

    Raises:
        ConfigError: the policy computes with what ONNX does not have.
    """
    kept = kept_of(step)
    signals, more = _example(step, kept, 1 if one_driver else 3)
    inputs = [*signals_of(step), *kept]
    if step.noise_width:
        inputs.append("noise")
    drivers = {0: torch.export.Dim("drivers")}
    shapes = None if one_driver else ((drivers,) * len(signals), (drivers,) * len(more))
    try:
        with _quiet():
            program = torch.onnx.export(
                _Step(step),
                (signals, more),
                dynamo=True,
                opset_version=OPSET,
                input_names=inputs,
                output_names=["next_speed", *(f"next_{name}" for name in kept)],
                dynamic_shapes=shapes,
                optimize=False,  # its optimizer loses bounds of clamps; runtimes have their own
                verbose=False,
            )
    except Exception as error:  # whatever stops a trace
        raise ConfigError(
            f"{run}: policy={step.agent.policy_node['name']} cannot be written as ONNX"
            f" ({type(error).__name__}); export a policy with a network, such as gru or lstm"
        ) from error
    assert program is not None
    model = program.model_proto
    _strip(model)
    _describe(model, step, run)
    onnx.checker.check_model(model)
    return model


def _example(
    step: DriverStep, kept: list[str], drivers: int
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Returns inputs with which the step is traced, each a tensor of its own."""
    signals = []
    for number, _ in enumerate(signals_of(step)):
        signals.append(torch.full((drivers,), 1.0 + number, dtype=torch.float64))
    more = [value for name, value in step.begin(drivers)._asdict().items() if name in kept]
    if step.noise_width:
        more.append(torch.zeros((drivers, step.noise_width), dtype=torch.float64))
    return tuple(signals), tuple(more)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps back what the exporter says of itself and of libraries that are not there."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        exporter.setLevel(level)


def _strip(model: onnx.ModelProto) -> None:
    """Takes out what the exporter notes of each node, such as lines of source code."""
    graph = model.graph
    del model.metadata_props[:], graph.metadata_props[:], graph.value_info[:]
    for part in (*graph.node, *graph.input, *graph.output, *graph.initializer):
        del part.metadata_props[:]
        part.doc_string = ""
    for function in model.functions:
        for node in function.node:
            del node.metadata_props[:]
            node.doc_string = ""


def _describe(model: onnx.ModelProto, step: DriverStep, run: str) -> None:
    """Writes meanings and units into the graph, and what it is into its metadata."""
    described = {**signals_of(step), "noise": NOISE, **STATE, "next_speed": NEXT_SPEED}
    about = {
        "cfx.version": cfx.__version__,
        "cfx.policy": run,
        "cfx.model": str(step.agent.model_node["name"]),
        "cfx.dt": f"{step.dt:g} s",
        "cfx.signals": " ".join(signals_of(step)),
        "cfx.parameters": ", ".join(
            f"{parameter.name} [{parameter.unit}]" for parameter in step.agent.space.tuned
        ),
    }
    for tensor in (*model.graph.input, *model.graph.output):
        name = tensor.name
        unit, meaning = described[name if name in described else name.removeprefix("next_")]
        tensor.doc_string = f"{meaning} [{unit}]"
        about[f"unit.{name}"] = unit
        about[f"meaning.{name}"] = meaning
    onnx.helper.set_model_props(model, about)
    model.doc_string = f"One step of {step.dt:g} s of drivers that cfx trained: {run}"
    model.producer_name, model.producer_version = "cfx", cfx.__version__

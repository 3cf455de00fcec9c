"""The driver inside an FMU: `driver.onnx` beside this file, and what is remembered between steps.

It runs where the FMU is simulated, so it imports NumPy and ONNX Runtime alone, not cfx.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from pythonfmu3 import Fmi3Causality, Fmi3Slave, Fmi3StepResult, Fmi3Variability
from pythonfmu3.default_experiment import DefaultExperiment
from pythonfmu3.enums import Fmi3Initial, Fmi3Status
from pythonfmu3.unit import Unit
from pythonfmu3.variables import Float64, Int32

_SAME_S = 1e-6
_STARTS = {"ego_speed": 10.0, "leader_speed": 10.0, "gap": 30.0}


class CfxDriver(Fmi3Slave):  # type: ignore[misc]  # PythonFMU3 has no types
    """One driver behind the vehicle ahead; the FMU's environment moves both vehicles."""

    author = "cfx"
    license = "MIT"

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        folder = str(self.resources).removeprefix("file://")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(str(Path(folder, "driver.onnx")), options)
        about = self._session.get_modelmeta().custom_metadata_map
        self.dt = float(about["cfx.dt"].split()[0])
        self.description = (
            f"One step of {self.dt:g} s of a driver that cfx trained: {about['cfx.policy']}"
        )
        self.default_experiment = DefaultExperiment(start_time=0.0, step_size=self.dt)
        self.register_units(list(_UNITS.values()))
        self.time = 0.0
        self._register("time", "s", "simulated time", Fmi3Causality.independent)
        self.seed = 0
        self._state: dict[str, np.ndarray[Any, Any]] = {}
        for one in self._session.get_inputs():
            kinds: dict[str, Any] = {"tensor(int64)": np.int64, "tensor(float)": np.float32}
            kind = kinds.get(one.type, np.float64)
            self._state[one.name] = np.zeros((1, *one.shape[1:]), kind)
        # What a network does not read is no input of its graph.
        given = about["cfx.signals"].split()
        self._signals = [name for name in given if name in self._state]
        for name in self._signals:
            setattr(self, name, _STARTS.get(name, 0.0))
            meaning = about[f"meaning.{name}"]
            self._register(name, about[f"unit.{name}"], meaning, Fmi3Causality.input)
        self.next_speed, self.acceleration = self._now("ego_speed"), 0.0
        for name, (unit, meaning) in _OUTPUTS.items():
            self._register(name, unit, meaning, Fmi3Causality.output)
        self._is_stochastic = "noise" in self._state
        if self._is_stochastic:
            self.register_variable(
                Int32(
                    "seed",
                    causality=Fmi3Causality.parameter,
                    variability=Fmi3Variability.fixed,
                    description="of what the driver leaves to chance",
                )
            )
        self._random = np.random.default_rng(0)

    def exit_initialization_mode(self) -> None:
        """Begins a driver; until the first step the speed stays."""
        self._random = np.random.default_rng(self.seed)
        self.next_speed = self._now("ego_speed")

    def do_step(self, current_time: float, step_size: float) -> Fmi3StepResult:
        """Gives the speed at the end of a step of `dt`, from what the inputs say at its begin.

        A step with an input that is not a number is discarded: nothing of it is remembered.
        """
        if abs(step_size - self.dt) > _SAME_S:
            self.log(
                f"this driver steps by {self.dt:g} s, not by {step_size:g} s;"
                f" set the communication step to {self.dt:g} s",
                status=Fmi3Status.error,
            )
            return Fmi3StepResult(status=Fmi3Status.error)
        for name in self._signals:
            self._state[name] = np.array([self._now(name)])
        if self._is_stochastic:
            self._state["noise"] = self._random.standard_normal(self._state["noise"].shape)
        outputs = [one.name for one in self._session.get_outputs()]
        values = dict(zip(outputs, self._session.run(None, self._state), strict=True))
        speed = float(values.pop("next_speed")[0])
        if math.isnan(speed):
            given = ", ".join(f"{name}={self._now(name):g}" for name in self._signals)
            self.log(
                f"the step is discarded, as an input is not a number: {given}; set each of them,"
                " and gap to infinity where nobody is ahead",
                status=Fmi3Status.discard,
            )
            return Fmi3StepResult(status=Fmi3Status.discard)
        self.next_speed = speed
        self.acceleration = (self.next_speed - self._now("ego_speed")) / self.dt
        for name, value in values.items():
            self._state[name.removeprefix("next_")] = value
        self.time = current_time + step_size
        return Fmi3StepResult()

    def _now(self, name: str) -> float:
        return float(getattr(self, name))

    def _register(self, name: str, unit: str, meaning: str, causality: Fmi3Causality) -> None:
        initial = Fmi3Initial.calculated if causality is Fmi3Causality.output else None
        self.register_variable(
            Float64(
                name,
                unit=unit if unit in _UNITS else None,
                description=meaning,
                causality=causality,
                variability=Fmi3Variability.continuous,
                initial=initial,
            )
        )


_UNITS = {
    "s": Unit("s", s=1),
    "m": Unit("m", m=1),
    "m/s": Unit("m/s", m=1, s=-1),
    "m/s2": Unit("m/s2", m=1, s=-2),
}
"""Units that FMI is told of; the description of a variable in another one says what it is."""

_OUTPUTS = {
    "next_speed": ("m/s", "speed of the vehicle one step later"),
    "acceleration": ("m/s2", "acceleration of the vehicle until then"),
}

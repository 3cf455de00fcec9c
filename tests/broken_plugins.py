"""Third parties' distributions that are broken, one for each way to break a contract."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from tests.installer import Installer

QUICK = (
    "model=krauss",
    "learner=imitation",
    "protocol=within_driver",
    "data=synthetic",
    "data.pairs=2",
    "data.platoon_size=1",
    "data.frames=150",
    "optimizer=random",
    "optimizer.samples=16",
    "calibration.prior=weak",
    "policy=fixed",
    "figures=none",
    "tracking.enabled=false",
    "cache.enabled=false",
)
"""A job of a second."""

_MODEL = """
import torch
from cfx.plugin import DrivingModel, Parameter, ParameterSpace

class Bad(DrivingModel):
    parameters = ParameterSpace.of(
        Parameter("tau", "s", 0.5, 3.0, 1.0, "time gap"),
        Parameter("a", "m/s2", 1.0, 3.0, 2.0, "maximum acceleration"),
    )

    def next_speed(self, follower, leader, p, dt):
        gap = leader.position - leader.length - follower.position
        speed = torch.minimum(follower.speed + p["a"] * dt, gap / p["tau"]).clamp(min=0.0)
        return {}
"""

POLICY = """
import torch
from cfx.plugin import Policy, PolicyNetwork

class Bad(Policy):
    trainable = False

    def build(self, features, default, fixed, generator):
        return Network(fixed)

class Network(PolicyNetwork):
    def __init__(self, fixed):
        super().__init__()
        self.register_buffer("unit", fixed.clone())

    def initial_state(self, networks, drivers):
        return self.unit.new_zeros((networks, drivers, 0))

    def forward(self, tokens, state):
        answer = self.unit[:, None, None].expand(*tokens.shape[:3], -1)
        return {}, state
"""

_OPTIMIZER = """
import torch
from cfx.plugin import Optimizer

class Bad(Optimizer):
    def evaluations(self, n):
        return 4

    def bytes_per_problem(self, n):
        return 64 * n

    def solve(self, objective, guesses, *, seed):
        candidates = guesses[:, :1].expand(-1, 4, -1)
        {}
"""

_OBJECTIVE = """
from cfx.plugin import Objective

class Bad(Objective):
    unit = "m/s"
    signals = ("speed",)

    def terms(self, frames):
        return ((frames.speed - frames.measured_speed).square(),)

    def finish(self, sums, count, epsilon=0.0):
        return {}
"""

_DATASET = """
import numpy as np
from cfx.plugin import Dataset, Pair, PairSet

class Bad(Dataset):
    def read(self):
        time = 0.1 * np.arange(800)
        speed = np.full(800, 10.0)
        leader = 30.0 + 10.0 * time
        still = 0 * speed
        follower = 10.0 * time
        pair = Pair("p", "r", "1", "2", 0, 0.1, 5.0, leader, speed, still, follower, speed, still)
        {}
"""

_SIMULATOR = """
from cfx.plugin import Simulator
from cfx.simulation.rollout import MemoryStepper

class Bad(Simulator):
    differentiable = True

    def stepper(self, model, dt):
        return {}

class Single(MemoryStepper):
    def advance(self, *inputs):
        end, position, speed = super().advance(*inputs)
        return end, position.float(), speed.float()
"""


@dataclass(frozen=True)
class Broken:
    """One broken distribution.

    Attributes:
        name: of the component; its distribution is `bad-NAME` 1.0, its module `bad_NAME`.
        kind: group of the entry point, such as models.
        code: of the module.
        complaint: what the job that asks for it must say, a regular expression.
        override: what asks for it.
        api: what its entry points of the group `cfx.api` are called.
    """

    name: str
    kind: str
    code: str
    complaint: str
    api: tuple[str, ...] = field(default=("1",))

    @property
    def distribution(self) -> str:
        return f"bad-{self.name.replace('_', '-')}"

    @property
    def override(self) -> str:
        group = {"datasets": "data", "policies": "policy"}.get(self.kind, self.kind[:-1])
        return f"{group}={self.name}"

    @property
    def entry_points(self) -> dict[str, dict[str, str]]:
        module = f"bad_{self.name}"
        return {
            f"cfx.{self.kind}": {self.name: f"{module}:Bad"},
            "cfx.api": dict.fromkeys(self.api, module),
        }

    @property
    def files(self) -> Mapping[str, str]:
        return {f"bad_{self.name}.py": self.code}


def _model(name: str, returned: str, complaint: str) -> Broken:
    return Broken(name, "models", _MODEL.format(returned), complaint)


BROKEN = (
    Broken(
        "raises",
        "models",
        "raise RuntimeError('no luck')",
        "cannot be imported: RuntimeError: no luck",
    ),
    Broken("exits", "models", "raise SystemExit(0)", "cannot be imported: SystemExit: 0"),
    Broken(
        "unmade",
        "models",
        _MODEL.format("speed").replace("next_speed", "step"),
        "does not implement next_speed",
    ),
    _model(
        "asks_more",
        "speed * p['b']",
        r"next_speed reads the parameter 'b', which is not in its `parameters` \(tau, a\)",
    ),
    _model(
        "not_a_number",
        "speed * float('nan')",
        r"next_speed gives nan m/s in 64 of 64 ordinary states",
    ),
    _model(
        "backwards", "speed - 100.0", r"next_speed gives -\d+\.?\d* m/s in 64 of 64 ordinary states"
    ),
    _model(
        "wide",
        "speed[..., None]",
        r"next_speed gives the shape \(64, 1\); it must give \(\*batch,\), here \(64,\)",
    ),
    _model("half", "speed.half()", r"next_speed gives torch\.float16 for torch\.float64"),
    _model("doubles", "speed.double()", r"next_speed gives torch\.float64 for torch\.float32"),
    _model("numpy", "speed.numpy()", r"next_speed gives a ndarray"),
    _model("crashes", "speed @ p['a'][:3]", r"the component raised RuntimeError: "),
    Broken(
        "asks_less",
        "models",
        _MODEL.format("follower.speed").replace('gap / p["tau"]', "gap"),
        r"it declares 2 tuned parameters \(tau, a\), but next_speed never reads tau",
    ),
    Broken(
        "unborn",
        "models",
        _MODEL.format("speed")
        + "\n    def __init__(self, settings=None, **options):\n        raise OSError('no map')\n",
        "cannot be created: OSError: no map",
    ),
    Broken(
        "newer",
        "models",
        _MODEL.format("speed"),
        r"was built for version 2 of cfx's plugin API, this cfx has version 1; pip"
        r" install --upgrade cfx-driving",
        api=("2",),
    ),
    Broken(
        "older",
        "models",
        _MODEL.format("speed"),
        r"was built for version 0 of cfx's plugin API, this cfx has version 1; pip"
        r" install --upgrade bad-older",
        api=("0",),
    ),
    Broken(
        "odd",
        "models",
        _MODEL.format("speed"),
        "declares 'one' as its version of cfx's plugin API, which is no number",
        api=("one",),
    ),
    Broken(
        "policy_nan",
        "policies",
        POLICY.format("answer * float('nan')"),
        r"forward answers NaN or a number outside \[0, 1\]",
    ),
    Broken(
        "policy_out",
        "policies",
        POLICY.format("answer + 1.0"),
        r"forward answers NaN or a number outside \[0, 1\]",
    ),
    Broken(
        "policy_more",
        "policies",
        POLICY.format("torch.cat([answer, answer[..., :1]], -1)"),
        r"forward gives the shape \(3, 2, 7, 6\); it must give"
        r" \(networks, drivers, windows, parameters\), here \(3, 2, 7, 5\)",
    ),
    Broken(
        "policy_float",
        "policies",
        POLICY.format("answer.float()"),
        r"forward gives torch\.float32 for torch\.float64",
    ),
    Broken(
        "policy_none",
        "policies",
        POLICY.replace("return Network(fixed)", "return None"),
        "build returns a NoneType",
    ),
    Broken(
        "miscounts",
        "optimizers",
        _OPTIMIZER.format("return candidates[:, :3], objective(candidates[:, :3])"),
        r"solve must return candidates \(2, 4, 2\) and losses \(2, 4\) as returned\(\) says,"
        r" but returned \(2, 3, 2\)",
    ),
    Broken(
        "floats",
        "optimizers",
        _OPTIMIZER.format("return candidates, objective(candidates).float()"),
        "must return float64",
    ),
    Broken(
        "asks_wide",
        "optimizers",
        _OPTIMIZER.format("return candidates, objective(torch.cat([candidates, candidates], -1))"),
        r"it asked for candidates \(2, 4, 4\) in torch\.float64;"
        r" it must ask for \(2, q, 2\) in float64",
    ),
    Broken(
        "asks_out",
        "optimizers",
        _OPTIMIZER.format("return candidates, objective(candidates + 1.0)"),
        "outside the bounds",
    ),
    Broken(
        "nan_loss",
        "optimizers",
        _OPTIMIZER.format("return candidates, objective(candidates) * float('nan')"),
        "returned NaN or a candidate outside",
    ),
    Broken(
        "uncounted",
        "optimizers",
        _OPTIMIZER.format("return None").replace("return 4", "return 4.5"),
        r"evaluations\(n\) gives 4\.5; it must give a whole number",
    ),
    Broken(
        "no_stepper",
        "simulators",
        _SIMULATOR.format("None"),
        "stepper returns a NoneType and no Stepper",
    ),
    Broken(
        "single_steps",
        "simulators",
        _SIMULATOR.format("Single(model, dt)"),
        r"advance's positions gives torch\.float32 for torch\.float64",
    ),
    Broken(
        "loss_of_all",
        "objectives",
        _OBJECTIVE.format("(sums[0] / count).sum()"),
        r"finish gives the shape \(\); it must give \(\*batch,\), here \(3, 4\)",
    ),
    Broken(
        "negative_loss",
        "objectives",
        _OBJECTIVE.format("-sums[0] / count"),
        "a loss is never negative",
    ),
    Broken(
        "reads_gaps",
        "objectives",
        _OBJECTIVE.format("sums[0] / count").replace("frames.speed", "frames.gap"),
        "calibration computes no other signal than `signals` names",
    ),
    Broken(
        "unfinished",
        "objectives",
        _OBJECTIVE.format("0").replace("def finish", "def end"),
        "does not implement finish",
    ),
    Broken(
        "no_pairs",
        "datasets",
        _DATASET.format("return [pair]"),
        r"read must return a cfx\.plugin\.PairSet, but returned a list",
    ),
    Broken(
        "gaps",
        "datasets",
        _DATASET.format("leader[5] = np.nan; return PairSet((pair,), 'made up')"),
        "pair p has a leader_position that is not finite",
    ),
    Broken(
        "learns_nothing",
        "learners",
        "from cfx.plugin import Learner\n"
        "class Bad(Learner):\n    def fit(self, policy, training_data):\n        return None\n",
        r"fit must return a cfx\.plugin\.TrainingResult, but returned a NoneType",
    ),
    Broken(
        "no_outcome",
        "protocols",
        "from cfx.plugin import Protocol\n"
        "class Bad(Protocol):\n    def run(self, context):\n        return {}\n",
        r"run must return a cfx\.plugin\.ProtocolResult, but returned a dict",
    ),
)


MODEL = """
    from cfx.plugin import DrivingModel, Parameter, ParameterSpace

    class Mine(DrivingModel):
        '''Drives as I like.'''

        parameters = ParameterSpace.of(Parameter("tau", "s", 0.5, 3.0, 1.0, "time gap", "made up"))
        reference = "made up"

        def next_speed(self, follower, leader, p, dt):
            gap = leader.position - leader.length - follower.position
            return (gap / p["tau"]).clamp(min=0.0, max=30.0)
"""


def put(install: Installer, broken: Broken) -> None:
    install(broken.distribution, broken.entry_points, dict(broken.files))


def install_twins(install: Installer) -> None:
    """Installs two distributions that chose the same name, and one that chose krauss."""
    install("twin-one", {"cfx.models": {"twin": "twin_one:Mine"}}, {"twin_one.py": MODEL})
    install(
        "twin-two", {"cfx.models": {"twin": "twin_two:Mine"}}, {"twin_two.py": MODEL}, version="2.0"
    )
    install(
        "usurper", {"cfx.models": {"krauss": "usurper:Mine"}}, {"usurper.py": "raise SystemExit(0)"}
    )

"""The jobs whose results are recorded: one at least for every kind of result that cfx gives.

Each takes seconds, on synthetic data. `{NAME}` in an override is the folder of another job.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import yaml

import cfx

SMALL = (
    "debug=quick",
    "data.pairs=4",
    "data.frames=200",
    "data.max_pairs=null",
    "cores=1",
    "figures=none",
    "tracking.enabled=false",
    "calibration.prior=chosen",
)
_ACROSS = ("data.pairs=6", "protocol=across_drivers", "protocol.folds=2")
_ROLLOUT = (
    "model=idm",
    "learner=rollout",
    "learner.ensemble_size=1",
    "learner.epochs=2",
    "learner.steps=2",
    "learner.horizon=4",
)
_LATER = (*_ACROSS, *_ROLLOUT, "protocol.histories=[]")
_FORECAST = (
    *_LATER,
    "protocol=forecast",
    "protocol.horizons=[0.5,2]",
    "protocol.min_history=3",
)
_TRAFFIC = (
    *_LATER,
    "protocol=traffic",
    "protocol.densities=[30,60]",
    "protocol.vehicles=6",
    "protocol.repetitions=1",
    "protocol.demands=[1200]",
    "protocol.bottleneck=[100,200]",
    "protocol.leader_speeds=[8]",
    "protocol.platoon=4",
    "protocol.duration=40",
    "protocol.settle=10",
)

JOBS: dict[str, tuple[str, ...]] = {
    "imitation": ("simulator.compile=never", "policy.inputs=speeds"),
    "imitation_for_all": (
        "model=w99",
        "policy=lstm",
        "protocol.networks=all",
        "objective=theil_u",
        "style.cluster=normal",
        "data.pairs=8",
    ),
    "imitation_of_offsets": ("learner.head=offset", "model=idm", "objective=mixed"),
    "botorch": (
        "optimizer=botorch",
        "~optimizer.samples",
        "optimizer.iterations=3",
        "model=w74",
        "objective=gap_rmse",
        "policy=fixed",
    ),
    "shade": (
        "optimizer=shade",
        "optimizer.samples=30000",
        "simulator.compile=always",
        "model=idm",
        "policy=fixed",
    ),
    "kernel": ("optimizer.samples=4096", "policy=default"),
    "compiled": ("simulator.compile=always", "policy=default"),
    "rollout": (*_ACROSS, *_ROLLOUT, "optimizer=gradient", "protocol.histories=[0,5]"),
    "rollout_on_two_cores": (
        *_LATER,
        "cores=2",
        "model=krauss",
        "learner.head=residual",
        "learner.ensemble_size=2",
        "objective=speed_huber",
        "calibration.prior=none",
        "protocol.base=pooled",
    ),
    "rollout_distilled": (
        *_LATER,
        "learner.distillation_epochs=1",
        "protocol.history=5",
        "policy.driver_features=all",
    ),
    "direct": (*_LATER, "model=direct", "policy=lstm"),
    "transfer": ("protocol=transfer", "protocol.run={rollout}", "data.seed=9"),
    "forecast": (*_FORECAST, "learner.head=stochastic", "protocol.samples=3"),
    "forecast_recalibrate": (*_FORECAST, "policy=recalibrate"),
    "forecast_particle_filter": (*_FORECAST, "policy=particle_filter"),
    "forecast_ukf": (*_FORECAST, "policy=ukf", "policy.residual=true"),
    "traffic": (*_TRAFFIC, "learner.head=stochastic"),
    "dask": ("engine=dask", "engine.workers=1"),
    "sumo": ("simulator=sumo", "simulator.workers=1", "model=krauss_sumo", "policy=default"),
}
"""Each with what makes it differ from a small job of `debug=quick`."""

SWEEP = ("model=krauss,idm", "objective=speed_rmse,gap_rmse", "learner.epochs=1")
"""The overrides of a multirun, whose jobs are recorded as `sweep/...`."""


def run(name: str, folder: Path) -> Path:
    """Runs a job, and those whose results it needs; returns its folder below `folder`."""
    target = folder / name
    if not (target / "metrics.json").is_file():
        overrides = list(JOBS[name])
        for k, override in enumerate(overrides):
            before, brace, rest = override.partition("{")
            if brace:
                overrides[k] = before + str(run(rest.removesuffix("}"), folder))
        cfx.run([*SMALL, *overrides, *_places(target, "run")])
    return target


def run_sweep(folder: Path) -> dict[str, Path]:
    """Runs the multirun in a process of its own; returns the folder of each of its jobs."""
    target = folder / "sweep"
    command = [sys.executable, "-m", "cfx", "-m", *SMALL, *SWEEP, *_places(target, "sweep")]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    return {f"sweep/{_choices(file.parent)}": file.parent for file in target.glob("*/metrics.json")}


def _choices(folder: Path) -> str:
    config = yaml.safe_load((folder / "config.yaml").read_text())
    return f"{config['model']['name']}-{config['objective']['name']}"


def _places(target: Path, kind: str) -> tuple[str, str]:
    return f"hydra.{kind}.dir={target}", f"cache.folder={target.with_suffix('.cache')}"

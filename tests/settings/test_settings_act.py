"""Each setting changes what a job writes, or is refused: `make settings` (about 20 CPU minutes; `-k JOB` for one job).

`CFX_SETTINGS_EVERY=20` tries every twentieth setting alone.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest

import cfx
from cfx.app.hydra_source import composed, plain
from cfx.errors import CfxError
from tests.golden.jobs import JOBS, SMALL
from tests.settings.leaves import leaves, other_values, results, written

EXCEPTIONS = {
    "preset": "the name of the experiment that set the rest; the command that is printed has it",
    "cores": "results do not depend on how the work is shared, on purpose",
    "threads": "as cores",
    "device": "as cores; another machine has others",
    "cache.*": "results do not depend on what was calculated before, on purpose",
    "output.*": "copies the folder to a URL",
    "tracking.*": "what MLflow keeps; tests of tracking try each",
    "failed_value": "what a multirun's sweeper is told of a job that failed",
    "figures.*": "figures are off here; tests of figures try each",
    "engine.*": "results do not depend on where the work runs, on purpose",
    "*.memory_mb": "how much is worked on at once",
    "*.workers": "how many share the work",
    "simulator.followers": "results do not depend on how many share a network of SUMO, on purpose",
    "krauss_sumo:simulator.seed": "the model draws no random numbers (sigma is 0)",
    "simulator.compile": "results do not depend on how steps are compiled, on purpose",
    "model.limits.comfortable_deceleration": "live drivers alone brake by it, in SUMO",
    "demo": "shows the results, on a page beside them; tests of demonstrations write it",
    "model.parameters.emergencyDecel.default": "no driver here has to brake so hard",
    "data.check": "recordings that contradict themselves are refused; these do not",
    "data.min_duration": "all of these pairs are longer",
    "data.inputs": "inputs of plugins alone read further signals; tests of surroundings read them",
    "data.site": "a name",
    "data.vehicle": "a name",
    "protocol.run": "another job's folder",
    "learner.start": "another job's folder",
    "learner.patience": "ends trainings that get worse; tests of both learners try it",
    "idm:learner.temperature*": "its regimes do not switch; tests of the rollout learner try it",
    "krauss:learner.temperature*": "as idm",
    "direct:learner.temperature*": "as idm",
    "w99:model.parameters.b.default": "SUMO's decel: exports write it, and it acts above b_max",
    "style.cluster": "each choice of drivers is another job: tests of style try each",
}
"""Settings that may change nothing here, with the reason."""

VALUES: dict[str, list[Any]] = {
    "data.time_step": [0.2],
    "data.lanes": [[99]],
    "data.recording": ["nobody"],
    "data.driver_type": ["nobody"],
    "data.leader_driver_type": ["nobody"],
    "data.pair_ids": [["nobody"]],
    "model.adaptation_bounds": [{"T": None}, {"t_r": None}, {"cc1": None}, {"a": None}],
    "policy.inputs": ["situation", "speeds"],
    "policy.driver_features": ["all"],
    "policy.optimizer.name": ["random"],
    "policy.objective.name": ["gap_rmse"],
    "learner.drivers": [2],
    "learner.gradient_clip": [1e-4],
    "learner.head": ["offset", "residual"],
    "protocol.histories": [[5]],
    "protocol.min_test_duration": [4.1, 20.1],
    "protocol.noise": [[5.0, 0.2]],
    "metrics": [["rmse_speed", "rmse_gap", "collisions"]],
}
"""Values where a type alone does not say which ones make sense."""

EVERY = int(os.environ.get("CFX_SETTINGS_EVERY", "1"))

NEEDS_ANOTHER_JOB = {"transfer"}
"""Jobs whose protocol reads the folder of another one."""


def _configurations() -> Iterator[tuple[str, dict[str, Any]]]:
    for job, overrides in JOBS.items():
        if job not in NEEDS_ANOTHER_JOB:
            yield job, plain(composed([*SMALL, *overrides]))


WITH = {"model.variant": "model.limits=null"}
"""What else is set where a setting acts with that alone."""


def _is_exception(key: str, config: Mapping[str, Any]) -> bool:
    """Says whether a setting may change nothing; `idm:KEY` excepts it with one model alone.

    Bounds of a parameter that is not tuned may: its default alone must lie within them.
    """
    if key.startswith("model.parameters.") and key.endswith((".low", ".high")):
        parameter = config["model"]["parameters"][key.split(".")[2]]
        if not parameter["tuned"]:
            return True
    with_model = f"{config['model']['name']}:{key}"
    return any(fnmatch(key, one) or fnmatch(with_model, one) for one in EXCEPTIONS)


def cases() -> dict[tuple[str, str], tuple[str, Any, Mapping[str, Any]]]:
    """Returns each setting once for each option that has it: by option and key, a job that does."""
    found: dict[tuple[str, str], tuple[str, Any, Mapping[str, Any]]] = {}
    for job, config in _configurations():
        for key, value in leaves(config):
            node = config.get(key.partition(".")[0])
            option = str(node.get("name", "")) if isinstance(node, Mapping) else ""
            if not _is_exception(key, config):
                found.setdefault((option, key), (job, value, config))
    return found


class Jobs:
    """Runs jobs, each plain one once, alone or with another override."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.count = 0
        self._plain: dict[str, dict[str, bytes]] = {}

    def plain(self, job: str, *more: str) -> dict[str, bytes]:
        name = " ".join([job, *more])
        if name not in self._plain:
            self._plain[name] = self.run(job, *more)
        return self._plain[name]

    def run(self, job: str, *more: str) -> dict[str, bytes]:
        self.count += 1
        target = self.folder / str(self.count)
        places = (f"hydra.run.dir={target}", f"cache.folder={self.folder / 'cache'}")
        with contextlib.redirect_stdout(io.StringIO()):
            cfx.run([*SMALL, *JOBS[job], *places, *more])
        return results(target)


ACTS, REFUSED = "acts", "refused"


def outcome(jobs: Jobs, job: str, key: str, values: list[Any]) -> str:
    """Returns that a setting changes a job or is refused by name, or else what is wrong with it."""
    said = []
    more = [WITH[key]] if key in WITH else []
    for value in values:
        override = f"{key}={written(value)}"
        try:
            if jobs.run(job, *more, override) != jobs.plain(job, *more):
                return ACTS
            said.append(f"{override} changes nothing")
        except CfxError as error:
            if key.rpartition(".")[2] in str(error):
                return REFUSED
            said.append(f"{override}: {error}")
    return f"{key} ({job}): {'; '.join(said) or 'no other value is known'}"


@pytest.fixture(scope="module")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> Jobs:
    return Jobs(tmp_path_factory.mktemp("settings"))


@pytest.mark.slow
@pytest.mark.timeout(0)
@pytest.mark.parametrize("job", [name for name in JOBS if name not in NEEDS_ANOTHER_JOB])
def test_every_setting_acts_or_is_refused(
    jobs: Jobs, job: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(jobs.folder)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    found = [
        (key, value, config)
        for (_, key), (doer, value, config) in list(cases().items())[::EVERY]
        if doer == job
    ]
    outcomes = []
    for number, (key, value, config) in enumerate(found, start=1):
        values = VALUES.get(key) or other_values(key, value, config)
        outcomes.append(outcome(jobs, job, key, values))
        print(f"{job}, {number} of {len(found)}: {key}: {outcomes[-1]}", flush=True)
    print(
        f"{job}: {outcomes.count(ACTS)} act, {outcomes.count(REFUSED)} are refused, of {len(found)}"
    )
    complaints = [said for said in outcomes if said not in {ACTS, REFUSED}]
    assert not complaints, f"{len(complaints)} of {len(found)} settings:\n" + "\n".join(complaints)


@pytest.mark.slow
def test_each_exception_is_a_setting() -> None:
    keys = set()
    for _, config in _configurations():
        for key, _ in leaves(config):
            keys |= {key, f"{config['model']['name']}:{key}"}
    for pattern in EXCEPTIONS:
        if pattern != "protocol.run":  # of the job that is left out
            assert any(fnmatch(key, pattern) for key in keys), pattern

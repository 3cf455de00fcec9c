"""Sweeps: started again they run what is missing, harm nothing, and say what came of it all."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from hydra.core.plugins import Plugins

from cfx.app import application, hydra_source
from cfx.app.sweep import SweepFolder
from cfx.app.sweep.folder import RECORD, STATUS, fingerprint, only_one
from cfx.app.sweep.summary import SUMMARY
from cfx.results import provenance

JOB = """
    import json, os, time
    from dataclasses import dataclass
    from pathlib import Path
    from cfx.errors import DataError
    from cfx.evaluation.metrics.base import RMSE_SPEED

    @dataclass
    class Result:
        metrics: dict
        judge = RMSE_SPEED

    def run_job(config, folder):
        with Path("ran").open("a") as file:
            file.write(f"{config.seed}\\n")
        if Path(f"fail-{config.seed}").exists():
            raise DataError(f"drive {config.seed} is broken")
        if Path(f"interrupt-{config.seed}").exists():
            raise KeyboardInterrupt
        if Path(f"muddle-{config.seed}").exists():
            try:
                raise KeyboardInterrupt
            finally:
                raise AttributeError("a library that was tidying up")
        while Path(f"wait-{config.seed}").exists():
            Path(f"waits-{config.seed}").touch()
            time.sleep(0.02)
        metrics = {f"rmse_speed/{method}": value + config.seed for method, value in
                   (("default", 1.0), ("driver_specific", 0.5), ("policy", 0.25))}
        metrics |= {"improvement/rmse_speed/driver_specific/geometric": 0.5, "improvement/rmse_speed/driver_specific/ci95_low": 0.25,
                    "improvement/rmse_speed/driver_specific/ci95_high": None}
        if config.model["name"] == "w99":
            for name in ("mean", "ci95_low", "ci95_high"):
                metrics[f"improvement/rmse_speed/pooled/{name}"] = 0.125
        (folder / "metrics.json").write_text(json.dumps(metrics))
        (folder / "told").write_text(f"{config.tracking.sweep} {os.environ.get('OMP_NUM_THREADS')}")
        return Result(metrics)
"""

Run = Callable[..., int]

JOBS = 6
LAUNCHERS = {
    "basic": [],
    "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
    "submitit": ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=5"],
    "dask": ["hydra/launcher=dask", "hydra.launcher.workers=2"],
}
"""Each with what makes it run two jobs at once; submitit's local executor starts all of them."""


@pytest.fixture
def run(install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Returns the application with a job that does what files in the current, empty folder say."""
    install("sweep-stub", {}, {"sweep_stub.py": JOB})
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return lambda *arguments: application.start(
        arguments, run_job=import_module("sweep_stub").run_job
    )


def ran() -> list[str]:
    """Returns the seeds of the jobs that ran since the last call, in order."""
    path = Path("ran")
    seeds = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return seeds


def sweeps() -> list[Path]:
    return sorted(path.parent for path in Path().rglob(RECORD))


def jobs(folder: Path) -> list[Path]:
    found = []
    for path in folder.iterdir():
        if path.is_dir() and not path.name.startswith("."):  # submitit keeps its logs there
            found.append(path)
    return sorted(found)


def summary(folder: Path) -> list[dict[str, str]]:
    with (folder / SUMMARY).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("how", [pytest.param("interrupt", marks=pytest.mark.slow), "muddle"])
def test_an_interrupted_sweep_goes_on_whatever_the_order_of_its_overrides(
    run: Run, how: str, capsys
) -> None:
    Path(f"{how}-1").touch()
    assert run("-m", "seed=0,1,2", "model=w99") == 130
    assert ran() == ["0", "1"]
    printed = capsys.readouterr()
    assert "1 of 3 jobs done" in printed.out
    assert "The same command again" in printed.out
    assert "Traceback" not in printed.err
    Path(f"{how}-1").unlink()
    assert run("-m", "model=w99", "seed=2,1,0") == 0
    assert ran() == ["2", "1"]
    (folder,) = sweeps()
    printed = capsys.readouterr()
    assert f"continuing sweep {folder}: 1 of 3 jobs are done\n" in printed.out
    assert "3 of 3 jobs done" in printed.out
    assert len(jobs(folder)) == 3
    assert [(row["seed"], row["state"]) for row in summary(folder)] == [
        ("2", "done"),
        ("1", "done"),
        ("0", "done before"),
    ]
    assert run("-m", "seed=0,1,2", "model=w99") == 0  # that one is complete: a fresh one
    assert len(ran()) == 3
    assert len(sweeps()) == 2


def test_after_failures_only_the_failed_jobs_run_again_also_with_another_launcher(
    run: Run, capsys
) -> None:
    Path("fail-1").touch()
    assert run("-m", "seed=1,2") == 2
    assert "failed: seed=1: drive 1 is broken" in capsys.readouterr().err
    assert ran() == ["1", "2"]
    assert run("-m", "seed=1,2", "hydra.verbose=false") == 2
    assert ran() == ["1"]
    Path("fail-1").unlink()
    assert run("-m", "seed=1,2") == 0
    assert ran() == ["1"]
    assert len(sweeps()) == 1


def test_other_commands_have_folders_of_their_own(run: Run) -> None:
    for seed in (0, 1):
        Path(f"fail-{seed}").touch()
    for command in (["seed=0,1"], ["seed=0,1", "split=0.7"], ["seed=0"]):
        assert run("-m", *command) == 2
    assert len(sweeps()) == 3


@pytest.mark.slow
def test_a_sweep_that_an_experiment_file_asks_for_goes_on_too(run: Run) -> None:
    Path("mine/experiment").mkdir(parents=True)
    Path("mine/experiment/seeds.yaml").write_text(
        "# @package _global_\n"
        "hydra:\n  mode: MULTIRUN\n  sweeper:\n    params:\n      seed: 0,1,2\n"
    )
    Path("interrupt-1").touch()
    command = ["--config-dir", "mine", "experiment=seeds"]
    assert run(*command) == 130
    assert ran() == ["0", "1"]
    Path("interrupt-1").unlink()
    assert run(*command) == 0
    assert ran() == ["1", "2"]
    (folder,) = sweeps()
    assert [row["state"] for row in summary(folder)] == ["done before", "done", "done"]


def test_a_folder_that_was_asked_for_is_continued_even_if_complete(
    run: Run, tmp_path: Path, capsys
) -> None:
    assert run("-m", "seed=0,1", "hydra.sweep.dir=it's mine") == 2  # not Hydra's grammar
    assert run("-m", "seed=0,1", "hydra.sweep.dir='my sweep'") == 0
    assert ran() == ["0", "1"]
    assert run("-m", "seed=0,1", f"hydra.sweep.dir='{tmp_path}/my sweep'") == 0
    assert ran() == []
    capsys.readouterr()
    assert (
        run("-m", "seed=1,2", "hydra.sweep.dir='my sweep'") == 0
    )  # another command shares a job with it
    assert ran() == ["2"]
    assert "2 of 2 jobs done" in capsys.readouterr().out
    told = {
        (folder / "told").read_text().split(" None")[0].split(" 1")[0]
        for folder in jobs(tmp_path / "my sweep")
    }
    assert told == {"my sweep"}  # one name in MLflow, however the folder was written


def test_a_job_runs_again_if_its_data_changed_or_its_status_is_broken(run: Run) -> None:
    for name in ("a.csv", "b.csv"):
        Path(name).write_text("a")
    command = ["-m", "seed=0", "data=tidy", "data.path=[a.csv,b.csv]", "hydra.sweep.dir=s"]

    def runs() -> int:
        assert run(*command) == 0
        return len(ran())

    assert runs() == 1
    assert runs() == 0
    Path("b.csv").write_text("ab")
    assert runs() == 1
    (jobs(Path("s"))[0] / STATUS).write_text('{"code": 0')
    assert runs() == 1
    assert len(jobs(Path("s"))) == 1


def test_its_fingerprint_is_of_all_that_its_results_depend_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.csv", "b.csv"):
        Path(name).write_text("a")
    job = ["data=tidy", "data.path=*.csv", "data.min_duration=${oc.env:CFX_FRAMES}"]
    found = []
    for frames in ("100", "200"):
        monkeypatch.setenv("CFX_FRAMES", frames)
        values = hydra_source.plain(hydra_source.composed(job))
        found.append(fingerprint(values))
    assert fingerprint(values) == found[-1]
    Path("b.csv").write_text("ab")
    found.append(fingerprint(values))
    os.utime("a.csv", ns=(1, 1))
    found.append(fingerprint(values))
    monkeypatch.setattr(provenance, "version", lambda: "99.0")
    found.append(fingerprint(values))
    monkeypatch.setattr(provenance, "distributions", lambda values: {"cfx-community": "0.3"})
    found.append(fingerprint(values))
    assert len(set(found)) == 6


def test_a_sweep_that_runs_is_left_alone(run: Run, capsys) -> None:
    Path("fail-1").touch()
    assert run("-m", "seed=0,1") == 2
    assert run("-m", "seed=0,1", "hydra.sweep.dir=s") == 2
    ran()
    first = next(path for path in sweeps() if path != Path("s"))
    capsys.readouterr()
    with FileLock(first / ".lock"), FileLock("s/.lock"):
        assert run("-m", "seed=0,1", "hydra.sweep.dir=s") == 2
        assert (
            capsys.readouterr().err == "s: another sweep runs in this folder;"
            " wait for it, or choose another hydra.sweep.dir\n"
        )
        assert ran() == []
        assert run("-m", "seed=0,1") == 2
        assert ran() == ["0", "1"]
        assert len(sweeps()) == 3
    assert len(jobs(first)) == 2


def test_folders_that_are_named_by_number_are_never_overwritten(run: Run, capsys) -> None:
    command = ["hydra.sweep.dir=s", "hydra.sweep.subdir=${hydra:job.num}"]
    assert run("-m", "seed=0,1", *command) == 0
    before = [(folder / "metrics.json").read_text() for folder in jobs(Path("s"))]
    capsys.readouterr()
    assert run("-m", "seed=1,0", *command) == 2
    assert (
        "jobs of another order would overwrite; end it with -${cfx_job:}" in capsys.readouterr().err
    )
    assert [(folder / "metrics.json").read_text() for folder in jobs(Path("s"))] == before


def test_the_same_job_twice_in_a_sweep_runs_once(run: Run) -> None:
    assert run("-m", "seed=0,0") == 0
    assert ran() == ["0"]


def test_a_job_that_a_process_of_a_killed_sweep_still_runs_is_waited_for(tmp_path: Path) -> None:
    order: list[str] = []
    held = threading.Event()

    def other() -> None:
        with FileLock(tmp_path / ".lock"):
            held.set()
            time.sleep(0.3)
            order.append("other")

    thread = threading.Thread(target=other)
    thread.start()
    held.wait()
    with only_one(tmp_path):
        order.append("mine")
    thread.join()
    assert order == ["other", "mine"]


def test_a_sweep_keeps_no_configuration_of_its_jobs(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two hundred jobs they would take a hundred megabytes."""
    at_end, kept = SweepFolder.on_job_end, []

    def noted(self: SweepFolder, config: Any, job_return: Any, **options: Any) -> None:
        assert job_return.cfg is not None
        at_end(self, config, job_return, **options)
        kept.append(job_return)

    monkeypatch.setattr(SweepFolder, "on_job_end", noted)
    assert run("-m", "seed=1,2") == 0
    assert [one.hydra_cfg for one in kept] == [None, None]
    assert [one.cfg for one in kept] == [None, None]
    assert all(isinstance(one.return_value, float) for one in kept)


def test_the_summary_compares_jobs_by_what_differs(run: Run, capsys) -> None:
    Path("fail-2").touch()
    assert run("-m", "seed=0,2", "model=krauss,w99", "split=0.7") == 2
    (folder,) = sweeps()
    table = summary(folder)
    assert [(row["seed"], row["model"], row["state"]) for row in table] == [
        ("0", "krauss", "done"),
        ("0", "w99", "done"),
        ("2", "krauss", "failed"),
        ("2", "w99", "failed"),
    ]
    assert "split" not in table[0]
    assert [row["improvement_over"] for row in table] == [
        "driver_specific",
        "driver_specific",
        "",
        "",
    ]
    assert [row["improvement_geometric"] for row in table] == ["0.5", "0.5", "", ""]
    assert "improvement_ci95_high" not in table[0], "no job has it"
    assert [row["method"] for row in table] == ["policy", "policy", "", ""]
    assert [row["error_rmse_speed"] for row in table] == ["0.25", "0.25", "", ""]
    assert table[2]["message"] == "drive 2 is broken"
    assert {row["folder"] for row in table} == {path.name for path in jobs(folder)}
    printed = capsys.readouterr().out
    assert "over driver-specific" in printed
    assert "+50.0 %" in printed
    assert f"python -m cfx report {folder}" in printed


def test_a_wrong_command_line_leaves_no_folder(run: Run, tmp_path: Path) -> None:
    assert run("-m", "model=krauss,nope") == 2
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    "arguments",
    [["--cfg", "job"], ["--cfg", "all", "-p", "hydra.sweep"], ["--help"], ["--info", "searchpath"]],
    ids=" ".join,
)
def test_looking_makes_no_folder(run: Run, arguments: list[str], tmp_path: Path) -> None:
    assert run(*arguments) == 0
    assert not list(tmp_path.iterdir())


# ---- processes that are killed


def started(command: list[str], install_folder: Path, **environment: str) -> subprocess.Popen[str]:
    kept = {
        key: value
        for key, value in os.environ.items()
        if not key.endswith(("_NUM_THREADS", "TRACKING_URI"))
    }
    return subprocess.Popen(
        [sys.executable, *command],
        env={**kept, "PYTHONPATH": str(install_folder), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[str]]]:
    """Takes the processes that a test starts, and kills their groups when it ends."""
    found: list[subprocess.Popen[str]] = []
    yield found
    for process in found:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_every_launcher_ends_what_was_broken_off(
    launcher: str, install: Any, run: Run, processes: list[Any]
) -> None:
    script = (
        "import sys; from cfx.app.application import start; from sweep_stub import run_job;"
        " sys.exit(start(sys.argv[1:], run_job=run_job))"
    )
    command = ["-c", script, "-m", f"seed=range({JOBS})", *LAUNCHERS[launcher]]
    wait = Path(f"wait-{JOBS - 2}")
    wait.touch()
    first = started(command, install.folder)
    processes.append(first)
    while not Path(f"waits-{JOBS - 2}").exists():
        assert first.poll() is None, first.communicate()
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    # Workers in sessions of their own, as of submitit, may still run that job.
    wait.unlink()
    second = started(command, install.folder)
    processes.append(second)
    out, _ = second.communicate(timeout=250)
    assert second.returncode == 0, out
    assert f"{JOBS} of {JOBS} jobs done" in out
    (folder,) = sweeps()
    assert len(jobs(folder)) == len(list(folder.glob("*/metrics.json"))) == JOBS
    counts = Counter(ran())
    assert set(counts) == {str(seed) for seed in range(JOBS)}
    # What was at work when the sweep was killed is the only thing that ran twice.
    assert counts.total() <= JOBS + 2


@pytest.mark.parametrize(
    "killed", ["everything", pytest.param("the main process", marks=pytest.mark.slow)]
)
def test_a_killed_sweep_of_worker_processes_is_made_up_for(
    run: Run, install, processes: list[Any], killed: str
) -> None:
    script = (
        "import sys; from cfx.app.application import start; from sweep_stub import run_job;"
        " sys.exit(start(sys.argv[1:], run_job=run_job))"
    )
    command = [
        "-c",
        script,
        "-m",
        "seed=0,1,2,3,4",
        "hydra/launcher=joblib",
        "hydra.launcher.n_jobs=2",
    ]
    for seed in (1, 3):
        Path(f"wait-{seed}").touch()
    first = started(command, install.folder)
    processes.append(first)
    while not (Path("waits-1").exists() and Path("waits-3").exists()):
        assert first.poll() is None, first.communicate()
        time.sleep(0.02)
    (os.killpg if killed == "everything" else os.kill)(first.pid, signal.SIGKILL)
    first.wait()
    for seed in (1, 3):
        Path(f"wait-{seed}").unlink()
    first.communicate(
        timeout=60
    )  # the workers of a main process that is gone end their jobs, and then themselves
    assert sorted(ran()) == ["0", "1", "2", "3"]
    second = started(command, install.folder)
    processes.append(second)
    out, _ = second.communicate(timeout=200)
    assert second.returncode == 0, out
    assert f"{2 if killed == 'everything' else 4} of 5 jobs are done" in out
    assert sorted(ran()) == (["1", "3", "4"] if killed == "everything" else ["4"])
    (folder,) = sweeps()
    assert len(jobs(folder)) == len(list(folder.glob("*/metrics.json"))) == 5
    # Together the workers have no more threads than there are cores.
    threads = {int((job / "told").read_text().split()[-1]) for job in jobs(folder)}
    assert all(2 * count <= max(2, os.cpu_count() or 1) for count in threads)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # inside MLflow
@pytest.mark.filterwarnings("ignore::UserWarning")  # inside MLflow, at its import
@pytest.mark.parametrize("launcher", ["basic", "joblib"])
def test_twelve_jobs_killed_half_way_end_as_twelve(
    launcher: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processes: list[Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    command = [
        "-m",
        "cfx",
        "-m",
        "debug=quick",
        "data.pairs=3",
        "data.frames=200",
        "data.max_pairs=null",
        "figures=none",
    ]
    command += ["seed=0,1,2", "policy=gru,fixed", "model=krauss,w99", f"hydra/launcher={launcher}"]
    first = started(command, tmp_path, OMP_NUM_THREADS="1")
    processes.append(first)
    while len(list(Path().glob("outputs/*/*-multirun/*/outcome.json"))) < 6:
        assert first.poll() is None, first.communicate()
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    (folder,) = sweeps()
    finished = {
        job.name: (job / "metrics.json").stat().st_mtime_ns
        for job in jobs(folder)
        if (job / STATUS).exists()
    }
    assert 6 <= len(finished) < 12

    assert continued(command, tmp_path, processes) == 0
    assert sweeps() == [folder]
    assert len(jobs(folder)) == 12
    assert all(
        (folder / name / "metrics.json").stat().st_mtime_ns == written
        for name, written in finished.items()
    )
    assert len(summary(folder)) == 12
    assert statuses(folder) == ["FINISHED"] * 12

    # A job whose marker was lost after its run was closed runs again, and is there only once.
    (jobs(folder)[0] / STATUS).unlink()
    assert continued([*command, f"hydra.sweep.dir={folder}"], tmp_path, processes) == 0
    assert statuses(folder) == ["FINISHED"] * 12


def continued(command: list[str], folder: Path, processes: list[Any]) -> int:
    process = started(command, folder, OMP_NUM_THREADS="1")
    processes.append(process)
    out, _ = process.communicate(timeout=400)
    assert "continuing sweep" in out, out
    return int(process.returncode)


def statuses(folder: Path) -> list[str]:
    """Returns how the runs of a sweep ended; fails if any is open or two are of one job."""
    import mlflow

    client = mlflow.MlflowClient(f"sqlite:///{Path('outputs/mlflow.db').absolute()}")
    experiment = client.get_experiment_by_name("cfx-debug")
    assert experiment is not None
    runs = client.search_runs([experiment.experiment_id], max_results=1000)
    assert "RUNNING" not in {one.info.status for one in runs}
    (parent,) = [one for one in runs if "cfx.sweep_parent" in one.data.tags]
    assert parent.data.tags["cfx.sweep_parent"] == str(folder)
    children = [one for one in runs if one.data.tags.get("cfx.sweep") == str(folder)]
    assert {one.data.tags["mlflow.parentRunId"] for one in children} == {parent.info.run_id}
    assert {Path(one.data.tags["cfx.folder"]).name for one in children} == {
        job.name for job in jobs(folder)
    }
    assert json.loads((folder / RECORD).read_text())["completed"]
    return [one.info.status for one in children]


SEARCH = """
    from hydra.core.plugins import Plugins
    from hydra.plugins.sweeper import Sweeper
    from cfx.errors import CfxError

    class Search(Sweeper):
        told = []

        def __init__(self, **_):
            pass

        def setup(self, **given):
            self.launcher = Plugins.instance().instantiate_launcher(**given)

        def sweep(self, arguments):
            jobs = [(*arguments, f"seed={seed}") for seed in range(3)]
            for returned in self.launcher.launch(jobs, initial_job_idx=0):
                try:
                    self.told.append(returned.return_value)
                except CfxError as error:
                    self.told.append(str(error))
"""
"""Runs jobs of three seeds, and keeps what each tells: an error, as sweepers that optimise do."""


@pytest.mark.parametrize(
    ("given", "told"),
    [([], "job 1 failed: drive 1 is broken"), (["failed_value=inf"], float("inf"))],
)
def test_a_sweeper_that_optimises_is_told_of_a_failed_job(
    run: Run, install, given: list[str], told: float | str
) -> None:
    install("search-stub", {}, {"hydra_plugins/search_stub.py": SEARCH})
    search = import_module("hydra_plugins.search_stub").Search
    Plugins.instance().register(search)
    Path("fail-1").touch()
    sweeper = "hydra.sweeper._target_=hydra_plugins.search_stub.Search"
    assert run("-m", sweeper, *given) == 2, "the summary counts the failed job"
    assert search.told == [0.25, told, 2.25]


def test_a_failed_value_is_a_number(run: Run, capsys) -> None:
    assert run("failed_value=nan") == 2
    assert "failed_value" in capsys.readouterr().err

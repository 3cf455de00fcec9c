"""Runs the jobs whose numbers documents state, and writes these numbers into `results.json`.

    python docs/measure.py --data FOLDER [KEY ...]

Each job of `JOBS` runs in `outputs/results/KEY`; without KEY those that `results.json` lacks, or
has with another command. Numbers are those of the job's `metrics.json`: nothing is computed here.
`make results` runs this, then `tables.py`, which writes the numbers into the documents.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import yaml

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results.json"
FOLDER = Path("outputs") / "results"
"""Where jobs run, below the checkout: commands that go on from a finished job name it."""

RECONSTRUCTED = "data=tidy data.path=i80_reconstructed_pairs.parquet"
LONG = "data.min_duration=30 protocol.min_test_duration=70"
"""Recordings of 30 s or more are learned from, those of 70 s or more are tested."""

I80 = f"{RECONSTRUCTED} {LONG}"
ONE = "learner.ensemble_size=1"
"""One network in place of four: what reads a history takes longest."""

PAPER = "experiment=paper/pairs hydra.mode=RUN"
CALIBRATION = f"policy=fixed protocol=within_driver {RECONSTRUCTED} data.min_duration=70"
FORECAST = f"model=idm protocol=forecast protocol.histories=[] {RECONSTRUCTED} data.min_duration=70"
KEPT_BACK = f"{RECONSTRUCTED} data.recording=i80-0400 data.min_duration=70"
TRANSFER = f"protocol=transfer protocol.run={FOLDER}/history-krauss-0500"


class Job(NamedTuple):
    """A job: what a table calls it, and what follows `python -m cfx`."""

    what: str
    words: str
    is_shown: bool = False
    """Whether a document shows what it prints."""


JOBS = {
    "main": Job("IDM", "", is_shown=True),
    "main-1": Job("IDM", "seed=1"),
    "main-2": Job("IDM", "seed=2"),
    "paper-krauss": Job("Krauss, the paper's training", f"{PAPER} model=krauss {RECONSTRUCTED}"),
    "paper-w99": Job("Wiedemann 99, the paper's training", f"{PAPER} model=w99 {RECONSTRUCTED}"),
    "adaptive-krauss": Job(
        "Krauss, with history (`adaptive`)",
        "experiment=adaptive hydra.mode=RUN model=krauss learner=rollout"
        f" {RECONSTRUCTED} data.min_duration=70",
    ),
    "history-krauss": Job("Krauss, with history", f"experiment=with_history {ONE} {I80}"),
    "history-krauss-offset": Job(
        "Krauss, `learner.head=offset`", f"experiment=with_history learner.head=offset {ONE} {I80}"
    ),
    "history-krauss-motion": Job(
        "Krauss, `policy.inputs=motion`",
        f"experiment=with_history policy.inputs=motion {ONE} {I80}",
    ),
    "conditioned-idm": Job("IDM, with history", f"experiment=conditioned model=idm {ONE} {I80}"),
    "conditioned-idm-offset": Job(
        "IDM, `learner.head=offset`",
        f"experiment=conditioned model=idm learner.head=offset {ONE} {I80}",
    ),
    "conditioned-idm-motion": Job(
        "IDM, `policy.inputs=motion`",
        f"experiment=conditioned model=idm policy.inputs=motion {ONE} {I80}",
    ),
    "conditioned-idm-plain": Job(
        "IDM, `policy.driver_features=[]`",
        f"experiment=conditioned model=idm policy.driver_features=[] {ONE} {I80}",
    ),
    "conditioned-w99": Job("Wiedemann 99, with history", f"experiment=conditioned {ONE} {I80}"),
    "unseen-krauss": Job("Krauss, unseen drivers", f"experiment=unseen_drivers {I80}"),
    "unseen-krauss-smooth": Job(
        "Krauss, unseen drivers, smooth", f"experiment=unseen_drivers_smooth {I80}"
    ),
    "unseen-w99": Job(
        "Wiedemann 99, unseen drivers",
        f"experiment=unseen_drivers model=w99_wide learner=rollout_distilled {I80}",
    ),
    "unseen-idm": Job("IDM, unseen drivers", f"experiment=unseen_drivers model=idm {I80}"),
    "history-krauss-0500": Job(
        "Krauss, with history, 5:00 pm",
        f"experiment=with_history {ONE} {RECONSTRUCTED} data.recording=i80-0500 {LONG}",
    ),
    "transfer-0400": Job(
        "at 4:00 pm, reconstructed",
        f"{TRANSFER} {KEPT_BACK}",
    ),
    "transfer-0400-raw": Job(
        "at 4:00 pm, raw",
        f"{TRANSFER} data=ngsim data.path=i80_0400_raw_sample.csv.gz data.trim=3"
        " data.min_duration=30",
    ),
    "calibrate-krauss-weak": Job("Krauss", f"model=krauss calibration.prior=weak {CALIBRATION}"),
    "calibrate-krauss": Job("Krauss", f"model=krauss {CALIBRATION}"),
    "calibrate-idm-weak": Job("IDM", f"model=idm calibration.prior=weak {CALIBRATION}"),
    "calibrate-idm": Job("IDM", f"model=idm {CALIBRATION}"),
    "calibrate-gipps-weak": Job("Gipps", f"model=gipps calibration.prior=weak {CALIBRATION}"),
    "calibrate-gipps": Job("Gipps", f"model=gipps {CALIBRATION}"),
    "calibrate-w99-weak": Job("Wiedemann 99", f"model=w99 calibration.prior=weak {CALIBRATION}"),
    "calibrate-w99": Job("Wiedemann 99", f"model=w99 {CALIBRATION}"),
    "forecast-recalibrate": Job("recalibrated", f"policy=recalibrate {FORECAST}"),
    "forecast-recalibrate-residual": Job(
        "recalibrated + residual", f"policy=recalibrate policy.residual=true {FORECAST}"
    ),
    "forecast-recalibrate-no-prior": Job(
        "`policy.prior=0`", f"policy=recalibrate policy.prior=0 {FORECAST}"
    ),
    "forecast-recalibrate-long": Job(
        "`policy.window_s=100 policy.prior=0.1`",
        f"policy=recalibrate policy.window_s=100 policy.prior=0.1 {FORECAST}",
    ),
    "forecast-ukf": Job("UKF", f"policy=ukf {FORECAST}"),
    "forecast-ukf-residual": Job("UKF + residual", f"policy=ukf policy.residual=true {FORECAST}"),
    "forecast-ukf-low-noise": Job("`policy.noise=0.5`", f"policy=ukf policy.noise=0.5 {FORECAST}"),
    "forecast-ukf-fast-drift": Job(
        "`policy.drift=0.05 policy.noise=4`",
        f"policy=ukf policy.drift=0.05 policy.noise=4 {FORECAST}",
    ),
    "forecast-particles": Job("particle filter", f"policy=particle_filter {FORECAST}"),
    "forecast-particles-residual": Job(
        "particle filter + residual", f"policy=particle_filter policy.residual=true {FORECAST}"
    ),
    "forecast-constant-acceleration": Job(
        "constant acceleration",
        f"policy=ukf policy.residual=true {FORECAST} protocol.leader=constant_acceleration",
    ),
    "forecast-constant-speed": Job(
        "constant speed",
        f"policy=ukf policy.residual=true {FORECAST} protocol.leader=constant_speed",
    ),
    "stochastic-idm": Job("IDM", f"experiment=stochastic model=idm learner.drivers=32 {I80}"),
    "stochastic-krauss": Job(
        "Krauss", f"experiment=stochastic model=krauss learner.drivers=32 {I80}"
    ),
    "stochastic-idm-0500": Job(
        "IDM, 5:00 pm",
        "experiment=stochastic model=idm learner.drivers=32"
        f" {RECONSTRUCTED} data.recording=i80-0500 {LONG}",
    ),
    "forecast-0400": Job(
        "IDM at 4:00 pm, learned at 5:00 pm",
        f"protocol=forecast protocol.run={FOLDER}/stochastic-idm-0500 protocol.samples=50"
        f" {KEPT_BACK}",
    ),
}
"""By key. Files are in the folder of recordings."""

FIGURES = {
    "trajectories.png": ("unseen-idm", "drives"),
    "improvement.png": ("unseen-idm", "improvement_per_driver"),
    "transient.png": ("unseen-idm", "error_over_time"),
    "history.png": ("history-krauss", "history"),
    "conditioned.png": ("conditioned-idm", "history"),
    "forecasts.png": ("forecast-ukf-residual", "forecasts"),
    "distributions.png": ("stochastic-idm", "distributions"),
}
"""Images in `docs/`: of which job, and which of its figures."""

KEPT = re.compile(
    r"(steady/|full_trajectory/)?"
    r"((rmse_speed|rmse_gap|collisions|hard_braking|jerk)/\w+"
    r"|improvement/\w+/\w+/(geometric|ci95_low|ci95_high|ratio_of_means|mean_ratio|drivers))"
    r"|(forecast/(rmse_speed|rmse_position)|distribution/(crps_speed|coverage))_[\d.]+s/\w+"
    r"|calibration/speed_rmse/\w+"
    r"|platoon/(head_to_tail|string_stable)/\w+"
)
"""The metrics of a job that documents may state."""

PRINTED = re.compile(
    r"^\d+ pairs of \d+ drivers, .*^In short: [^\n]*", flags=re.DOTALL | re.MULTILINE
)
"""What a job prints of its results, without its folder."""


def main() -> None:
    """Runs the jobs that were named, or those that `results.json` lacks, and writes them there."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("keys", nargs="*", metavar="KEY", help=f"of {', '.join(JOBS)}")
    parser.add_argument("--data", type=Path, required=True, help="the folder with the recordings")
    options = parser.parse_args()
    unknown = set(options.keys) - set(JOBS)
    if unknown:
        parser.error(f"no such job: {', '.join(sorted(unknown))}; known are {', '.join(JOBS)}")
    write(known())
    for key in options.keys or [key for key in JOBS if key not in known()]:
        measured = run(key, options.data.absolute())
        write({**known(), key: entry(JOBS[key], ROOT / FOLDER / key, measured)})
        draw(key)


def known() -> dict[str, Any]:
    """Returns the jobs of `results.json` that have today's command."""
    jobs = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.is_file() else {}
    same = {}
    for key, job in jobs.items():
        if key in JOBS and job["command"] == command_of(JOBS[key].words):
            same[key] = {**job, "what": JOBS[key].what}
    return same


def write(jobs: Mapping[str, Any]) -> None:
    """Writes `results.json`, jobs in the order of `JOBS`."""
    ordered = {key: jobs[key] for key in JOBS if key in jobs}
    text = json.dumps(ordered, indent=1, ensure_ascii=False)
    RESULTS.write_text(f"{text}\n", encoding="utf-8")


def run(key: str, data: Path) -> dict[str, Any]:
    """Runs a job; returns when and where it ran, its CPU time, and what it printed.

    Raises:
        CalledProcessError: the job failed; it has said why.
    """
    words = []
    for word in shlex.split(JOBS[key].words):
        words.append(re.sub(r"^data\.path=", f"data.path={data}{os.sep}", word))
    command = [sys.executable, "-m", "cfx", *words, f"hydra.run.dir={FOLDER / key}"]
    print(f"{key}: {command_of(JOBS[key].words)}", flush=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    output = ""
    # Our own command, no shell.
    with subprocess.Popen(command, cwd=ROOT, text=True, stdout=subprocess.PIPE) as process:  # noqa: S603
        for line in process.stdout or ():
            print(line, end="", flush=True)
            output += line
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    spent = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    printed = PRINTED.search(output)
    return {
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "machine": machine(),
        "cpu_minutes": round(spent / 60, 1),
        "printed": printed[0].split("\n") if printed else [],
    }


def draw(key: str) -> None:
    """Draws the images of documents that show a finished job."""
    for image, (job, figure) in FIGURES.items():
        if job != key:
            continue
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "cfx", "figures", str(FOLDER / key), "--format", "png"]
            subprocess.run([*command, "--only", figure, "--folder", folder], cwd=ROOT, check=True)  # noqa: S603 - our own
            shutil.copyfile(Path(folder, f"{figure}.png"), ROOT / "docs" / image)


def machine() -> str:
    """Returns on what jobs run here: processor, cores, Python, PyTorch."""
    import torch

    name = platform.machine()
    for line in processor_lines():
        if line.startswith("model name"):
            name = line.partition(": ")[2]
            break
    return (
        f"{name}, {os.cpu_count()} cores; Python {platform.python_version()},"
        f" PyTorch {torch.__version__}"
    )


def processor_lines() -> Iterator[str]:
    """Yields what Linux says of the processor; nothing elsewhere."""
    file = Path("/proc/cpuinfo")
    if file.is_file():
        yield from file.read_text(encoding="utf-8").splitlines()


def command_of(words: str) -> str:
    """Returns a job's command."""
    return f"python -m cfx {words}".rstrip()


def entry(job: Job, folder: Path, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what `results.json` says of a finished job: where it comes from, and its numbers.

    Args:
        job: what ran.
        folder: its folder.
        measured: what `run` has returned.
    """
    data = json.loads((folder / "data.json").read_text(encoding="utf-8"))
    config = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    numbers = {}
    for name, value in metrics.items():
        if KEPT.fullmatch(name) and value is not None:
            numbers[name] = float(f"{value:.6g}")
    return {
        "what": job.what,
        "command": command_of(job.words),
        "commit": data["commit"],
        "seed": config["seed"],
        **{name: value for name, value in measured.items() if job.is_shown or name != "printed"},
        "numbers": numbers,
    }


if __name__ == "__main__":
    main()

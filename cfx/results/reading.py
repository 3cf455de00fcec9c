"""Reads a finished job back from its folder."""

from __future__ import annotations

from contextlib import suppress
from datetime import datetime
from pathlib import Path

from cfx.core.guest import visit
from cfx.core.job_folder import (
    examine,
    optional,
    public,
    read_json,
    read_metrics,
    read_yaml,
)
from cfx.errors import DataError
from cfx.policies.ready import is_ready_made
from cfx.results.folder import CONFIG, DATA, METRICS, typed_overrides
from cfx.results.result import Result
from cfx.results.table import file_of, installed, stored_tables
from cfx.results.tracker import Origin, folder_of


def read_result(origin: Origin) -> Result:
    """Reads one finished job, from its folder and what is known besides.

    Tables are read when they are first asked for, the pairs at once.

    Raises:
        DataError: a file cannot be read, or is not what a job writes.
    """
    folder = origin.folder
    assert folder is not None
    examine(folder)
    metrics = read_metrics(folder / METRICS)
    tables = stored_tables(folder)
    config, data = {}, {}
    if not is_ready_made(origin.place):  # no recording, and nothing of one, comes with such
        config = read_yaml(folder / CONFIG)
        data = optional(folder / DATA, read_json) or {}
        pairs = folder / "pairs.csv"
        if "pairs" not in tables:
            raise DataError(f"{pairs} is missing; run the job again, or leave it out")
        if not {"policy", "driver_specific"} & set(tables["pairs"]["method"]):
            raise DataError(
                f"{pairs} is damaged: it has no row of the method 'policy' or 'driver_specific'"
            )
    missing = []
    for table in installed():
        if table.component.always and table.name not in tables:
            missing.append(file_of(table))
    hydra = folder if origin.hydra is None else origin.hydra
    overrides = typed_overrides(hydra)
    started, seconds = _duration(hydra, origin)
    version, commit = str(origin.version or data.get("cfx") or ""), str(data.get("commit") or "")
    if commit:  # of the folder that the job was started in
        version = f"{version}, commit {commit}".removeprefix(", ")
    return Result(
        config=public(config),
        data=public(data),
        metrics=metrics,
        tables=tables,
        folder=folder,
        figures=tuple(sorted((folder / "figures").glob("*.*"))),
        place=origin.place,
        overrides=overrides,
        started=started,
        seconds=seconds,
        version=version,
        missing=tuple(missing),
    )


def _duration(folder: Path, origin: Origin) -> tuple[datetime | None, float | None]:
    """Returns when the job began, and how many seconds it took."""
    if origin.started is not None:
        return origin.started, origin.seconds
    stamps = []
    with suppress(OSError):
        for line in (folder / "cfx.log").read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError):  # each message begins with its time
                stamps.append(datetime.strptime(line[:19], "%Y-%m-%d %H:%M:%S"))
    seconds = (stamps[-1] - stamps[0]).total_seconds() if stamps else None
    status = optional(folder / "outcome.json", read_json) or {}
    if isinstance(status.get("seconds"), int | float):
        seconds = float(status["seconds"])
    return stamps[0] if stamps else None, seconds


@visit()
def load(folder_or_run: str | Path) -> Result:
    """Reads a finished job back.

    Args:
        folder_or_run: a job's output folder or the URL of its copy (`output.url`), the id of its
            MLflow run, or a ready-made policy (`cfx://NAME`), whose table of pairs is empty.

    Raises:
        DataError: there is no finished job, or no such policy.
    """
    folder = folder_of(folder_or_run)
    needed = [METRICS] if is_ready_made(folder_or_run) else [METRICS, "pairs.csv"]
    for name in needed:
        if not (folder / name).is_file():
            examine(folder)
            raise DataError(
                f"{folder} holds no finished job (it has no {name}); give the output folder that a"
                " job printed"
            )
    result = read_result(Origin(str(folder_or_run), folder))
    _ = result.policy  # so that a damaged one is named here
    return result

"""`cfx export --to sumo`: a job's driver-specific parameters as vTypes that SUMO loads."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast
from xml.sax.saxutils import quoteattr

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cfx.errors import ConfigError, DataError, listed
from cfx.plugin import (
    COARSE_S,
    DrivingModel,
    ExportFormat,
    InSumo,
    VType,
    files,
    folder_of,
    identifiability,
    is_ready_made,
    job_folder,
    registry,
)
from cfx_sumo.limits import lost_limits

NAME = "drivers.add.xml"

ALL_DRIVERS = "drivers"
"""The vTypeDistribution of all drivers."""

POPULATION = "population"
"""The vTypeDistribution of new drivers, drawn from the population of the recorded ones."""

_WITHOUT_LAG = {"variant": "sumo", "leader_deceleration": None}
"""Settings with which krauss is SUMO's KraussOrig1, once its t_i is 0."""


class VTypeExport(ExportFormat):
    """Writes driver-specific parameters as vTypes that SUMO loads: see `export`."""

    def write(self, run: str, output: Path | None) -> list[str]:
        return export(run, output)


def export(run: str | Path, output: str | Path | None = None) -> list[str]:
    """Writes a vTypeDistribution for each cluster, with a vType for each pair's parameters.

    The parameters are those of the method `driver_specific`: calibrated to the driver, constant.
    The distribution `drivers` holds them all. Each vType is one driver's whole set, so that a
    vehicle drawn from it has parameters that belong together, as correlated as they are among
    drivers. Where the job has found a population (`calibration.posterior=hierarchical`), the
    distribution `population` holds new drivers of it: what a recording leaves open does not widen
    it.

    Args:
        run: a job's output folder, or the id of its MLflow run.
        output: the file; None for `drivers.add.xml` in that folder, or here for an MLflow run.

    Raises:
        DataError: there is no finished job, or it has no driver-specific parameters.
        ConfigError: SUMO has no model that drives as the job's.
        OutputError: the file cannot be written.

    Returns:
        Sentences for the user.
    """
    if is_ready_made(run):
        raise DataError(
            f"{run}: a ready-made policy has no driver-specific parameters; export a job that"
            " calibrated some, or drive with the policy itself (cfx drive)"
        )
    folder, home = _folder(run)
    node, table = _read(folder)
    kind, notes = vtypes(node, table)
    drawn = _population(folder)
    notes += _undetermined(table)
    step = _time_step(folder)
    notes.append(
        f"the parameters belong to steps of {step:g} s; SUMO's own step is 1 s unless it is told"
        " otherwise"
    )
    if step > COARSE_S:
        notes.append(
            "calibrated in steps so coarse, parameters are biased (IDM's time gap at 1 s by a"
            " quarter); data.time_step=0.1 calibrates in steps of 0.1 s"
        )
    path = Path(output).expanduser() if output else home / NAME
    lines = _drivers(table, kind)
    if drawn is not None:
        new, _ = vtypes(node, drawn)
        lines += _distribution(POPULATION, drawn, new, _columns(new, len(drawn)))
    files.write_output(path, _xml(lines, notes), "the list of vTypes")
    first = quoteattr(str(table["cluster"].iloc[0]))
    counts = []
    for name, count in table.groupby("cluster", sort=False).size().items():
        counts.append(f"{name} {count}")
    further = ""
    if drawn is not None:
        further = f"; {len(drawn)} drawn from their population in '{POPULATION}'"
    file = shlex.quote(str(path.absolute()))
    return [
        f"vTypes of SUMO's {kind.car_follow_model}, in one vTypeDistribution for each cluster:"
        f" {', '.join(counts)}; all together in '{ALL_DRIVERS}'{further}",
        *[f"Note: {note}" for note in notes],
        f"Use it: sumo --step-length {step:g} --additional-files {file}; then in a flow"
        f' or vehicle: type="{ALL_DRIVERS}", or type={first}',
    ]


def vtypes(node: Mapping[str, Any], table: pd.DataFrame) -> tuple[VType, list[str]]:
    """Returns what SUMO calls the drivers of a table, and what a reader of the result must know.

    Args:
        node: the driving model's config node.
        table: a row for each driver, with a column `parameter_NAME` for each tuned parameter.

    Raises:
        ConfigError: SUMO has no model that drives as this one.
        DataError: the table has other parameters than the model.
    """
    model = cast(DrivingModel, registry.create("model", node))
    columns = [f"parameter_{name}" for name in model.space.names]
    missing = [column for column in columns if column not in table]
    if missing:
        raise DataError(
            f"pairs.csv has no column {missing[0]}, which model={node['name']} here needs; run the"
            " job again"
        )
    p: dict[str, Tensor] = model.space.unpack(torch.tensor(table[columns].to_numpy(dtype=float)))
    notes: list[str] = []
    if node["name"] == "krauss":
        model, notes = _krauss(node, p)
    if not isinstance(model, InSumo):
        raise ConfigError(
            f"SUMO has no car-following model that drives as model={node['name']}; export jobs with"
            " model=idm, krauss, w99, krauss_sumo, idm_sumo or sumo_vtype"
        )
    kind = model.sumo_vtype(p)
    lost = lost_limits(model, kind)
    if lost:
        notes.append(
            f"SUMO knows nothing of {listed(lost)}, with which the parameters were calibrated, and"
            " keeps to accel, decel and emergencyDecel"
        )
    return kind, notes


def _krauss(node: Mapping[str, Any], p: Mapping[str, Tensor]) -> tuple[DrivingModel, list[str]]:
    """Returns krauss as SUMO has it; what is lost stands in the notes."""
    notes = []
    if bool((p["t_i"] > 0).any()):
        notes.append(
            "SUMO's KraussOrig1 has no brake build-up time t_i; tau is t_r, with which the gap at"
            " constant speed is the same, and braking begins a little later"
        )
    if node.get("leader_deceleration") is not None:
        notes.append(
            "SUMO's KraussOrig1 expects of the leader the follower's own decel, not"
            " leader_deceleration"
        )
    parameters = dict(node.get("parameters") or {})
    parameters["t_i"] = {"default": 0.0, "tuned": False}
    without_lag = {**node, **_WITHOUT_LAG, "parameters": parameters}
    return cast(DrivingModel, registry.create("model", without_lag)), notes


def _folder(run: str | Path) -> tuple[Path, Path]:
    """Returns the folder of a job, and where its export goes unless told otherwise."""
    folder = folder_of(run)
    if Path(run).expanduser().is_dir():
        return folder, folder
    return folder, Path()


def _read(folder: Path) -> tuple[dict[str, Any], pd.DataFrame]:
    """Reads the model's node, and the rows of `driver_specific`, calmest cluster first."""
    job_folder.examine(folder)
    try:
        node = job_folder.parse_yaml((folder / "config.yaml").read_text(encoding="utf-8"))["model"]
        if not isinstance(node, dict):
            raise ValueError("config.yaml: model is no mapping")
        table = pd.read_csv(folder / "pairs.csv", dtype={"pair_id": str})
        fixed = table[table["method"] == "driver_specific"]
        values = fixed.filter(like="parameter_").to_numpy(dtype=float)
        fixed = fixed[np.isfinite(values).all(axis=1)]
        fixed = fixed.sort_values("style_score", kind="stable").reset_index(drop=True)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{folder} holds no finished job ({error}); give the output folder that a job printed"
        ) from error
    if fixed.empty:
        raise DataError(
            f"{folder}/pairs.csv holds no driver-specific parameters; give a job"
            " that calibrated some"
        )
    return node, fixed


def _population(folder: Path) -> pd.DataFrame | None:
    """Returns new drivers that a job has drawn; None if it has found no population."""
    path = folder / f"{POPULATION}.parquet"
    if not path.exists():
        return None
    try:
        return pd.read_parquet(path).reset_index(drop=True)
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}); run the job again") from error


def _time_step(folder: Path) -> float:
    """Returns the time step in which a job calibrated, s; its policy says so."""
    path = folder / "policy" / "policy.json"
    try:
        step = float(job_folder.parse_json(path.read_text(encoding="utf-8"))["dt"])
        if not 0 < step < np.inf:
            raise ValueError(f"dt: {step}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path} does not say the time step ({error}); give the output folder that a job"
            " printed"
        ) from error
    return step


def _undetermined(table: pd.DataFrame) -> list[str]:
    """Returns a note on the parameters that some recordings do not determine, if there are any."""
    counts = Counter(name for row in table.index for name in _flat(table, row))
    if not counts:
        return []
    listed = ", ".join(f"{name} of {count}" for name, count in counts.items())
    return [
        f"some recordings do not determine {listed} of the {len(table)} drivers, so that these"
        " values say nothing of them; each such vType names them in its parameter 'flat'"
    ]


def _flat(table: pd.DataFrame, row: Any) -> list[str]:
    """Returns the parameters whose loss is flat for the driver of a row, by cfx's names."""
    columns = []
    for name in table:
        if str(name).startswith(identifiability.FLAT_SHARE_PREFIX):
            columns.append(str(name))
    return [
        name.removeprefix(identifiability.FLAT_SHARE_PREFIX)
        for name in columns
        if table[name][row] == 1
    ]


def _xml(lines: list[str], notes: list[str]) -> str:
    said = [f"     {note}." for note in notes]
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            "<!-- Constant parameters of recorded drivers, each calibrated by cfx.",
            *said,
            "-->",
            "<additional>",
            *lines,
            "</additional>",
            "",
        ]
    )


def _drivers(table: pd.DataFrame, kind: VType) -> list[str]:
    """Returns a distribution of each cluster, and one of all drivers."""
    lines, names = [], []
    columns = _columns(kind, len(table))
    for cluster, rows in table.groupby("cluster", sort=False):
        lines += _distribution(str(cluster), rows, kind, columns)
        names += [f"{cluster}_{place}" for place in range(len(rows))]
    together = quoteattr(" ".join(names))
    return [*lines, f'    <vTypeDistribution id="{ALL_DRIVERS}" vTypes={together}/>']


def _columns(kind: VType, count: int) -> dict[str, list[str]]:
    """Returns attributes of each of `count` vehicles, by name."""
    attributes = {"sigma": "0", **kind.attributes}
    return {name: _texts(value, count) for name, value in attributes.items()}


def _distribution(
    name: str, rows: pd.DataFrame, kind: VType, columns: Mapping[str, list[str]]
) -> list[str]:
    """Returns a distribution of the vTypes of some rows; `columns` has the attributes of all."""
    lines = [f"    <vTypeDistribution id={quoteattr(name)}>"]
    for place, row in enumerate(rows.index):
        attributes = {key: values[row] for key, values in columns.items()}
        about = {"pair": rows["pair_id"][row]} if "pair_id" in rows else {}
        flat = _flat(rows, row)
        if flat:
            about["flat"] = " ".join(flat)
        lines += _vtype(f"{name}_{place}", kind, attributes, about)
    return [*lines, "    </vTypeDistribution>"]


def _vtype(
    name: str, kind: VType, attributes: Mapping[str, str], about: Mapping[str, str]
) -> list[str]:
    further = []
    for key, said in about.items():
        further.append(f"            <param key={quoteattr(key)} value={quoteattr(said)}/>")
    given = " ".join(f"{key}={quoteattr(value)}" for key, value in attributes.items())
    return [
        f"        <vType id={quoteattr(name)} carFollowModel={quoteattr(kind.car_follow_model)}"
        f' speedDev="0" {given}>',
        *further,
        "        </vType>",
    ]


def _texts(value: Tensor | str, count: int) -> list[str]:
    """Returns an attribute of each of `count` vehicles."""
    if isinstance(value, str):
        return [value] * count
    return [repr(float(number)) for number in value.expand(count)]

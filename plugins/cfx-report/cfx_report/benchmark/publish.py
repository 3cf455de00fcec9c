"""Trains the ready-made policies and writes them, with their cards, into the package."""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from omegaconf import OmegaConf

from cfx.errors import ConfigError, DataError, nearest
from cfx.plugin import (
    READY_FOLDER,
    Agent,
    ExpectedError,
    files,
    load_agent,
    save_agent,
    traffic_table,
    valid_range,
)
from cfx_report.benchmark.recipes import I80, RECIPES

_SOURCES = {
    I80: "NGSIM I-80 (U.S. Department of Transportation, public domain), 4:00-4:15 and"
    " 5:00-5:15 pm, reconstructed trajectories",
    "ngsim": "NGSIM I-80 (as before), the HOV lane and the on-ramp, smoothed",
    "openacc": "OpenACC (Joint Research Centre of the European Commission, CC BY 4.0): {},"
    " resampled to 0.1 s",
    "tgsim": "freeways of TO 21-426, modeling HV interactions with inconspicuous ACC-equipped"
    " vehicles (U.S. Department of Transportation, Federal Highway Administration, Saxton"
    " Transportation Operations Laboratory, Apache License 2.0): smoothed, cut into pairs",
}
"""Who recorded a file, by how its name begins."""

_PLACES = {"zalazone": "ZalaZone", "vicolungo": "Vicolungo", "ispra": "Ispra"}
"""Where OpenACC recorded, by what stands in a file's name."""

_LICENCES = {
    "openacc": "made with OpenACC's recordings, which are CC BY 4.0",
    "tgsim": "made with recordings of TO 21-426 under the Apache License 2.0",
}
"""What is said of weights that learned from a file, by how its name begins; all others are in the
public domain."""

TRAFFIC_STEP = "0.5"
"""s: step of SUMO at which a card's traffic is measured, in the middle of usual ones."""

_SITE_COLUMNS = (
    "scope",
    "site",
    "driver_type",
    "drivers",
    "rmse_speed_driver_specific",
    "rmse_speed_pooled",
    "rmse_speed_policy",
    "over_driver_specific",
    "over_driver_specific_low",
    "over_driver_specific_high",
    "over_pooled",
    "over_pooled_low",
    "over_pooled_high",
)


def make(names: Sequence[str], data: Path, work: Path) -> None:
    """Trains policies, or takes finished jobs of an earlier call, and writes them.

    Args:
        names: of recipes; empty: all.
        data: the folder with the recordings.
        work: where the jobs run.

    Raises:
        ConfigError: there is no such recipe.
        DataError: a job failed.
    """
    for name in names:
        if name not in RECIPES:
            raise ConfigError(
                f"cfx policies make {name}: there is no such recipe.{nearest(name, list(RECIPES))}"
                f" Known: {', '.join(RECIPES)}."
            )
    for name in names or RECIPES:
        job = work / name
        if not (job / "metrics.json").is_file():
            _train(name, data, job)
        publish(name, job)


def publish(name: str, job: Path) -> None:
    """Writes the policy of a finished job and its card into the package.

    Raises:
        DataError: the job has no policy for unseen drivers.
    """
    agent = load_agent(job / "policy").for_unseen_drivers()
    metrics = json.loads((job / "metrics.json").read_text(encoding="utf-8"))
    data = json.loads((job / "data.json").read_text(encoding="utf-8"))
    folder = READY_FOLDER / name
    if folder.is_dir():
        shutil.rmtree(folder)
    save_agent(agent, folder / "policy")
    files.write_json(folder / "metrics.json", metrics)
    card = _card(name, agent, metrics, data, job)
    if (job / "sites.csv").is_file():
        card["sites"] = _sites(pd.read_csv(job / "sites.csv"))
    card["size_kb"] = _kilobytes(folder)
    card["stress"] = _stress(folder)
    files.write_json(folder / "card.json", card)
    measured = _traffic(name, folder)
    files.write_json(folder / traffic_table.FILE, measured)
    with files.atomic_write(folder / "CARD.md") as temporary:
        temporary.write_text(card_text(card, measured), encoding="utf-8")
    print(f"wrote {folder}")


def command_of(name: str) -> str:
    """Returns the command that trains a policy."""
    recipe = RECIPES[name]
    recordings = ",".join(recipe.recordings)
    path = (
        f"data.path={recordings}" if len(recipe.recordings) == 1 else f"'data.path=[{recordings}]'"
    )
    # A shell takes lists of histories as they are, and the published commands have them so.
    words = [shlex.quote(word) if set(word) & set("~ {*") else word for word in recipe.overrides]
    return f"python -m cfx {' '.join(words)} {path}"


def _train(name: str, data: Path, job: Path) -> None:
    recipe = RECIPES[name]
    command = [sys.executable, "-m", "cfx", *recipe.overrides]
    paths = [
        files.path_override("data.path", data.absolute() / file).removeprefix("data.path=")
        for file in recipe.recordings
    ]
    command.append(f"data.path={paths[0]}" if len(paths) == 1 else f"data.path=[{','.join(paths)}]")
    command.append(files.path_override("hydra.run.dir", job.absolute()))
    # Our own command, no shell.
    done = subprocess.run(command, check=False)  # noqa: S603
    if done.returncode:
        raise DataError(f"the job of {name} failed; its words stand above, its log in {job}")


def _card(
    name: str, agent: Agent, metrics: dict[str, Any], data: dict[str, Any], job: Path
) -> dict[str, Any]:
    """Returns the card: plain data."""
    improvement = "full_trajectory/improvement/rmse_speed/pooled"
    return {
        "name": name,
        "summary": RECIPES[name].summary,
        "model": agent.model_node["name"],
        "policy": agent.policy_node["name"],
        "licence": _licence(RECIPES[name].recordings),
        "command": command_of(name),
        "training_data": {
            "source": _source(RECIPES[name].recordings),
            "pairs": len(agent.trained_on.pairs),
            "drivers": len(set(agent.trained_on.pairs.values())),
            "fingerprint": data.get("fingerprint", ""),
            "simulated": _simulated(job),
        },
        "evaluation": _evaluation(RECIPES[name].recordings),
        "errors_on_unseen_drivers": {
            "rmse_speed": metrics["full_trajectory/rmse_speed/policy"],
            "rmse_speed_pooled": metrics["full_trajectory/rmse_speed/pooled"],
            "rmse_gap": metrics["full_trajectory/rmse_gap/policy"],
            "improvement_over_pooled": metrics[f"{improvement}/geometric"],
            "improvement_over_pooled_ci95": [
                metrics[f"{improvement}/ci95_low"],
                metrics[f"{improvement}/ci95_high"],
            ],
            "last_part_rmse_speed": metrics["rmse_speed/policy"],
            "last_part_improvement_over_own": metrics[
                "improvement/rmse_speed/driver_specific/geometric"
            ],
        },
        "expected_error": _expected(agent),
        "distributions": _distributions(metrics),
        "safety": {
            "collisions": metrics["full_trajectory/collisions/policy"],
            "hard_braking_frames": metrics["full_trajectory/hard_braking/policy"],
            "jerk": metrics["jerk/policy"],
            "jerk_of_people": metrics["jerk/real"],
        },
        "limits": _limits(agent),
        "valid_range": _range(agent),
        "base_parameters": _base(agent),
    }


def _source(recordings: Sequence[str]) -> str:
    """Returns who recorded the files."""
    sources = []
    for begins, source in _SOURCES.items():
        places = []
        for file in recordings:
            if file.startswith(begins):
                places += [place for word, place in _PLACES.items() if word in file]
        if places or any(file.startswith(begins) for file in recordings):
            sources.append(source.format(", ".join(places)))
    return "; ".join(sources)


def _licence(recordings: Sequence[str]) -> str:
    """Returns the licence of weights that learned from the files, and theirs."""
    said = []
    for begins, words in _LICENCES.items():
        if any(file.startswith(begins) for file in recordings):
            said.append(words)
    if not said:
        return "MIT, as cfx; the recordings that it was trained on are in the public domain"
    return f"MIT, as cfx; {'; '.join(said)}"


def _simulated(job: Path) -> str:
    """Returns whom a job's networks learned from beside recorded drivers, in words; "" if nobody.

    Args:
        job: its folder.
    """
    learner = OmegaConf.load(job / "config.yaml").learner
    groups = []
    if learner.simulated_drivers:
        groups.append(
            f"{learner.simulated_drivers} in stop-and-go traffic (Krauss's model and IDM)"
        )
    if learner.simulated_queues:
        groups.append(
            f"{learner.simulated_queues} who leave queues at lights (IDM, with the saturation flow"
            " of the Highway Capacity Manual)"
        )
    return " and ".join(groups)


def _evaluation(recordings: Sequence[str]) -> str:
    if len(recordings) == 1:
        return "5 folds over drivers: nothing of a tested driver was learned from"
    return (
        "each site is left out once: nothing of a tested driver's road was learned from. Errors are"
        " means over pairs, those by site below"
    )


def _sites(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Returns the rows of `sites.csv` for a card; what is not known is left out."""
    rows = []
    for row in table.to_dict("records"):
        values = {}
        for name in _SITE_COLUMNS:
            value = row.get(name)
            if isinstance(value, str) or (value is not None and math.isfinite(value)):
                values[name] = value
        rows.append(values)
    return rows


def _expected(agent: Agent) -> dict[str, float | None]:
    """Returns what bounds the errors of nine in ten drivers, as far as known."""
    expected = agent.trained_on.expected_error
    return {} if expected is None else asdict(expected)


def _distributions(metrics: dict[str, Any]) -> list[dict[str, float]]:
    """Returns the scores of sampled forecasts, a row per horizon; none where nothing is drawn."""
    rows = []
    pattern = re.compile(r"distribution/crps_speed_(?P<seconds>[0-9.]+)s/policy")
    for name, value in metrics.items():
        match = pattern.fullmatch(name)
        coverage = f"distribution/coverage_{match['seconds']}s/policy" if match else ""
        if match and coverage in metrics:
            row = {"horizon_s": float(match["seconds"]), "crps_speed": value}
            rows.append({**row, "coverage": metrics[coverage]})
    return sorted(rows, key=lambda row: row["horizon_s"])


def _limits(agent: Agent) -> dict[str, Any]:
    limits = agent.model_node.get("limits")
    return dict(limits) if limits else {}


def _range(agent: Agent) -> dict[str, Any]:
    valid = agent.valid_range
    if valid is None:
        return {}
    bounds = {}
    for number, signal in enumerate(valid_range.RANGE_SIGNALS):
        low, high = valid.low[0, number], valid.high[0, number]
        name = signal
        if signal == "log_gap":
            name, low, high = "gap", torch.expm1(low), torch.expm1(high)
        bounds[name] = [round(float(low), 2), round(float(high), 2)]
    return {
        "usual": bounds,
        "mahalanobis_distance": float(valid.distance[0]),
        "faded_at": valid_range.FADED,
    }


def _base(agent: Agent) -> dict[str, float]:
    """Returns the driving model's base parameters, without those of a residual."""
    if agent.base is None:
        return {}
    names = agent.core.head.model_space.names
    return dict(zip(names, agent.base[0, : len(names)].tolist(), strict=True))


def _kilobytes(folder: Path) -> int:
    total = 0
    for file in folder.rglob("*"):
        if file.is_file():
            total += file.stat().st_size
    return round(total / 1024)


def _stress(folder: Path) -> dict[str, Any]:
    """Returns what the policy does in SUMO's stress scenario.

    Raises:
        DataError: it cannot be run.
    """
    with tempfile.TemporaryDirectory(prefix="cfx-") as temporary:
        output = Path(temporary) / "stress.json"
        command = [sys.executable, "-m", "cfx", "drive", "stress", "--output", str(output)]
        command += ["--drivers", f"car={folder}"]
        # Our own command, no shell. SUMO wants a process without pyarrow.
        done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL)  # noqa: S603
        if done.returncode:
            raise DataError(f"{folder}: the stress scenario failed; its words stand above")
        measured: dict[str, Any] = json.loads(output.read_text(encoding="utf-8"))
    return measured


def _traffic(name: str, folder: Path) -> dict[str, Any]:
    """Returns what traffic the policy makes, as `cfx drive stress --traffic` measures it.

    Raises:
        DataError: it cannot be measured.
    """
    recorded = "acc" if "data.driver_type=acc" in RECIPES[name].overrides else "human"
    with tempfile.TemporaryDirectory(prefix="cfx-") as temporary:
        command = [sys.executable, "-m", "cfx", "drive", "stress", "--drivers", f"car={folder}"]
        command += ["--recorded", recorded, "--step", TRAFFIC_STEP, "--traffic", temporary]
        done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL)  # noqa: S603
        if done.returncode:
            raise DataError(f"{folder}: its traffic was not measured; the words stand above")
        written = Path(temporary, traffic_table.FILE).read_text(encoding="utf-8")
    measured: dict[str, Any] = json.loads(written)
    measured["command"] = measured["command"].replace(str(folder), f"cfx://{name}")
    return measured


def card_text(card: dict[str, Any], measured: dict[str, Any] | None = None) -> str:
    """Returns a card as Markdown.

    Args:
        card: what `card.json` holds.
        measured: what `traffic.json` holds; None: traffic was not measured.
    """
    errors, safety, data = card["errors_on_unseen_drivers"], card["safety"], card["training_data"]
    low, high = errors["improvement_over_pooled_ci95"]
    lines = [
        f"# {card['name']}",
        "",
        card["summary"],
        "",
        f"- **Model and policy**: {card['model']}, {card['policy']}",
        f"- **Training data**: {data['source']};"
        f" {data['pairs']} pairs of {data['drivers']} drivers",
        *_simulated_lines(data.get("simulated", "")),
        f"- **Evaluation**: {card['evaluation']}",
        f"- **Full trajectories of unseen drivers**: RMSE of speed {errors['rmse_speed']:.3f} m/s"
        f" (pooled parameters: {errors['rmse_speed_pooled']:.3f} m/s), of the gap"
        f" {errors['rmse_gap']:.2f} m; {errors['improvement_over_pooled']:+.1%} over pooled"
        f" parameters (95 % interval {low:+.1%} to {high:+.1%})",
        f"- **Last 20 %**: RMSE of speed {errors['last_part_rmse_speed']:.3f} m/s,"
        f" {errors['last_part_improvement_over_own']:+.1%} over driver-specific parameters",
        f"- **Safety in these tests**: {safety['collisions']:.0f} collisions,"
        f" {safety['hard_braking_frames']:.0f} frames braking harder than 8 m/s2, RMS jerk"
        f" {safety['jerk']:.2f} m/s3 (the recorded drivers: {safety['jerk_of_people']:.2f})",
        *_expected_lines(card.get("expected_error", {})),
        *_distribution_lines(card.get("distributions", ())),
        *_stress_lines(card["stress"]),
        f"- **Limits**: {_pairs(card['limits'])}",
        f"- **Valid range** (99.8 % of what it learned from): {_usual(card['valid_range'])}",
        f"- **Base parameters**, far outside the valid range: {_pairs(card['base_parameters'])}",
        f"- **Licence**: {card['licence']}",
        "",
        *_site_lines(card.get("sites", ())),
        *(traffic_table.traffic_lines(measured) if measured else ()),
        "Made by",
        "",
        "```",
        card["command"],
        "```",
        "",
    ]
    return "\n".join(lines)


def _simulated_lines(simulated: str) -> list[str]:
    return [f"- **Simulated drivers** that it learned from too: {simulated}"] if simulated else []


def _expected_lines(expected: dict[str, float | None]) -> list[str]:
    words = ExpectedError(**expected).of_unseen_in_words()
    return [f"- **Expected error**: {words}"] if words else []


def _distribution_lines(rows: Sequence[dict[str, float]]) -> list[str]:
    if not rows:
        return []
    scores = []
    for row in rows:
        scores.append(
            f"{row['crps_speed']:.3f} m/s and {row['coverage']:.0%} at {row['horizon_s']:g} s"
        )
    return [
        "- **Sampled forecasts** (CRPS of speed; coverage of the central 90 %):"
        f" {', '.join(scores)}. Errors above are those of its centre, where nothing is drawn"
    ]


def _site_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Returns a table by site: each left out, people and cars with cruise control apart."""
    if not rows:
        return []
    lines = [
        "| left out | drivers | last 20 %: driver-specific / policy, m/s | over driver-specific"
        " | full trajectories: pooled / policy, m/s | over pooled |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    full = {
        (row["site"], row["driver_type"]): row for row in rows if row["scope"] == "full_trajectory"
    }
    for row in rows:
        key = row["site"], row["driver_type"]
        if row["scope"] != "test":
            continue
        name = (
            row["site"] if row["driver_type"] == "all" else f"{row['site']}, {row['driver_type']}"
        )
        whole = full.get(key, {})
        cells = [
            name,
            f"{row['drivers']:.0f}",
            _errors(row, "driver_specific"),
            _gain(row, "over_driver_specific"),
            _errors(whole, "pooled"),
            _gain(whole, "over_pooled"),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def _errors(row: dict[str, Any], baseline: str) -> str:
    if f"rmse_speed_{baseline}" not in row:
        return ""
    return f"{row[f'rmse_speed_{baseline}']:.3f} / **{row['rmse_speed_policy']:.3f}**"


def _gain(row: dict[str, Any], name: str) -> str:
    if name not in row:
        return ""
    text = f"{row[name]:+.1%}"
    if f"{name}_low" in row:
        text += f" ({row[f'{name}_low']:+.1%} to {row[f'{name}_high']:+.1%})"
    return text


def _stress_lines(stress: dict[str, Any]) -> list[str]:
    lines = []
    for event in stress.get("events", ()):
        lines.append(
            f"- **{event['kind']}** ({event['number']} times in SUMO): {event['collisions']}"
            f" collisions, hardest braking {event['hardest_braking']:.1f} m/s2"
        )
    if "town" in stress:
        town = stress["town"]
        lines.append(
            f"- **In town**: saturation flow at a light {town['saturation_flow']:,.0f} vehicles an"
            f" hour of green and lane, start-up lost time {town['lost_time']:.1f} s;"
            f" {town['outside']:.0%} of steps in crossing traffic are outside the valid range"
        )
    return lines


def _pairs(values: dict[str, Any]) -> str:
    parts = [f"{name} {value:.3g}" for name, value in values.items() if value is not None]
    return ", ".join(parts)


def _usual(ranges: dict[str, Any]) -> str:
    parts = []
    for signal, (low, high) in ranges.get("usual", {}).items():
        parts.append(f"{signal.replace('_', ' ')} {low:g} to {high:g}")
    return ", ".join(parts)

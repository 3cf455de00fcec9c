"""Results of a job that never ran: made up, but shaped like real ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from cfx.core.parameters import Parameter, ParameterSpace
from cfx.data.style import CLUSTERS, StyleResult
from cfx.evaluation.metrics.base import MetricInfo
from cfx.evaluation.result import Evaluation, PairTrajectory, Platoon
from cfx.evaluation.statistics import improvement_statistics
from cfx.evaluation.tables import VALUE_COLUMNS, values_of

TWO = ParameterSpace.of(
    Parameter("t_r", "s", 0.1, 10.0, 1.5, "reaction time"),
    Parameter("t_i", "s", 0.0, 2.0, 0.15, "brake build-up time"),
)
INDICATORS = (
    "mean_speed",
    "variance_speed",
    "mean_acceleration",
    "variance_acceleration",
    "mean_space_headway",
    "mean_time_headway",
)


@dataclass(frozen=True)
class MadeUp:
    evaluation: Evaluation
    style: StyleResult
    curves: pd.DataFrame


def make_results(
    pairs: int = 26,
    frames: int = 150,
    space: ParameterSpace = TWO,
    seed: int = 0,
    epochs: int = 60,
    networks: int | None = None,
    methods: tuple[str, ...] = ("default", "driver_specific", "policy"),
) -> MadeUp:
    """Makes up an evaluation, a style and learning curves (one network per pair by default)."""
    rng = np.random.default_rng(seed)
    trajectories = tuple(make_trajectory(k, frames, space, rng, methods) for k in range(pairs))
    about = []
    for k, one in enumerate(trajectories):
        about += about_of(k, one, space)
    values = make_values(trajectories)
    evaluation = Evaluation(
        about=pd.DataFrame(about),
        values=values,
        measured=MEASURED,
        improvements={},
        trajectories=trajectories,
        parameters=space.tuned,
    )
    speed = values_of(values, "rmse_speed", "test")
    drivers = [one.driver for one in trajectories]
    improvements = {}
    for baseline in methods:
        if baseline != "policy" and "policy" in methods:
            errors = speed[baseline].to_numpy(), speed["policy"].to_numpy()
            improvements[baseline] = improvement_statistics(*errors, drivers)
    evaluation = dataclasses.replace(evaluation, improvements={"test": improvements})
    style = make_style([one.driver for one in trajectories], rng)
    curves = make_curves(pairs if networks is None else networks, epochs, seed)
    return MadeUp(dataclasses.replace(evaluation, style=style), style, curves)


def make_trajectory(
    k: int,
    frames: int,
    space: ParameterSpace,
    rng: np.random.Generator,
    methods: tuple[str, ...] = ("default", "driver_specific", "policy"),
) -> PairTrajectory:
    low, high = np.array([p.low for p in space.tuned]), np.array([p.high for p in space.tuned])
    time = 56.0 + 0.1 * np.arange(frames + 1)
    leader = np.clip(8 + 5 * np.sin(0.25 * time + k) + 2.0 * np.sin(0.9 * time + 2 * k), 0, None)
    smooth = np.convolve(np.pad(leader, (12, 0), mode="edge"), np.ones(13) / 13, "valid")
    real = np.clip(smooth + 0.15 * np.sin(2 * time), 0, None)
    real_gap = 12 + 2 * (k % 4) + 0.1 * np.cumsum(leader - real)
    size = {
        "default": 2.6 * (1 + k % 3),
        "driver_specific": 0.9 * rng.uniform(0.6, 1.4),
        "policy": 0.75 * rng.uniform(0.5, 1.6),
    }
    size = {method: size.get(method, 1.3) for method in methods}
    wave = np.sin(0.45 * (time - time[0]) * (1 + 0.05 * k)) * (1 - np.exp(-(time - time[0]) / 2))
    speed = {method: np.clip(real + error * wave, 0, None) for method, error in size.items()}
    gap = {method: real_gap - 0.1 * np.cumsum(speed[method] - real) for method in size}
    best = low + (high - low) * rng.uniform(0.1, 0.5, len(low))
    windows = np.arange(frames + 1) // 5
    wander = np.cumsum(rng.normal(0, 0.012, (windows[-1] + 1, len(low))), axis=0)[windows]
    parameters = {
        "default": np.tile([p.default for p in space.tuned], (frames + 1, 1)),
        "driver_specific": np.tile(best, (frames + 1, 1)),
        "policy": np.clip(best + wander * (high - low), low, high),
        "pooled": np.tile(low + 0.3 * (high - low), (frames + 1, 1)),
        "shrunk": np.tile(low + 0.4 * (high - low), (frames + 1, 1)),
    }
    parameters = {method: parameters[method] for method in methods}
    number = 1000 + 7 * k
    return PairTrajectory(
        f"i80-0400-{number}-{number - 10}",
        f"i80-0400/{number}",
        time,
        leader,
        real,
        real_gap,
        speed,
        gap,
        parameters,
    )


def make_platoon(networks: dict[str, int], seconds: float = 40.0) -> Platoon:
    """Ten followers each that answer the leader's braking one after the other.

    Those of later networks answer more strongly.

    Args:
        networks: by method, how many.
    """
    time = np.round(np.arange(0, seconds, 0.5), 6)
    tables, measures = [], []
    for method, count in networks.items():
        for k in range(count):
            name, factor = f"fold {k}", 0.9 + 0.1 * k
            for vehicle in range(11):
                dip = (8.0 if vehicle == 0 else 8.0 * factor**vehicle) * np.exp(
                    -(((time - 18 - vehicle) / 3) ** 2)
                )
                speed = 15.0 - np.where(time - vehicle > 12, dip, 0.0)
                gap = np.full(len(time), np.nan if vehicle == 0 else 20.0 - 2.5 * k * vehicle)
                about = {"method": method, "network": name, "vehicle": vehicle}
                tables.append(pd.DataFrame({**about, "time_s": time, "speed": speed, "gap": gap}))
            row = {
                "method": method,
                "network": name,
                "drop_leader": 8.0,
                "drop_first": 8 * factor,
                "drop_last": 8 * factor**10,
            }
            row |= {
                "amplification": factor**9,
                "head_to_tail": factor**10,
                "string_stable": float(k < 2),
                "settled": 1.0,
            }
            measures.append(
                row
                | {"min_gap": 20 - 25.0 * k, "collisions": 3.0 * (k > 0), "hard_braking": 2.0 * k}
            )
    return Platoon(pd.concat(tables, ignore_index=True), pd.DataFrame(measures))


def make_history(
    trajectories: tuple[PairTrajectory, ...], gains: dict[tuple[str, str], float]
) -> pd.DataFrame:
    """What a policy gained, by base and amount of history."""
    rows = [
        {
            "pair_id": one.pair_id,
            "driver": one.driver,
            "base": base,
            "history_s": 50.0 + k if amount.endswith("%") else float(amount.split()[0]),
            "amount": amount,
            "rmse_speed": 0.5,
            "rmse_gap": 2.0,
            "improvement": gain + 0.01 * (-1) ** k,
        }
        for (base, amount), gain in gains.items()
        for k, one in enumerate(trajectories)
    ]
    return pd.DataFrame(rows)


FORECAST_METHODS = (
    "constant_speed",
    "constant_acceleration",
    "default",
    "pooled",
    "pooled_residual",
    "driver_specific",
    "driver_specific_residual",
    "policy",
)
FORECAST_COLUMNS = (
    "pair_id",
    "driver",
    "method",
    "history_s",
    "horizon_s",
    "speed_error",
    "position_error",
    "ade",
)
DISTRIBUTION_COLUMNS = (
    "pair_id",
    "driver",
    "method",
    "horizon_s",
    "crps_speed",
    "crps_gap",
    "energy_speed",
    "coverage",
    "min_ade",
    "pit",
    "likelihood_speed",
    "likelihood_gap",
    "likelihood_acceleration",
    "likelihood_jerk",
    "likelihood_time_to_collision",
)


def make_forecasts(drivers: int = 6, methods: tuple[str, ...] = FORECAST_METHODS) -> pd.DataFrame:
    """Errors that grow with the horizon and shrink with the history, another size per method."""
    rows = []
    for k, method in enumerate(methods):
        for driver in range(drivers):
            for history in np.arange(10.0, 40.0, 2.0):
                for horizon in (0.5, 2.0, 10.0):
                    error = (k + 1) * horizon * (1 + 5 / history) * (-1) ** driver / 10
                    row = (f"p{driver}", f"d{driver}", method, history, horizon)
                    rows.append((*row, error, 2 * error, abs(error)))
    return pd.DataFrame(rows, columns=list(FORECAST_COLUMNS))


def make_distributions(forecasts: pd.DataFrame, seed: int = 0) -> pd.DataFrame:
    """Scores of the same origins: the policy's paths are a third better than its centre."""
    rng = np.random.default_rng(seed)
    parts = []
    for method, share in (("pooled_ar", 1.2), ("driver_specific_ar", 1.1), ("policy", 0.67)):
        rows = forecasts[forecasts["method"] == "policy"]
        scores = dict.fromkeys(DISTRIBUTION_COLUMNS[4:], share * rows["ade"])
        scores["crps_speed"] = share * rows["speed_error"].abs()
        scores["coverage"] = (rng.random(len(rows)) < 0.85).astype(float)
        scores["pit"] = rng.beta(0.8, 0.8, len(rows))
        part = rows[["pair_id", "driver", "horizon_s"]].assign(method=method, **scores)
        parts.append(part[list(DISTRIBUTION_COLUMNS)])
    centre = parts[0].assign(method="driver_specific", coverage=np.nan, pit=np.nan)
    return pd.concat([*parts, centre], ignore_index=True)


GAINS = {
    ("driver_specific", "0 s"): -0.1,
    ("driver_specific", "10 s"): 0.1,
    ("driver_specific", "80 %"): 0.2,
    ("pooled", "80 %"): 0.05,
}


def about_of(k: int, one: PairTrajectory, space: ParameterSpace) -> list[dict[str, object]]:
    """What is known of a pair, a row per method."""
    follower, leader = one.pair_id.split("-")[-2:]
    rows = []
    for method in one.speed:
        row: dict[str, object] = {
            "pair_id": one.pair_id,
            "recording": "i80-0400",
            "leader_id": leader,
            "follower_id": follower,
            "driver": one.driver,
            "cluster": k % 3,
            "style_score": 0.2 + 0.005 * k,
            "fold": 0,
            "method": method,
            "frames": len(one.time) - 1,
        }
        for j, p in enumerate(space.tuned):
            row[f"parameter_{p.name}"] = float(one.parameters[method][:, j].mean())
        rows.append(row)
    return rows


def info(name: str, *scopes: str, summary: str = "mean") -> MetricInfo:
    """What tables need to know of a metric; of the test part unless scopes are named."""
    return MetricInfo(
        name=name,
        unit="m/s",
        direction="lower",
        summary=summary,
        heading=name.replace("_", " "),
        meaning=f"the {name}",
        scopes=scopes or ("test",),
        headline=name in HEADLINES,
        distribution="cfx-driving",
    )


HEADLINES = ("rmse_speed", "rmse_gap", "collisions")
MEASURED = (
    info("rmse_speed"),
    info("rmse_gap"),
    info("collisions", summary="sum"),
)


def make_values(trajectories: tuple[PairTrajectory, ...]) -> pd.DataFrame:
    """The long table of `MEASURED` for the test part."""
    rows = []
    for one in trajectories:
        for method in one.speed:
            speed, gap = one.speed[method], one.gap[method]
            found = {
                "rmse_speed": float(np.sqrt(np.mean((speed - one.real_speed) ** 2))),
                "rmse_gap": float(np.sqrt(np.mean((gap - one.real_gap) ** 2))),
                "collisions": float((gap < 0).any()),
            }
            for metric, value in found.items():
                rows.append((one.pair_id, one.driver, method, "test", metric, value))
    return pd.DataFrame(rows, columns=list(VALUE_COLUMNS))


def with_metric(
    evaluation: Evaluation,
    metric: str,
    by_method: Mapping[str, float],
    *,
    scope: str = "test",
    summary: str = "mean",
) -> Evaluation:
    """Adds a metric whose value is the same for all pairs of a method."""
    rows = []
    for one in evaluation.trajectories:
        for method, value in by_method.items():
            rows.append((one.pair_id, one.driver, method, scope, metric, float(value)))
    added = pd.DataFrame(rows, columns=list(VALUE_COLUMNS))
    infos = {one.name: one for one in evaluation.measured}
    scopes = (*infos[metric].scopes, scope) if metric in infos else (scope,)
    if metric in infos:
        infos[metric] = dataclasses.replace(infos[metric], scopes=scopes)
    else:
        infos[metric] = info(metric, *scopes, summary=summary)
    return dataclasses.replace(
        evaluation,
        values=pd.concat([evaluation.values, added], ignore_index=True),
        measured=tuple(infos.values()),
    )


def make_style(drivers: list[str], rng: np.random.Generator) -> StyleResult:
    scores = np.clip(rng.normal(0.47, 0.13, len(drivers)), 0.02, 0.98)
    cuts = (float(np.quantile(scores, 0.25)), float(np.quantile(scores, 0.75)))
    cluster = np.digitize(scores, cuts)
    table = pd.DataFrame(
        {
            "driver": drivers,
            "score": scores,
            "cluster": cluster,
            "cluster_name": [CLUSTERS[c] for c in cluster],
        }
        | {name: rng.uniform(0.1, 5, len(drivers)) for name in INDICATORS}
    )
    return StyleResult(
        table, dict(zip(INDICATORS, rng.dirichlet(np.full(6, 4.0)), strict=True)), cuts
    )


def make_curves(networks: int, epochs: int, seed: int = 0) -> pd.DataFrame:
    """Learning curves; validation every second epoch, and some networks stopped early."""
    rng = np.random.default_rng(seed)
    frames = [pd.DataFrame({"network": [], "epoch": [], "train_loss": [], "validation_loss": []})][
        : 0 if networks else 1
    ]
    for k in range(networks):
        stop = epochs if k % 3 else max(1, epochs * 2 // 3)
        epoch = np.arange(stop)
        train = rng.uniform(0.02, 0.05) + rng.uniform(0.3, 0.7) * np.exp(
            -epoch / rng.uniform(6, 12)
        )
        train *= rng.lognormal(0, 0.05, stop)
        validation = np.where(epoch % 2 == 0, 1.2 * train + 0.0004 * epoch, np.nan)
        frames.append(
            pd.DataFrame(
                {
                    "network": f"pair {k}",
                    "epoch": epoch,
                    "train_loss": train,
                    "validation_loss": validation,
                }
            )
        )
    return pd.concat(frames, ignore_index=True)

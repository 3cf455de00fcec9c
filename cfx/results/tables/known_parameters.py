"""What a posterior says of parameters, in words and numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import pandas as pd
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from cfx.calibration.settings import (
    CORRELATED,
    DIVERGENT,
    ENOUGH,
    INTERVAL_LEVEL,
    MAX_PARETO_K,
    MIN_NARROWING,
    MIXED,
    OFF,
    UNLIKELY,
    are_contradicted,
    are_reliable,
)
from cfx.core.parameters import Parameter
from cfx.evaluation.result import Evaluation

_NOISE = {
    "trajectory": "errors of a whole trajectory, which last for seconds",
    "measurement": "white errors of the measurement",
    "acceleration": "the driver's acceleration, which differs from the model's",
    "both": "the driver's acceleration and errors of the measurement",
}


def noise_evidence(tables: Mapping[str, pd.DataFrame]) -> dict[str, float]:
    """Returns the log evidence of each kind of noise, of all pairs together.

    Args:
        tables: of a job; without `noise` there is none.
    """
    if "noise" not in tables:
        return {}
    totals = tables["noise"].groupby("noise")["log_evidence"].sum()
    return dict(zip(totals.index.astype(str), totals.astype(float), strict=True))


@dataclass(frozen=True)
class KnownParameters:
    """What a job's fits say of how well drivers' parameters are known.

    Attributes:
        rows: the posterior's columns, a row per pair.
        parameters: those that were calibrated.
        evidence: log evidence of each kind of noise that was tried, of all pairs together; empty
            where the posterior knows one alone.
    """

    rows: pd.DataFrame
    parameters: tuple[Parameter, ...]
    evidence: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, evaluation: Evaluation) -> KnownParameters | None:
        """Returns them; None where the job asked for no posterior."""
        fits = evaluation.tables.get("fits")
        if fits is None or "noise_scale" not in fits:
            return None
        tuned = []
        for parameter in evaluation.parameters:
            if f"median_{parameter.name}" in fits:
                tuned.append(parameter)
        evidence = noise_evidence(evaluation.tables)
        return cls(fits[fits["method"] == "driver_specific"], tuple(tuned), evidence)

    @property
    def reliable(self) -> pd.Series:
        """Whether a pair's intervals are to be relied on."""
        return are_reliable(self.rows)

    def determined(self, name: str) -> int:
        """Returns how many pairs' recordings determine a parameter, as far as that is known."""
        return int(((self.rows[f"contraction_{name}"] >= MIN_NARROWING) & self.reliable).sum())

    def metrics(self) -> dict[str, float]:
        """Returns what MLflow keeps too.

        `posterior/determined/NAME`, `posterior/reliable` and `posterior/contradicted` are shares of
        pairs, `posterior/held` is the mean over pairs, `posterior/noise_left`,
        `posterior/effective_samples` and `posterior/expected_coverage` (`sbi`) are medians.
        """
        values = {}
        for parameter in self.parameters:
            share = self.determined(parameter.name) / len(self.rows)
            values[f"posterior/determined/{parameter.name}"] = share
        values["posterior/reliable"] = float(self.reliable.mean())
        for name in ("noise_left", "effective_samples", "expected_coverage"):
            if name in self.rows:
                values[f"posterior/{name}"] = float(self.rows[name].median())
        if self.checked:
            values["posterior/held"] = float(self.rows["held"].mean())
            values["posterior/contradicted"] = float(are_contradicted(self.rows).mean())
        return values

    @property
    def checked(self) -> bool:
        """Whether forecasts were compared with held-out parts."""
        return "held" in self.rows and bool(self.rows["held"].notna().any())

    def printed(self) -> list[RenderableType]:
        """Returns the table of parameters, then what is not determined, then a warning if due."""
        pairs = len(self.rows)
        words = "" if pairs == 1 else f", median of {pairs} pairs"
        table = Table(
            title=f"What the recordings say of parameters{words}: {INTERVAL_LEVEL:.0%} intervals",
            title_justify="left",
        )
        table.add_column("parameter")
        table.add_column("interval", justify="right")
        table.add_column("determined for", justify="right")
        undetermined = []
        for parameter in self.parameters:
            name = parameter.name
            columns = [f"median_{name}", f"low_{name}", f"high_{name}"]
            middle, low, high = self.rows[columns].median()
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            interval = f"{middle:.3g}{unit} ({low:.3g} to {high:.3g})"
            determined = self.determined(name)
            table.add_row(name, interval, f"{determined} of {pairs}")
            if determined < self.reliable.sum():
                undetermined.append(f"{name} for {self.reliable.sum() - determined}")
        sentences = self._doubts()
        if undetermined:
            sentences.append(
                f"Hardly known after these recordings: {', '.join(undetermined)} of {pairs} pairs"
                f" (intervals less than {MIN_NARROWING:.0%} narrower than the prior's;"
                " contraction_NAME in fits.parquet)."
            )
        sentences += self._noise()
        left = float(self.rows["noise_left"].median())
        if abs(left) > CORRELATED:
            sentences.append(
                f"What the noise's model leaves is still correlated ({left:.2f} from step to step):"
                " intervals may be too narrow; try calibration.noise_order=2 or longer steps"
                " (calibration.noise_step_s)."
            )
        return [table, *map(Text, sentences)]

    def _noise(self) -> list[str]:
        """Returns where noise enters, and whether forecasts with it hold what happened."""
        sentences = []
        if "noise" in self.rows:
            name = str(self.rows["noise"].iloc[0])
            sentence = f"Noise: {_NOISE[name]} (calibration.noise={name})"
            others = dict(self.evidence)
            evidence = others.pop(name, math.nan)
            if others:
                second = max(others, key=others.__getitem__)
                behind = evidence - others[second]
                sentence += (
                    f", the most evident kind; {second} comes next, {behind:.0f} nats behind"
                )
            sentences.append(f"{sentence}.")
        if "likelihood_power" in self.rows:
            power = float(self.rows["likelihood_power"].iloc[0])
            sentences.append(
                f"Each step counts {power:g} times (likelihood_power): the model's regimes jump,"
                " and intervals would be too narrow otherwise."
            )
        pairs = len(self.rows)
        if "held" in self.rows and not self.checked:
            sentences.append(
                "Nothing was held out (split=1), so that nothing checks these intervals."
            )
        if self.checked:
            contradicted = int(are_contradicted(self.rows).sum())
            sentence = (
                f"Forecasts from these posteriors hold {self.rows['held'].mean():.0%} of the"
                f" held-out parts ({INTERVAL_LEVEL:.0%} would be right)"
            )
            # Posteriors that are right are contradicted with the probability UNLIKELY each, which
            # is a binomial number of pairs: its mean and two standard deviations are no surprise.
            allowed = UNLIKELY * pairs + 2.0 * math.sqrt(UNLIKELY * (1.0 - UNLIKELY) * pairs)
            if contradicted > allowed:
                sentence += (
                    f"; of {contradicted} of {pairs} pairs less than chance allows (held_chance"
                    f" below {UNLIKELY:g} in fits.parquet): doubt the intervals, the model or its"
                    " noise is not theirs"
                )
            sentences.append(f"{sentence}.")
        return sentences

    def _doubts(self) -> list[str]:
        """Returns which pairs' intervals are not to be relied on, and which are rough."""
        sentences = []
        pairs = len(self.rows)
        doubtful = list(self.rows["pair_id"][~self.reliable])
        if doubtful:
            named = ", ".join(map(str, doubtful[:3])) + (" ..." if len(doubtful) > 3 else "")
            reason = f"samples of these posteriors do not settle (pareto_k above {MAX_PARETO_K}"
            if "divergences" in self.rows:
                reason = (
                    f"chains differ or leave out a part (r_hat above {MIXED} or divergences above"
                    f" {DIVERGENT}"
                )
            elif "r_hat" in self.rows:
                reason = f"chains differ (r_hat above {MIXED}"
            consequence = "too narrow"
            if "expected_coverage" in self.rows:
                consequence = "the network's alone"
            sentences.append(
                f"Do not rely on the intervals of {len(doubtful)} of {pairs} pairs ({named}):"
                f" {reason} in fits.parquet), and such intervals are {consequence}."
            )
        if "expected_coverage" in self.rows:
            coverage = float(self.rows["expected_coverage"].median())
            if abs(coverage - INTERVAL_LEVEL) > OFF:
                sentences.append(
                    f"Intervals of the network alone hold {coverage:.0%} of simulated drivers'"
                    f" parameters instead of {INTERVAL_LEVEL:.0%} (expected_coverage in"
                    " fits.parquet): it has learned too little."
                )
        few = int((self.reliable & (self.rows["effective_samples"] < ENOUGH)).sum())
        if few:
            sentences.append(
                f"The intervals of {few} of {pairs} pairs rest on fewer than {ENOUGH:.0f}"
                " independent samples (effective_samples in fits.parquet): their ends are rough."
            )
        return sentences

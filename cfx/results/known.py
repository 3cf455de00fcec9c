"""What is said of how well drivers' parameters are known: metrics, a table and some sentences."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from cfx.calibration.settings import (
    DETERMINED,
    DIVERGENT,
    ENOUGH,
    LEVEL,
    MIXED,
    OFF,
    RELIABLE,
    reliable,
)
from cfx.core.parameters import Parameter
from cfx.results.table import Findings

_CORRELATED = 0.3
"""Correlation that noise may keep before the job says so."""


@dataclass(frozen=True)
class KnownParameters:
    """The posterior's columns of a job's fits.

    Attributes:
        rows: a row per pair.
        parameters: those that were calibrated.
    """

    rows: pd.DataFrame
    parameters: tuple[Parameter, ...]

    @classmethod
    def of(cls, findings: Findings) -> KnownParameters | None:
        """Returns them; None where the job asked for no posterior."""
        evaluation = findings.evaluation
        fits = evaluation.tables.get("fits")
        if fits is None or "noise_scale" not in fits:
            return None
        tuned = tuple(one for one in evaluation.parameters if f"median_{one.name}" in fits)
        return cls(fits[fits["method"] == "fixed"], tuned)

    def determined(self, name: str) -> int:
        """Returns how many pairs' recordings determine a parameter, as far as that is known."""
        return int(((self.rows[f"contraction_{name}"] >= DETERMINED) & self.reliable).sum())

    @property
    def reliable(self) -> pd.Series:
        """Whether a pair's intervals are to be relied on."""
        return reliable(self.rows)

    def metrics(self) -> dict[str, float]:
        """Returns what MLflow keeps too.

        `posterior/determined/NAME` and `posterior/reliable` are shares of pairs,
        `posterior/noise_left`, `posterior/effective_samples` and `posterior/expected_coverage`
        (`sbi`) medians.
        """
        found = {}
        for one in self.parameters:
            found[f"posterior/determined/{one.name}"] = self.determined(one.name) / len(self.rows)
        found["posterior/reliable"] = float(self.reliable.mean())
        for name in ("noise_left", "effective_samples", "expected_coverage"):
            if name in self.rows:
                found[f"posterior/{name}"] = float(self.rows[name].median())
        return found

    def printed(self) -> list[RenderableType]:
        """Returns the table of parameters, then what is not determined, then a warning if due."""
        pairs = len(self.rows)
        words = "" if pairs == 1 else f", median of {pairs} pairs"
        table = Table(
            title=f"What the recordings say of parameters{words}: {LEVEL:.0%} intervals",
            title_justify="left",
        )
        table.add_column("parameter")
        table.add_column("interval", justify="right")
        table.add_column("determined for", justify="right")
        for one in self.parameters:
            middle = float(self.rows[f"median_{one.name}"].median())
            low = float(self.rows[f"low_{one.name}"].median())
            high = float(self.rows[f"high_{one.name}"].median())
            unit = "" if one.unit == "1" else f" {one.unit}"
            interval = f"{middle:.3g}{unit} ({low:.3g} to {high:.3g})"
            table.add_row(one.name, interval, f"{self.determined(one.name)} of {pairs}")
        return [table, *map(Text, self._sentences())]

    def _sentences(self) -> list[str]:
        sentences = []
        pairs = len(self.rows)
        doubtful = list(self.rows["pair_id"][~self.reliable])
        if doubtful:
            named = ", ".join(map(str, doubtful[:3])) + (" ..." if len(doubtful) > 3 else "")
            why = f"samples of these posteriors do not settle (pareto_k above {RELIABLE}"
            if "r_hat" in self.rows:
                why = (
                    f"chains differ or leave out a part (r_hat above {MIXED} or divergences above"
                    f" {DIVERGENT}"
                )
            such = "too narrow"
            if "expected_coverage" in self.rows:
                such = "the network's alone"
            sentences.append(
                f"Do not rely on the intervals of {len(doubtful)} of {pairs} pairs ({named}):"
                f" {why} in fits.parquet), and such intervals are {such}."
            )
        if "expected_coverage" in self.rows:
            held = float(self.rows["expected_coverage"].median())
            if abs(held - LEVEL) > OFF:
                sentences.append(
                    f"Intervals of the network alone hold {held:.0%} of simulated drivers'"
                    f" parameters instead of {LEVEL:.0%} (expected_coverage in fits.parquet): it"
                    " has learned too little."
                )
        few = int((self.reliable & (self.rows["effective_samples"] < ENOUGH)).sum())
        if few:
            sentences.append(
                f"The intervals of {few} of {pairs} pairs rest on fewer than {ENOUGH:.0f}"
                " independent samples (effective_samples in fits.parquet): their ends are rough."
            )
        open_ones = []
        for one in self.parameters:
            left_open = int(self.reliable.sum()) - self.determined(one.name)
            if left_open:
                open_ones.append(f"{one.name} for {left_open}")
        if open_ones:
            sentences.append(
                f"Hardly known after these recordings: {', '.join(open_ones)} of {pairs} pairs"
                f" (intervals less than {DETERMINED:.0%} narrower than the prior's;"
                " contraction_NAME in fits.parquet)."
            )
        left = float(self.rows["noise_left"].median())
        if abs(left) > _CORRELATED:
            sentences.append(
                f"What the noise's model leaves is still correlated ({left:.2f} from step to step):"
                " intervals may be too narrow; try calibration.noise_order=2 or longer steps"
                " (calibration.noise_step_s)."
            )
        return sentences

"""Finished jobs beside one another: which is closest to the drivers, and is it chance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cfx.evaluation.metrics.base import RMSE_SPEED, MetricInfo
from cfx.evaluation.statistics import Ranking, ranking_of, verdict

if TYPE_CHECKING:
    import pandas as pd

    from cfx.results.result import Result

__all__ = [
    "Comparison",
    "common_judge",
    "objective_of",
]
"""What plugins may use, as `cfx.plugin.comparison`."""


def objective_of(judge: MetricInfo, data: Mapping[str, Any]) -> str:
    """Returns what says whether two jobs minimised the same: the error, and its settings."""
    return f"{judge.name} {data.get('objective')}"


def common_judge(jobs: Iterable[tuple[MetricInfo, str]]) -> MetricInfo:
    """Returns the error by which jobs are compared: what all minimised, else the RMSE of speed.

    Args:
        jobs: of each the error by which it is judged, and what `objective_of` says of it.
    """
    judges = _judges(jobs)
    if len(judges) != 1:
        return RMSE_SPEED
    (judge,) = judges.values()
    return judge


def minimised_the_same(jobs: Iterable[tuple[MetricInfo, str]]) -> bool:
    """Says whether no two jobs minimised different errors; `jobs` as of `common_judge`."""
    return len(_judges(jobs)) <= 1


def _judges(jobs: Iterable[tuple[MetricInfo, str]]) -> dict[str, MetricInfo]:
    """Returns each different objective of jobs, with the error that it is judged by."""
    return {objective: judge for judge, objective in jobs}


@dataclass(frozen=True, repr=False)
class Comparison:
    """Jobs by the error of the method that each is judged by, on the same held-out frames.

    Attributes:
        judge: the error by which they are compared.
        ranking: the smallest error first, and the best one against each other.
        same_objective: whether all jobs minimised this error.
    """

    judge: MetricInfo
    ranking: Ranking
    same_objective: bool

    @classmethod
    def of(cls, jobs: Mapping[str, Sequence[Result]]) -> Comparison:
        """Compares jobs.

        Args:
            jobs: by name; several of one name, which differ in the seed alone, count as one: their
                errors are averaged.
        """
        objectives: list[tuple[MetricInfo, str]] = []
        for alike in jobs.values():
            for job in alike:
                objectives.append((job.judge, objective_of(job.judge, job.data)))
        judge = common_judge(objectives)
        errors: dict[str, list[pd.DataFrame]] = {}
        for name, alike in jobs.items():
            errors[name] = [job.errors_by(judge.name) for job in alike]
        return cls(judge, ranking_of(errors), minimised_the_same(objectives))

    @property
    def table(self) -> pd.DataFrame:
        """A row per job that is ranked, the smallest error first.

        Columns: error, its mean over pairs; and the best job's improvement over it, in percent,
        with its 95 % interval over drivers, and p after Holm.
        """
        import pandas as pd

        rows: list[dict[str, float]] = [{} for _ in self.ranking.jobs]
        for row, against in zip(rows[1:], self.ranking.against, strict=True):
            improvement = against.improvement
            row["best is closer by %"] = 100 * improvement.geometric
            row["from %"] = 100 * improvement.ci95_low
            row["to %"] = 100 * improvement.ci95_high
            row["p"] = against.p_value
        table = pd.DataFrame(rows, index=pd.Index(self.ranking.jobs, name="job"))
        table.insert(0, self.judge.title, list(self.ranking.errors))
        return table

    def sentences(self) -> list[str]:
        """Returns how the jobs were compared, and which is closest to the drivers."""
        sentences = []
        if not self.same_objective:
            sentences.append(
                "The jobs minimised different errors: they are ranked by the"
                f" {self.judge.heading} on the test part."
            )
        judgement = verdict(self.ranking)
        return [*sentences, judgement] if judgement else sentences

    def __repr__(self) -> str:
        """Returns the table and the verdict, for people."""
        table = self.table.to_string(float_format=lambda value: f"{value:.3g}", na_rep="")
        return "\n".join([table, *self.sentences()])

"""What a metric is, what it is given, and which ones a job measures.

Shapes: P pairs, K + 1 frames, n tuned parameters. Frame 0 is the measured state that the simulation
starts from. SI units.
"""

from __future__ import annotations

import logging
import re
from abc import abstractmethod
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

from cfx.core import registry
from cfx.core.component import Component
from cfx.core.distributions import ALL_OWN, OWN
from cfx.core.registry import Installed
from cfx.errors import PluginError

if TYPE_CHECKING:
    from torch import Tensor

    from cfx.core.parameters import ParameterSpace

log = logging.getLogger(__name__)

Scope = Literal["test", "steady", "full_trajectory"]

SCOPES: tuple[Scope, ...] = ("test", "steady", "full_trajectory")
"""Which frames count, in the order in which they are shown.

`test`: the test part. `steady`: the test part after the transient (`TRANSIENT_S`).
`full_trajectory`: everything from the first frame on, by methods that nothing of these drivers went
into.
"""

RECORDED = "real"
"""The method under which the recorded drivers stand in tables and names of metrics."""

DIRECTIONS = ("lower", "higher", "none")
SUMMARIES = ("mean", "sum", "min", "max")


@dataclass(frozen=True)
class Trajectories:
    """P simulated trajectories beside the recorded ones, on the same frames.

    A frame that does not count (`counted`) may hold anything, NaN included, and must not matter.
    The acceleration at a frame is that on the way to it: `(speed[:, k] - speed[:, k - 1]) / dt`.
    The leader is the recorded one for both, so the difference of two positions of the follower is
    the difference of the gaps with the other sign.

    Attributes:
        speed, gap: `(P, K + 1)`, m/s and m, simulated; the gap is bumper to bumper.
        measured_speed, measured_gap: `(P, K + 1)`, the same as recorded.
        leader_speed: `(P, K + 1)`, m/s, recorded.
        parameters: `(P, K + 1, n)`, SI units, what held on the way to each frame; NaN for recorded
            drivers.
        counted: `(P, K + 1)` bool, which frames count; frame 0 never does.
        dt: time step, s.
        space: the tuned parameters, in the bounds within which they were chosen.
        at_limits: `(P, K + 1)` bool, frames at a limit of acceleration; None: unknown.
        outside: `(P, K + 1)` bool, frames outside what a policy has learned from; None: unknown,
            or no policy drove.
    """

    speed: Tensor
    gap: Tensor
    measured_speed: Tensor
    measured_gap: Tensor
    leader_speed: Tensor
    parameters: Tensor
    counted: Tensor
    dt: float
    space: ParameterSpace
    at_limits: Tensor | None = None
    outside: Tensor | None = None

    def __len__(self) -> int:
        return len(self.speed)


class Metric(Component):
    """Base of every metric: one number for each pair, and what it means.

    Life cycle: a job makes its metrics before any work begins: cfx's own, and those of plugins that
    `metrics` names. It calls `compute` for each method and scope when all methods have been
    simulated; where `is_of_recording`, also for the recording, whose value stands in
    `metrics.json` as `NAME/real` and in `pairs.csv` as `real_NAME`. A metric has no settings, so
    that its name means the same number in every job.

    Attributes:
        unit: of the number, "" for a ratio.
        direction: whether "lower" or "higher" numbers are better; "none" where neither is.
        summary: how the pairs become one number: "mean", "sum", "min" or "max" of those that are
            defined.
        heading: of a column, short and without the unit.
        meaning: one sentence for a reader who knows no other document.
        scopes: frames for which the summary stands in `metrics.json`, `pairs.csv` and MLflow. The
            table of all values, `pair_metrics.parquet`, holds every scope.
        is_error: it is a distance from the recording, and 0 for a simulation without error.
        is_of_recording: it says something of a recorded driver too, who then stands beside the
            methods.
        headline: it is shown in the tables that a job and a sweep print.
        order: its place in tables; smaller numbers come first.
    """

    kind = "metric"
    unit: ClassVar[str]
    direction: ClassVar[Literal["lower", "higher", "none"]]
    heading: ClassVar[str]
    meaning: ClassVar[str]
    summary: ClassVar[Literal["mean", "sum", "min", "max"]] = "mean"
    scopes: ClassVar[tuple[Scope, ...]] = ("test",)
    is_error: ClassVar[bool] = False
    is_of_recording: ClassVar[bool] = False
    headline: ClassVar[bool] = True
    order: ClassVar[int] = 100

    @classmethod
    def complaint(cls) -> str:
        for name in ("unit", "direction", "heading", "meaning", "summary"):
            if not isinstance(getattr(cls, name, None), str):
                return f" must say its `{name}`, a text"
        for name in ("heading", "meaning"):
            if not getattr(cls, name).strip():
                return f" must say its `{name}`: tables explain their columns with it"
        allowed: Sequence[tuple[str, Sequence[str]]] = (
            ("direction", DIRECTIONS),
            ("summary", SUMMARIES),
        )
        for name, choices in allowed:
            if getattr(cls, name) not in choices:
                return f" says {name}={getattr(cls, name)!r}; choose one of {', '.join(choices)}"
        if not cls.scopes or set(cls.scopes) - set(SCOPES):
            return f" says scopes={cls.scopes!r}; choose some of {', '.join(SCOPES)}"
        if cls.schema.model_fields:
            return " must have no settings, so that its name means the same number in every job"
        return ""

    @abstractmethod
    def compute(self, trajectories: Trajectories) -> Tensor:
        """Measures P trajectories: pure, batched, over the frames that count.

        Returns:
            `(P,)` floating point; NaN where the metric is not defined.
        """


@dataclass(frozen=True)
class MetricInfo:
    """What tables, figures and reports need to know of a metric; attributes as in `Metric`.

    Attributes:
        name: under which it was found.
        scopes: those that `Metric.scopes` names and that were measured.
        distribution: who brings it.
    """

    name: str
    unit: str
    direction: str
    summary: str
    heading: str
    meaning: str
    scopes: tuple[str, ...]
    headline: bool
    distribution: str

    def to_json(self) -> dict[str, Any]:
        """Returns the item of the list `metrics` in `data.json`."""
        return {**asdict(self), "scopes": list(self.scopes)}

    @property
    def title(self) -> str:
        """The heading with its unit: `RMSE speed [m/s]`."""
        if not self.unit:
            return self.heading
        return f"{self.heading} [{self.unit}]"


def key_of(metric: str, method: str, scope: str = "test") -> str:
    """Returns the name of a metric's summary in `metrics.json` and MLflow."""
    if scope == "test":
        return f"{metric}/{method}"
    return f"{scope}/{metric}/{method}"


def column_of(metric: str, scope: str = "test") -> str:
    """Returns the column of `pairs.csv` with a metric of each pair and method."""
    if scope == "test":
        return metric
    return f"{scope}_{metric}"


RMSE_SPEED = MetricInfo(
    name="rmse_speed",
    unit="m/s",
    direction="lower",
    summary="mean",
    heading="RMSE of speed",
    meaning="root mean square difference between the simulated and the measured speed",
    scopes=SCOPES,
    headline=True,
    distribution=OWN,
)
"""The error by which a job is judged whose objective is not known."""

OBJECTIVE = "objective"
"""The name of a metric that is the job's objective itself."""

ALWAYS = ("rmse_speed", "rmse_gap", "collisions")
"""Measured in every job: the comparison of methods, the figures and the reports rest on them."""

_TAKEN = re.compile(
    r"(steady|full_trajectory|real|improvement|parameter|platoon|history|labels|objective)(_.*)?"
    r"|pair_id|recording|(leader|follower)_id|driver|cluster|style_score|fold|method|frames"
    r"|(train|validation)_loss|all"
)
"""Names of other columns of `pairs.csv` and of other metrics of a job."""


def info_of(
    installed: Installed[Metric], measured: Collection[str], *, judges: bool = False
) -> MetricInfo:
    """Returns what tables, figures and reports need to know of a metric.

    Args:
        installed: the metric.
        measured: the scopes in which it was measured.
        judges: the job is judged by it: it is shown everywhere, of each scope.
    """
    metric = installed.component
    scopes = []
    for scope in SCOPES if judges else metric.scopes:
        if scope in measured:
            scopes.append(scope)
    return MetricInfo(
        name=installed.name,
        unit=metric.unit,
        direction=metric.direction,
        summary=metric.summary,
        heading=metric.heading,
        meaning=metric.meaning,
        scopes=tuple(scopes),
        headline=metric.headline or judges,
        distribution=installed.distribution,
    )


@dataclass(frozen=True)
class LeftOut:
    """A plugin's metric that could not be measured, and why."""

    name: str
    distribution: str
    reason: str


@dataclass(frozen=True)
class MetricSet:
    """The metrics of a job in the order in which they are shown.

    Attributes:
        metrics: what is measured.
        left_out: what is installed and broken.
        judge: name of the error by which methods, and jobs, are compared.
    """

    metrics: tuple[Installed[Metric], ...]
    left_out: tuple[LeftOut, ...] = field(default=())
    judge: str = RMSE_SPEED.name

    @classmethod
    def of(cls, chosen: str | Sequence[str] = ALL_OWN) -> MetricSet:
        """Makes the metrics that are chosen, and those that every job measures.

        Args:
            chosen: as `entries_of`. Of all, a broken one of a plugin is left out with a warning.

        Raises:
            PluginError: there is no metric of a name, or one that is named is broken.
        """
        metrics, left_out = [], []
        for entry in entries_of(chosen):
            try:
                metrics.append(made(entry))
            except PluginError as error:
                if chosen != "all" or entry.distribution == OWN:
                    raise
                left_out.append(leave_out(entry.name, entry.distribution, str(error)))
        return cls(in_order(metrics), tuple(left_out))

    @classmethod
    def own(cls) -> MetricSet:
        """Makes cfx's own metrics."""
        metrics = [made(entry) for entry in registry.entries("metric") if entry.distribution == OWN]
        return cls(in_order(metrics))


def entries_of(chosen: str | Sequence[str] = ALL_OWN) -> tuple[registry.Entry, ...]:
    """Returns the entries of the metrics that a job measures; imports none.

    Args:
        chosen: `own`: cfx's own; `all`: all that are installed; or names, in which `own` may stand.

    Raises:
        PluginError: there is no metric of a name.
    """
    usable, own_names = [], set()
    for entry in registry.entries("metric"):
        if not registry.namesakes(entry):
            usable.append(entry)
            if entry.distribution == OWN:
                own_names.add(entry.name)
    if chosen == "all":
        return tuple(usable)
    names = {*ALWAYS, *([chosen] if isinstance(chosen, str) else chosen)}
    if ALL_OWN in names:
        names.remove(ALL_OWN)
        names |= own_names
    return tuple(registry.entry("metric", name) for name in sorted(names))


def leave_out(name: str, distribution: str, reason: str) -> LeftOut:
    """Returns a note of a broken metric, after one warning that names its distribution."""
    log.warning("The metric %s of the distribution %s is left out: %s", name, distribution, reason)
    return LeftOut(name, distribution, reason)


def made(entry: registry.Entry) -> Installed[Metric]:
    """Makes the metric of an entry.

    Raises:
        PluginError: its name stands for something else, or it is broken.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", entry.name) or _TAKEN.fullmatch(entry.name):
        raise PluginError(
            f"{entry}: a metric cannot be called '{entry.name}', which stands for something else in"
            " a job's results; its author must rename it (small letters, digits and _)"
        )
    metric = cast(Metric, registry.create("metric", {"name": entry.name}))
    return Installed("metric", entry.name, metric, entry.distribution)


def in_order(metrics: Sequence[Installed[Metric]]) -> tuple[Installed[Metric], ...]:
    """Returns metrics in the order in which they are shown."""
    return tuple(sorted(metrics, key=lambda metric: (metric.component.order, metric.name)))

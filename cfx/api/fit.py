"""Calibration from Python: constant parameters of each driver, pooled ones, and their errors.

Shapes: P pairs, n tuned parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from cfx.api.experiment import NOTHING_KEPT, Experiment, config, refuse_unused
from cfx.api.pairs import (
    PairIds,
    Pairs,
    PairsLike,
    chosen_names,
    pairs_from,
    read,
    without_data,
)
from cfx.calibration.settings import APART, doubts
from cfx.core.files import atomic_write
from cfx.core.guest import visit
from cfx.data.tidy import write_tidy
from cfx.errors import ConfigError, DataError
from cfx.evaluation.headline import ERRORS, FEW_DRIVERS
from cfx.results.comparison import Comparison
from cfx.results.result import Result

if TYPE_CHECKING:
    import torch
    from matplotlib.figure import Figure
    from torch import Tensor
    from xarray import DataTree

    from cfx.app.job.steps import JobComponents
    from cfx.calibration.posterior import DriverPosteriors
    from cfx.evaluation.protocols.base import ProtocolContext
    from cfx.policies.agent import Agent

METHODS = ("default", "pooled", "driver_specific")
"""What is compared: the model's defaults, pooled and driver-specific parameters."""

_RECORDING, _PARAMETERS = "recording.parquet", "parameters.parquet"
"""Files of a saved fit besides those of a job."""

_AT_BOUND = 0.01
"""So near to a bound, as a share of the distance between both, a value is at it."""


@dataclass(frozen=True, repr=False)
class Fit:
    """Calibrated parameters of a model; `cfx.calibrate` makes it.

    Attributes:
        experiment: the configuration, with the command that repeats it.
        recorded: what was calibrated on.
        parameters: a row per pair: driver-specific parameters, SI units.
        ends_apart: by which share of the loss independent ends of each pair's search differ. Above
            0.01 the optimum may have been missed; NaN where the optimizer has no such ends.
    """

    experiment: Experiment
    recorded: Pairs
    parameters: pd.DataFrame
    ends_apart: pd.Series = field(compare=False)
    _context: ProtocolContext = field(compare=False)
    _last: torch.Tensor = field(compare=False)

    @property
    def model(self) -> str:
        """Name of the driving model."""
        return str(self.experiment.config.model["name"])

    @property
    def command(self) -> str:
        """The command line that calibrates the same; see `Experiment.command`."""
        return self.experiment.command

    @cached_property
    def pooled(self) -> pd.Series:
        """One set of parameters for all these drivers, SI units, pooled over themselves.

        It minimises the mean of their losses on the same frames as driver-specific ones do; it is
        found when it is first asked for. A job's `pooled` is calibrated on other drivers.
        """
        import torch

        members = torch.ones((1, len(self._context.pairs)), dtype=torch.bool)
        with visit():
            table = _pooled_over(self._context, self._last, members, ["pooled"])
        return pd.Series(table.iloc[0], name="pooled")

    @property
    def defaults(self) -> pd.Series:
        """The model's default parameters, SI units."""
        space = self._context.space
        return pd.Series({name: space[name].default for name in space.names}, name="default")

    @cached_property
    def policy(self) -> Agent:
        """The pooled parameters as a policy that drives anybody: for `cfx.evaluate`, `forecast`."""
        from cfx.policies.constant import FixedPolicy
        from cfx.policies.core import ANY_DRIVER

        context = self._context
        with visit():
            values = self._tensor("pooled")[:1]
            agent = context.agents.constant(FixedPolicy(), values)
        return replace(agent, names=(ANY_DRIVER,), pooled=values.cpu())

    @cached_property
    def result(self) -> Result:
        """The same calibration as a job: its trajectories, metrics, tables and figures."""
        return self.experiment.run()

    @cached_property
    def losses(self) -> pd.DataFrame:
        """Errors of each pair and method: pair_id, driver, method, and RMSE of speed and gap.

        `train_rmse_speed` (m/s) and `train_rmse_gap` (m) are of the part that was calibrated on,
        `test_...` of the rest, simulated in closed loop from the last measured state before it;
        with `split=1` there is no rest. `ends_apart` is of `driver_specific`: see `Fit.ends_apart`.
        `method` is `default`, `pooled` or `driver_specific`.
        """
        with visit():
            return pd.concat([self._errors(method) for method in METHODS], ignore_index=True)

    @cached_property
    def summary(self) -> pd.DataFrame:
        """A row per parameter: its unit, default, pooled value, and the drivers' spread.

        Columns: unit, default, pooled, mean, std, 25%, 50%, 75%, at_bound (share of the pairs
        whose value is at a bound, where the recording does not determine it).
        """
        space = self._context.space
        table = self.parameters.describe().T[["mean", "std", "25%", "50%", "75%"]]
        units, at_bound = [], []
        for name in space.names:
            parameter = space[name]
            units.append(parameter.unit)
            place = (self.parameters[name] - parameter.low) / (parameter.high - parameter.low)
            at_bound.append(float(((place < _AT_BOUND) | (place > 1 - _AT_BOUND)).mean()))
        table.insert(0, "unit", units)
        table.insert(1, "default", self.defaults)
        table.insert(2, "pooled", self.pooled)
        table["at_bound"] = at_bound
        return table.rename_axis("parameter")

    @cached_property
    def intervals(self) -> pd.DataFrame:
        """What each recording says of its driver's parameters: 90 % intervals, a row per pair.

        `doubt` says why a row is not to be taken at its word; it is empty where nothing is known
        against it. The other columns are those of `fits.parquet`: `low_NAME`, `median_NAME`,
        `high_NAME` (SI units), `contraction_NAME` (0: the recording says nothing, 1: all), `noise`
        (where it enters), `held` (which share of the held-out part forecasts hold; 0.9 is right)
        and diagnostics.

        Raises:
            ConfigError: no posterior was asked for.
        """
        rows = pd.DataFrame(self._posterior.columns(), self.parameters.index)
        return rows.assign(doubt=doubts(rows))

    @cached_property
    def draws(self) -> pd.DataFrame:
        """Equally likely parameters of each driver, SI units: a row per pair_id and draw.

        Raises:
            ConfigError: no posterior was asked for.
        """
        draws_by_driver = self._posterior.draws
        rows = pd.MultiIndex.from_product(
            [self.parameters.index, range(draws_by_driver.shape[1])], names=["pair_id", "draw"]
        )
        return pd.DataFrame(draws_by_driver.flatten(0, 1).numpy(), rows, self.parameters.columns)

    def inference_data(self) -> DataTree:
        """Returns the draws as ArviZ reads them: its InferenceData, an `xarray.DataTree`.

        Groups: `posterior` with dimensions chain, draw and pair; `prior`, or `population`;
        `diagnostics` of each pair. It is what `cfx export JOB --to netcdf` writes of a job.

        Raises:
            ConfigError: no posterior was asked for, or it has no draws that ArviZ knows.
        """
        with visit():
            model = self._context.stepper.model
            return self._posterior.inference_data(list(self.parameters.index), model)

    def draw(self, drivers: int, *, seed: int = 0) -> pd.DataFrame:
        """Draws new drivers from the population of these: parameters as correlated as theirs.

        Args:
            drivers: how many.
            seed: the same seed gives the same drivers.

        Returns:
            A row per driver, SI units, as `cfx.simulate` takes them.

        Raises:
            ConfigError: no population was asked for (`calibration.posterior=hierarchical`).
        """
        from cfx.calibration.posterior import posterior_method

        posterior = self.experiment.config.calibration.posterior
        if posterior == "none" or not posterior_method(posterior).has_population:
            raise ConfigError(f"there is no population to draw from; {_ask_for('hierarchical')}")
        names = [f"driver {number}" for number in range(drivers)]
        rows = self._posterior.draw_drivers(drivers, seed).numpy()
        return pd.DataFrame(rows, names, self.parameters.columns)

    @cached_property
    def _posterior(self) -> DriverPosteriors:
        from cfx.calibration.posterior import posterior_method

        settings, context = self.experiment.config.calibration, self._context
        if settings.posterior == "none":
            raise ConfigError(f"there is no posterior; {_ask_for('laplace')}")
        with visit():
            driver_specific, solver = self._tensor("driver_specific"), context.calibrator.solver
            method = posterior_method(settings.posterior)
            return method.find(solver, context.batch, self._last, driver_specific, settings)

    def plot(self, name: str = "parameters", pair_id: PairIds | None = None) -> Figure:
        """Draws the fit.

        Args:
            name: `parameters`: between their bounds, and how they go together; `drives`: measured
                against simulated speed and gap on the test part; or another figure of a job
                (`cfx plugins` lists them), such as `posterior_fan` where a posterior was
                asked for.
            pair_id: of `drives`: which pairs; None: the best, the median and the worst.

        Raises:
            DataError: there is no such figure, or nothing of what it shows.
        """
        if name == "parameters":
            return self._plot_parameters()
        if name == "drives" and pair_id is not None:
            from cfx.figures.drawing import for_notebooks
            from cfx.results.figures.pair_lines import drives

            pair_ids = list(self.parameters.index)
            chosen = chosen_names(pair_id, pair_ids, "the fit")
            return for_notebooks(drives(self.result, chosen))
        return self.result.plot(name)

    def _plot_parameters(self) -> Figure:
        """Draws the parameters between their bounds, and how they go together."""
        from cfx.results.result import Result, described_parameters

        tables = []
        for method in METHODS:
            parameters = self._of(method).add_prefix("parameter_")
            tables.append(parameters.assign(method=method))
        rows = pd.concat(tables, ignore_index=True)
        described = {"parameters": described_parameters(self._context.space.tuned)}
        return Result(data=described, tables={"pairs": rows}).plot("calibration")

    def save(self, folder: str | Path) -> Path:
        """Writes the folder of the calibration as a job, with the recording; MLflow is not told.

        `cfx.load` reads it as a job, `cfx.Fit.load` as this fit.

        Args:
            folder: made if it is not there.

        Raises:
            OutputError: it cannot be written.
        """
        written = self.result.save(folder).folder
        assert written is not None
        with atomic_write(written / _RECORDING) as temporary:
            write_tidy(self.recorded.selected, temporary)
        with atomic_write(written / _PARAMETERS) as temporary:
            self.parameters.assign(ends_apart=self.ends_apart).to_parquet(temporary)
        return written

    @classmethod
    def load(cls, folder: str | Path) -> Fit:
        """Reads a fit that `save` has written.

        Raises:
            DataError: there is none.
        """
        place = Path(folder)
        if not all((place / file).is_file() for file in (_PARAMETERS, _RECORDING)):
            raise DataError(
                f"{place} holds no fit (that has {_PARAMETERS} and {_RECORDING}); Fit.save writes"
                " one, and cfx.load reads any other calibration"
            )
        from cfx.api.experiment import from_config

        recording = read(place / _RECORDING)
        experiment = replace(from_config(place), pairs=recording)
        parameters = pd.read_parquet(place / _PARAMETERS)
        with visit():
            components, context, last = _context_of(experiment, recording)
            components.engine.close()
        ends_apart = parameters.pop("ends_apart")
        return cls(experiment, recording, parameters, ends_apart, context, last)

    def _of(self, method: str) -> pd.DataFrame:
        """Returns a method's parameters, a row per pair."""
        if method == "driver_specific":
            return self.parameters
        same = self.pooled if method == "pooled" else self.defaults
        rows = np.tile(same.to_numpy(dtype=np.float64), (len(self.parameters), 1))
        return pd.DataFrame(rows, self.parameters.index, self.parameters.columns)

    def _tensor(self, method: str) -> Tensor:
        """Returns a method's parameters as `(P, n)`."""
        import torch

        batch = self._context.batch
        values = torch.tensor(self._of(method).to_numpy(dtype=np.float64))
        return values.to(batch.leader_length)

    def _errors(self, method: str) -> pd.DataFrame:
        """Returns a method's rows of `losses`."""
        import torch

        from cfx.calibration.identifiability import training_errors
        from cfx.evaluation.closed_loop import Followers, simulate_in_shards
        from cfx.evaluation.evaluate import closed_loop_errors
        from cfx.policies.constant import FixedPolicy

        context, parameters = self._context, self._tensor(method)
        batch = context.batch
        first = self._last.to(batch.lengths.device)
        train = training_errors(context.calibrator, batch, first, parameters)
        errors = {
            "pair_id": context.pairs.ids,
            "driver": context.pairs.drivers,
            "method": method,
            "train_rmse_speed": train["rmse_speed"].cpu().numpy(),
            "train_rmse_gap": train["rmse_gap"].cpu().numpy(),
        }
        if method == "driver_specific" and self.ends_apart.notna().any():
            errors["ends_apart"] = self.ends_apart.to_numpy()
        if context.split < 1:
            agent = context.agents.constant(FixedPolicy(), parameters)
            each = torch.arange(len(batch), device=batch.lengths.device)
            loop = simulate_in_shards(
                context.engine, context.stepper, agent, Followers(batch, each), first
            )
            speed, gap = closed_loop_errors(batch, first, loop)
            errors |= {"test_rmse_speed": speed, "test_rmse_gap": gap}
        return pd.DataFrame(errors)

    def __repr__(self) -> str:
        from cfx.figures.wording import plural, short_label

        context = self._context
        judge = context.calibrator.solver.objective.metric or "rmse_speed"
        part, where = ("test", "the test part") if context.split < 1 else ("train", "all of it")
        lines = []
        for metric in dict.fromkeys((judge, "rmse_speed", "rmse_gap")):
            name = f"{part}_{metric}"
            if name in self.losses:
                means = self.losses.groupby("method")[name].mean()
                errors = []
                for method in METHODS:
                    errors.append(f"{short_label(method)} {means[method]:.3f}")
                heading, unit = ERRORS[metric]
                lines.append(f"{heading}, {unit}: {', '.join(errors)}")
        few = self.losses["driver"].nunique()
        about = plural(len(self.parameters), "pair")
        if few < FEW_DRIVERS:
            about += f" of only {plural(few, 'driver')}"
        missed = int((self.ends_apart > APART).sum())
        if missed:
            lines.append(f"the optimum of {plural(missed, 'pair')} may have been missed")
        pooled = "pooled over these drivers, on what was calibrated on"
        return f"Fit({self.model}, {about}; on {where}, {pooled};\n  " + ";\n  ".join(lines) + ")"

    def _repr_html_(self) -> str:
        from cfx.figures.drawing import as_html

        return as_html(repr(self), self.summary)


def _ask_for(posterior: str) -> str:
    """Returns how a calibration asks for a posterior."""
    return f"say cfx.calibrate(..., posterior='{posterior}')"


_NOT_TRAINED = {
    "policy": "parameters are calibrated, no policy is trained",
    "learner": "parameters are calibrated, no policy is trained",
    "protocol": "each driver is calibrated on the first part of their trajectory",
}
"""Settings that do nothing in a calibration, and why."""

_NOT_POOLED = {
    "calibration.posterior": "intervals are of driver-specific parameters",
}
"""Settings that do nothing where parameters are pooled alone, and why."""


def calibrate(
    pairs: PairsLike,
    model: str = "idm",
    *,
    objective: str = "speed_rmse",
    posterior: str = "none",
    seed: int = 0,
    **settings: Any,
) -> Fit:
    """Calibrates a model to each driver, as `python -m cfx model=MODEL policy=fixed` does.

    The first part of each trajectory (`split`, 80 %; 1 is all) is calibrated on, the rest tests.
    The parameters are those of the command with the same settings, to the last bit. Nothing is
    written.

    Args:
        pairs: as `cfx.read` takes them.
        model: as after `model=`.
        objective: what is minimised, as after `objective=`: `speed_rmse`, `gap_rmse`, ...
        posterior: how well each parameter is known, as after `calibration.posterior=`. With
            `laplace` (the quickest), `nuts` or `sbi` the fit has `intervals`, `draws` and
            `inference_data`, with `hierarchical` new drivers too (`draw`). They are found when they
            are first asked for.
        seed: the same seed gives the same parameters.
        settings: others of the command line: `optimizer="botorch"`, `split=0.7`,
            `**{"model.parameters.T.high": 4.0}`; of reading a file, `**{"data.max_pairs": 20}`.

    Raises:
        CfxError: the pairs or a setting are wrong, in one sentence.

    Examples:
        >>> import cfx
        >>> pairs = cfx.read(dataset="synthetic", pairs=3, frames=200, variation=0.0)
        >>> fit = cfx.calibrate(pairs, "idm", objective="gap_rmse")
        >>> fit.parameters.shape
        (3, 5)
        >>> bool((fit.losses["test_rmse_gap"] >= 0).all())
        True
    """
    refuse_unused(settings, {**NOTHING_KEPT, **_NOT_TRAINED})
    if posterior != "none":
        if "calibration.posterior" in settings:
            raise ConfigError("give posterior=... or calibration.posterior, not both")
        settings["calibration.posterior"] = posterior
    chosen = {"model": model, "objective": objective, "seed": seed, **without_data(settings)}
    recording = pairs_from(pairs, settings)
    experiment = config(recording, policy="fixed", protocol="within_driver", **chosen)
    with visit():
        components, context, last = _context_of(experiment, recording)
        with closing(components.engine):
            calibrated = context.calibrator.driver_specific(context.pairs, context.batch, last)
    ids = pd.Index(context.pairs.ids, name="pair_id")
    table = pd.DataFrame(calibrated.cpu().numpy(), ids, list(context.space.names))
    apart = pd.Series(context.calibrator.apart(context.pairs, last), ids, name="ends_apart")
    return Fit(experiment, recording, table, apart, context, last)


def calibrate_pooled(
    pairs: PairsLike,
    model: str = "idm",
    groups: Mapping[str, PairIds] | pd.Series | None = None,
    *,
    objective: str = "speed_rmse",
    seed: int = 0,
    **settings: Any,
) -> pd.DataFrame:
    """Calibrates one set of constant parameters for all drivers, or one for each group of them.

    It minimises the mean of the pairs' losses, on whole trajectories. Driver-specific parameters
    are not calibrated. Nothing is written.

    Args:
        pairs: as `cfx.read` takes them.
        model: as after `model=`.
        groups: the ids of the pairs of each group, by its name, such as
            `pairs.frame.groupby("driver_type")["pair_id"].unique()`; a pair may be in several.
            None: all pairs are one group, `all`.
        objective: what is minimised, as after `objective=`: `speed_rmse`, `gap_rmse`, ...
        seed: the same seed gives the same parameters.
        settings: others of the command line, as for `calibrate`; `split=0.8` keeps the last part of
            each trajectory back.

    Returns:
        A row per group: its parameters, SI units.

    Raises:
        CfxError: the pairs, a group or a setting are wrong, in one sentence.

    Examples:
        >>> import cfx
        >>> pairs = cfx.read(dataset="synthetic", pairs=3, frames=200, variation=0.0)
        >>> first, second, third = pairs.summary.index
        >>> table = cfx.calibrate_pooled(pairs, "idm", {"two": [first, second], "one": third})
        >>> table.shape
        (2, 5)
    """
    refuse_unused(settings, {**NOTHING_KEPT, **_NOT_TRAINED, **_NOT_POOLED})
    if groups is not None and not isinstance(groups, Mapping | pd.Series):
        raise ConfigError(
            f"groups: a {type(groups).__name__} says no names of groups; give the ids of each by"
            " its name: groups={'people': [...], 'acc': [...]}"
        )
    chosen = {"model": model, "objective": objective, "seed": seed, "split": 1.0}
    chosen |= without_data(settings)
    recording = pairs_from(pairs, settings)
    experiment = config(recording, policy="fixed", protocol="within_driver", **chosen)
    with visit():
        components, context, last = _context_of(experiment, recording)
        with closing(components.engine):
            ids = list(context.pairs.ids)
            named = {"all": ids} if groups is None else dict(groups)
            return _pooled_over(context, last, _members_of(named, ids), list(named))


def _members_of(groups: Mapping[str, PairIds], ids: Sequence[str]) -> Tensor:
    """Returns which of P pairs belong to each of K groups, `(K, P)` bool.

    Raises:
        DataError: there is no group, one is empty, or it names a pair that is not there.
    """
    import torch

    if not groups:
        raise DataError("groups: there is none; leave it out to pool over all pairs")
    members = torch.zeros((len(groups), len(ids)), dtype=torch.bool)
    row_of = {pair_id: number for number, pair_id in enumerate(ids)}
    for number, (name, pair_ids) in enumerate(groups.items()):
        chosen = chosen_names(pair_ids, ids, f"group '{name}'")
        if not chosen:
            raise DataError(f"group '{name}' has no pairs; leave it out")
        members[number, [row_of[pair_id] for pair_id in chosen]] = True
    return members


def _pooled_over(
    context: ProtocolContext, last: Tensor, members: Tensor, names: Sequence[str]
) -> pd.DataFrame:
    """Returns the pooled parameters of K groups of pairs, a row each.

    Args:
        context: of a calibration of P pairs.
        last: `(P,)`, the last frame that is used of each.
        members: `(K, P)` bool.
        names: of the groups.
    """
    parameters = context.calibrator.pooled(context.pairs, context.batch, last, members)
    return pd.DataFrame(parameters.cpu().numpy(), list(names), list(context.space.names))


def _context_of(
    experiment: Experiment, recording: Pairs
) -> tuple[JobComponents, ProtocolContext, Tensor]:
    """Returns what a calibration works with, and the last frame of each pair that it is on."""
    from cfx.app.job import steps
    from cfx.simulation.windows import Split

    _, components, context = steps.without_files(experiment.config, recording.selected)
    last = Split.of(context.pairs, context.windows, context.split).frame
    return components, context, last


def compare(*jobs: Fit | Result, **named: Fit | Result) -> Comparison:
    """Compares fits and jobs: which is closest to the drivers, and is it chance.

    Each is judged by its policy, a fit and a calibration by driver-specific parameters, on the
    test part. Only those that were tested on the same frames of the same pairs are ranked.

    Args:
        jobs: what `cfx.calibrate`, `cfx.train`, `cfx.evaluate` or `cfx.load` returned; they are
            called by their model and policy.
        named: the same under names of your choice.

    Returns:
        Printed, a table, the smallest error first, and the verdict in one sentence, which holds its
        level over all comparisons (Holm); `table` is a data frame.

    Raises:
        ConfigError: fewer than two are given, one is no fit and no result, or a name of your choice
            is what another is called.

    Examples:
        >>> import cfx
        >>> pairs = cfx.read(dataset="synthetic", pairs=2, frames=200)
        >>> fits = [cfx.calibrate(pairs, model) for model in ("idm", "krauss")]
        >>> sorted(cfx.compare(*fits).table.index)
        ['idm', 'krauss']
    """
    if len(jobs) + len(named) < 2:
        raise ConfigError("compare: give two fits or results, or more")
    for given in (*jobs, *named.values()):
        if not isinstance(given, Fit | Result):
            raise ConfigError(
                f"compare: a {type(given).__name__} is no fit and no result; cfx.load(...) reads a"
                " job's folder, and several stand side by side: cfx.compare(first, second)"
            )
    results: dict[str, Result] = {}
    for job in jobs:
        result = job.result if isinstance(job, Fit) else job
        name = result.component("model")
        if isinstance(job, Result):
            name = f"{name} {result.component('policy')}".strip()
        name = name or f"job {len(results) + 1}"
        while name in results:
            name += "'"
        results[name] = result
    for name, job in named.items():
        if name in results:
            raise ConfigError(f"compare: another is called '{name}' too; choose another name")
        results[name] = job.result if isinstance(job, Fit) else job
    return Comparison.of({name: [result] for name, result in results.items()})

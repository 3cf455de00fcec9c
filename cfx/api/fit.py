"""Calibration from Python: constant parameters of each driver, pooled ones, and their errors.

Shapes: P pairs, n tuned parameters.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from cfx.api.experiment import Experiment, config
from cfx.api.pairs import Pairs, PairsLike, pairs_from
from cfx.core.guest import visit
from cfx.errors import ConfigError

if TYPE_CHECKING:
    import torch
    from matplotlib.figure import Figure
    from torch import Tensor

    from cfx.calibration.posterior import DriverPosteriors
    from cfx.evaluation.protocols.base import ProtocolContext

METHODS = ("default", "pooled", "driver_specific")
"""What is compared: the model's defaults, pooled and driver-specific parameters."""

_AT_BOUND = 0.01
"""So near to a bound, as a share of the distance between both, a value is at it."""


@dataclass(frozen=True, repr=False)
class Fit:
    """Calibrated parameters of a model; `cfx.calibrate` makes it.

    Attributes:
        experiment: the configuration, with the command that repeats it.
        pairs: what was calibrated on.
        parameters: a row per pair: the driver's own parameters, SI units.
    """

    experiment: Experiment
    pairs: Pairs
    parameters: pd.DataFrame
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
        """One set of parameters for all drivers, SI units: it minimises the mean of their losses.

        It is calibrated on the same frames when it is first asked for.
        """
        import torch

        members = torch.ones((1, len(self.pairs)), dtype=torch.bool)
        context = self._context
        with visit():
            found = context.calibrator.pooled(context.pairs, context.batch, self._last, members)
        return pd.Series(found[0].tolist(), index=self.parameters.columns, name="pooled")

    @property
    def defaults(self) -> pd.Series:
        """The model's default parameters, SI units."""
        space = self._context.space
        return pd.Series({name: space[name].default for name in space.names}, name="default")

    @cached_property
    def losses(self) -> pd.DataFrame:
        """Errors of each pair and method: pair_id, driver, method, and RMSE of speed and gap.

        `train_rmse_speed` (m/s) and `train_rmse_gap` (m) are of the part that was calibrated on,
        `test_...` of the rest, simulated in closed loop from the last measured state before it;
        with `split=1` there is no rest.
        `method` is `default`, `pooled` or `driver_specific`.
        """
        with visit():
            return pd.concat([self._errors(method) for method in METHODS], ignore_index=True)

    def summary(self) -> pd.DataFrame:
        """Returns a row per parameter: its unit, default, pooled value, and the drivers' spread.

        Columns: unit, default, pooled, mean, std, 25%, 50%, 75%, at_bound (share of the pairs
        whose value is at a bound, where the recording does not determine it).
        """
        space = self._context.space
        table = self.parameters.describe().T[["mean", "std", "25%", "50%", "75%"]]
        units, at_bound = [], []
        for name in space.names:
            one = space[name]
            units.append(one.unit)
            place = (self.parameters[name] - one.low) / (one.high - one.low)
            at_bound.append(float(((place < _AT_BOUND) | (place > 1 - _AT_BOUND)).mean()))
        table.insert(0, "unit", units)
        table.insert(1, "default", self.defaults)
        table.insert(2, "pooled", self.pooled)
        table["at_bound"] = at_bound
        return table.rename_axis("parameter")

    @cached_property
    def intervals(self) -> pd.DataFrame:
        """What each recording says of its driver's parameters: 90 % intervals, a row per pair.

        Columns are those of `fits.parquet`: `low_NAME`, `median_NAME`, `high_NAME` (SI units),
        `contraction_NAME` (0: the recording says nothing, 1: all) and the noise's; `pareto_k` above
        0.7 (of `nuts`: `r_hat` above 1.05) says that a row is not to be relied on.

        Raises:
            ConfigError: no posterior was asked for.
        """
        return pd.DataFrame(self._posterior.columns(), self.parameters.index)

    @cached_property
    def draws(self) -> pd.DataFrame:
        """Equally likely parameters of each driver, SI units: a row per pair_id and draw.

        Raises:
            ConfigError: no posterior was asked for.
        """
        found = self._posterior.draws
        rows = pd.MultiIndex.from_product(
            [self.parameters.index, range(found.shape[1])], names=["pair_id", "draw"]
        )
        return pd.DataFrame(found.flatten(0, 1).numpy(), rows, self.parameters.columns)

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

        asked = self.experiment.config.calibration.posterior
        if asked == "none" or not posterior_method(asked).has_population:
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
            own, solver = self._tensor("driver_specific"), context.calibrator.solver
            method = posterior_method(settings.posterior)
            return method.find(solver, context.batch, self._last, own, settings)

    def plot(self) -> Figure:
        """Draws the parameters between their bounds, and how they go together."""
        from cfx.results.result import Result, described_parameters

        tables = [self._of(one).add_prefix("parameter_").assign(method=one) for one in METHODS]
        rows = pd.concat(tables, ignore_index=True)
        described = {"parameters": described_parameters(self._context.space.tuned)}
        return Result(data=described, tables={"pairs": rows}).plot("calibration")

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
        if context.split < 1:
            agent = context.constant(FixedPolicy(), parameters)
            each = torch.arange(len(batch), device=batch.lengths.device)
            loop = simulate_in_shards(
                context.engine, context.stepper, agent, Followers(batch, each), first
            )
            speed, gap = closed_loop_errors(batch, first, loop)
            errors |= {"test_rmse_speed": speed, "test_rmse_gap": gap}
        return pd.DataFrame(errors)

    def __repr__(self) -> str:
        from cfx.figures.wording import short_label

        part = "test" if self._context.split < 1 else "train"
        found = self.losses.groupby("method")[f"{part}_rmse_speed"].mean()
        where = "the test part" if part == "test" else "what was calibrated on"
        means = [f"{short_label(method)} {found[method]:.3f}" for method in METHODS]
        return (
            f"Fit({self.model}, {len(self.parameters)} pairs; RMSE of speed on {where}, m/s:"
            f" {', '.join(means)})"
        )

    def _repr_html_(self) -> str:
        from cfx.figures.drawing import as_html

        return as_html(repr(self), self.summary())


def _ask_for(posterior: str) -> str:
    """Returns how a calibration asks for a posterior."""
    return f"say cfx.calibrate(..., **{{'calibration.posterior': '{posterior}'}})"


def calibrate(
    pairs: PairsLike,
    model: str = "idm",
    *,
    objective: str = "speed_rmse",
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
        seed: the same seed gives the same parameters.
        settings: others of the command line: `optimizer="botorch"`, `split=0.7`,
            `**{"model.parameters.T.high": 4.0}`. With `**{"calibration.posterior": "laplace"}`
            the fit has `intervals` and `draws`, with `"hierarchical"` new drivers too (`draw`).

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
    chosen = {"model": model, "objective": objective, "seed": seed, **settings}
    recording = pairs_from(pairs)
    experiment = config(recording, policy="fixed", protocol="within_driver", **chosen)
    with visit():
        from cfx.app.job import steps
        from cfx.simulation.windows import Split

        _, components, context = steps.without_files(experiment.config, recording.selected)
        with closing(components.engine):
            last = Split.of(context.pairs, context.windows, context.split).frame
            found = context.calibrator.driver_specific(context.pairs, context.batch, last)
    ids = pd.Index(context.pairs.ids, name="pair_id")
    table = pd.DataFrame(found.cpu().numpy(), ids, list(context.space.names))
    return Fit(experiment, recording, table, context, last)

"""Settings of calibration, and levels of what a posterior says.

Imports no torch: a wrong configuration is answered at once, and results are read without.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from cfx.core.component import Settings

if TYPE_CHECKING:
    import pandas as pd

INTERVAL_LEVEL = 0.9
"""Probability of an interval."""

MIN_NARROWING = 0.3
"""A recording determines a parameter where its interval is narrower than a priori by this share."""

APART = 0.01
"""Share of the loss by which independent ends of a search differ where an optimum may be missed."""

MAX_PARETO_K = 0.7
"""Pareto k of weighted samples above which an interval is not to be relied on (Vehtari et al. 2024,
*Pareto smoothed importance sampling*)."""

MIXED = 1.05
"""R-hat above which chains have not come to the same distribution."""

DIVERGENT = 0.01
"""Share of divergent draws above which chains may have left out a part of the posterior."""

OFF = 0.05
"""Distance from `LEVEL` of what a network's intervals hold of simulated drivers' parameters, above
which it is said."""

UNLIKELY = 0.05
"""Chance below which a fan that is right holds as little of a held-out part: one driver in 20."""

CORRELATED = 0.3
"""Correlation that noise may keep from step to step before it is said."""

ENOUGH = 100.0
"""Effective samples below which the ends of a 90 % interval move by a tenth of its width or so from
one seed to the next (the 5 % point of a normal distribution: standard error 0.21 deviations)."""


class CalibrationSettings(Settings):
    """Settings of the calibration of driver-specific and pooled parameters."""

    prior: Literal["weak", "chosen", "none"] | Annotated[float, Field(gt=0)] = Field(
        "chosen",
        description="weak: parameters that a recording does not determine stay near the model's"
        " default; chosen: driver-specific ones have the strength of the prior that errs least on"
        " thirds of what is calibrated on that are left out, for all drivers together; a number:"
        " they have that strength, such as one that chosen has found on longer recordings; none: as"
        " in the paper",
    )
    pooled_segment_s: float | None = Field(
        None,
        gt=0,
        description="s: pooled parameters are calibrated on pieces of about this length, each"
        " simulated from a measured state; every pair counts alike. null: on whole trajectories,"
        " as they are tested",
    )
    posterior: str = Field(
        "none",
        description="intervals of each driver's parameters beside the point estimate. laplace: each"
        " driver alone; nuts: the same by chains; sbi: the same by a network that learns from"
        " simulations; hierarchical: with a prior that all drivers of the"
        " job give; none: the point estimate alone",
    )
    noise: Literal["chosen", "trajectory", "measurement", "acceleration", "both"] = Field(
        "chosen",
        description="where the posterior's noise enters. trajectory: errors of one closed loop last"
        " for seconds; measurement: they are white; acceleration: drivers do not accelerate as the"
        " model says, and drive on from where that leads; both: acceleration and measurement, in"
        " shares that are estimated; chosen: the most evident one, of all drivers together",
    )
    noise_step_s: float = Field(
        1.0,
        gt=0,
        description="s: errors of the posterior are taken this far apart; closer ones say little"
        " more, and make intervals too narrow",
    )
    noise_order: int = Field(
        1, ge=1, le=5, description="order of the posterior's autoregressive noise, in such steps"
    )

    @model_validator(mode="after")
    def _noise_belongs_to_a_posterior(self) -> CalibrationSettings:
        if self.posterior == "none":
            for name in ("noise", "noise_step_s", "noise_order"):
                value = getattr(self, name)
                if value != type(self).model_fields[name].default:
                    raise ValueError(
                        f"calibration.{name}={value}: there is no posterior, so it does nothing;"
                        " leave it out, or set calibration.posterior=laplace"
                    )
        if self.noise == "measurement" and self.noise_order != 1:
            raise ValueError(
                f"calibration.noise_order={self.noise_order}: calibration.noise=measurement is"
                " white, so it does nothing; leave it out, or set calibration.noise=trajectory"
            )
        return self


def are_contradicted(rows: pd.DataFrame) -> pd.Series:
    """Returns whose held-out part the posterior's forecasts hold less of than chance allows.

    Args:
        rows: of the table `fits`. Where nothing was held out, nobody's.
    """
    if "held_chance" not in rows:
        return rows["noise_scale"] < 0  # nobody's
    return rows["held_chance"] < UNLIKELY


def doubts(rows: pd.DataFrame) -> pd.Series:
    """Returns why each driver's interval is not to be taken at its word; "" where nothing is known.

    Args:
        rows: of the table `fits`, with a posterior's columns.
    """
    # A wrong setting is answered before pandas is there.
    import pandas as pd

    reasons = pd.DataFrame(
        {
            "samples do not settle": ~are_reliable(rows),
            "forecasts miss the held-out part": are_contradicted(rows),
            "noise stays correlated": rows["noise_left"].abs() > CORRELATED,
        },
        rows.index,
    )
    sentences = []
    for _, holds in reasons.iterrows():
        sentences.append("; ".join(holds.index[holds.to_numpy(bool)]))
    return pd.Series(sentences, rows.index, name="doubt", dtype=str)


def are_reliable(rows: pd.DataFrame) -> pd.Series:
    """Returns which drivers' intervals are to be relied on.

    Args:
        rows: of the table `fits`, with the diagnostics of weighted samples or of chains.
    """
    if "r_hat" in rows:
        mixed: pd.Series = rows["r_hat"] <= MIXED
        if "divergences" in rows:
            mixed &= rows["divergences"] <= DIVERGENT
        return mixed
    return rows["pareto_k"] <= MAX_PARETO_K

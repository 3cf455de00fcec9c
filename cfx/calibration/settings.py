"""Settings of calibration, and levels of what a posterior says.

Imports no torch: a wrong configuration is answered at once, and results are read without.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

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

ENOUGH = 100.0
"""Effective samples below which the ends of a 90 % interval move by a tenth of its width or so from
one seed to the next (the 5 % point of a normal distribution: standard error 0.21 deviations)."""


class CalibrationSettings(Settings):
    """Settings of the calibration of driver-specific and pooled parameters."""

    prior: Literal["weak", "chosen", "none"] = Field(
        "chosen",
        description="weak: parameters that a recording does not determine stay near the model's"
        " default; chosen: driver-specific ones have the strength of the prior that errs least on"
        " thirds of what is calibrated on that are left out, for all drivers together; none: as in"
        " the paper",
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
            for name in ("noise_step_s", "noise_order"):
                value = getattr(self, name)
                if value != type(self).model_fields[name].default:
                    raise ValueError(
                        f"calibration.{name}={value}: there is no posterior, so it does nothing;"
                        " leave it out, or set calibration.posterior=laplace"
                    )
        return self


def are_reliable(rows: pd.DataFrame) -> pd.Series:
    """Returns which drivers' intervals are to be relied on.

    Args:
        rows: of the table `fits`, with the diagnostics of weighted samples or of chains.
    """
    if "r_hat" in rows:
        return (rows["r_hat"] <= MIXED) & (rows["divergences"] <= DIVERGENT)
    return rows["pareto_k"] <= MAX_PARETO_K

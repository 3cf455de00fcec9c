"""Settings of calibration.

Imports no torch, so that a wrong configuration is answered at once.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from cfx.core.component import Settings


class CalibrationSettings(Settings):
    """Settings of the calibration of driver-specific and pooled parameters."""

    prior: Literal["weak", "none"] = Field(
        "weak",
        description="weak: parameters that a recording does not determine stay near the model's"
        " default; none: as in the paper",
    )
    posterior: str = Field(
        "none",
        description="intervals of each driver's parameters beside the point estimate. laplace: each"
        " driver alone; nuts: the same by chains; hierarchical: with a prior that all drivers of"
        " the job give; none: the point estimate alone",
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

"""What a user may choose about driving style."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from cfx.core.component import Settings


class StyleSettings(Settings):
    """How driving style is measured, and which drivers a job uses."""

    cluster: Literal["all", "conservative", "normal", "aggressive"] = Field(
        "all", description="drivers that the job uses"
    )
    direction: Literal["signed", "printed"] = Field(
        "signed",
        description="signed: headways count against aggressiveness; printed: the rule as the paper"
        " prints it",
    )
    percentiles: tuple[float, float] = Field(
        (25.0, 75.0), description="cuts between the three clusters, percent of the drivers"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.percentiles
        if not 0 < low < high < 100:
            raise ValueError(
                f"style.percentiles=[{low:g}, {high:g}] must rise and lie between 0 and 100"
            )
        return self

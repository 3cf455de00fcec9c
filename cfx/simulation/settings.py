"""Settings of windows.

Imports no torch, so that a wrong configuration is answered at once.
"""

from __future__ import annotations

from pydantic import Field, model_validator

from cfx.core.component import Settings


class WindowSettings(Settings):
    """Settings of windows; both are 5 steps (0.5 s at NGSIM's 0.1 s) in the paper."""

    length: int = Field(5, ge=1, description="steps that a window simulates")
    stride: int = Field(
        5,
        ge=1,
        description="steps from one window's start to the next; parameters change this often",
    )
    tie_tolerance: float | None = Field(
        None,
        ge=0,
        description="in the objective's unit: losses in a window this close to the lowest count as"
        " equal, and the label is what is nearest to the driver-specific parameters; null: the"
        " objective's own, about the accuracy of recordings (0.05 m/s for speed_rmse, as NGSIM's"
        " speeds); 0 in the paper",
    )

    @model_validator(mode="after")
    def _covers(self) -> WindowSettings:
        if self.length < self.stride:
            raise ValueError(
                f"windows.length={self.length} leaves frames out between windows of stride"
                f" {self.stride}; give at least that"
            )
        return self

    def count(self, frames: int) -> int:
        """Returns how many whole windows fit a trajectory of `frames` frames."""
        return max(0, (frames - 1 - self.length) // self.stride + 1)

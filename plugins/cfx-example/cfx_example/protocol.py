"""A protocol: what is calibrated, trained and tested on which data. This one splits otherwise.

A job calls `run` once; the context holds the job's components and pairs. It is as cfx's
`within_driver`, but another share of each trajectory trains.
"""

from __future__ import annotations

from dataclasses import replace

import cfx
from cfx.plugin import Protocol, ProtocolContext, ProtocolResult, Settings
from pydantic import Field


class FirstPartSettings(Settings):
    """Settings of `first_part`."""

    share: float = Field(
        0.5, gt=0, lt=1, description="share of each trajectory that is calibrated and learned on"
    )


class FirstPart(Protocol):
    """Calibrates and trains on the first part of each trajectory, and tests on the rest."""

    schema = FirstPartSettings
    settings: FirstPartSettings

    def run(self, context: ProtocolContext) -> ProtocolResult:
        within_driver = cfx.get("protocol", "within_driver")()
        assert isinstance(within_driver, Protocol)
        return within_driver.run(replace(context, split=self.settings.share))

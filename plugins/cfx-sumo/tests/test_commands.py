"""The contracts of `cfx drive` and `cfx export`."""

from __future__ import annotations

import pytest

from cfx import Command
from cfx.contracts import CommandContract
from cfx_sumo.commands import DriveCommand, ExportCommand


class TestCommands(CommandContract):
    @pytest.fixture(params=[DriveCommand, ExportCommand])
    def command(self, request: pytest.FixtureRequest) -> Command:
        command: Command = request.param()
        return command

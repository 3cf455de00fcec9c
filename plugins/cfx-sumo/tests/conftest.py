"""Processes in which SUMO runs."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.forks import Forks


@pytest.fixture(scope="session")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    """Starts processes in which libsumo can drive: they have no pyarrow."""
    imports = 'import sys; sys.modules["pyarrow"] = None; import cfx_sumo.drive.run'
    with Forks(imports, tmp_path_factory.mktemp("live")) as forks:
        yield forks

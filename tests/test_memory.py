"""What cannot fit is refused before anything is allocated; what runs out is one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cfx.app import cli
from cfx.core.memory import in_units, is_out_of_memory, require_memory
from cfx.errors import ConfigError
from cfx.evaluation.protocols.within_driver import WithinDriver
from cfx.policies.gru import GruPolicy
from cfx.simulation.synthetic import SyntheticDataset
from tests.broken_plugins import QUICK


def test_sizes_are_said_for_people() -> None:
    assert in_units(0) == "0 bytes"
    assert in_units(3.14e12) == "3.14 TB"
    assert in_units(1e30) == "1e+12 EB"


def test_what_is_larger_than_the_machine_is_refused() -> None:
    require_memory(1e6, "a setting")
    with pytest.raises(
        ConfigError, match=r"a setting needs about 1 EB of memory, and this machine"
    ):
        require_memory(1e18, "a setting")


def test_settings_that_ask_for_too_much_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ConfigError, match=r"data\.pairs=1000000000 of 600 frames needs about"):
        SyntheticDataset(pairs=1_000_000_000).load()
    unit = torch.full((10_000, 2), 0.5)
    with pytest.raises(ConfigError, match=r"policy\.hidden_size=4096 needs about"):
        GruPolicy(hidden_size=4096).build(5, unit[0], unit, torch.Generator())
    for override, said in (
        ("optimizer.samples=1000000000000", "1,000,000,000,000 evaluations of each problem needs"),
        ("simulator.memory_mb=1000000000", "simulator.memory_mb=1000000000 needs about"),
    ):
        assert cli.main([*QUICK, override, f"hydra.run.dir={tmp_path / 'job'}"]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: 20 GB")]
)
def test_memory_that_runs_out_is_one_sentence(
    error: Exception,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: object) -> None:
        raise error

    assert is_out_of_memory(error)
    monkeypatch.setattr(WithinDriver, "run", fail)
    assert cli.main([*QUICK, f"hydra.run.dir={tmp_path / 'job'}"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("memory ran out (")
    assert "Traceback" not in err

"""What README and CONTRIBUTING print works as printed."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import torch

import cfx
from cfx.hydra_source import composed
from cfx.models.base import DrivingModel
from tests.conftest import ROOT
from tests.drives import straight_pairs


def blocks(name: str, language: str) -> list[str]:
    text = (ROOT / name).read_text(encoding="utf-8")
    return [
        body for found, body in re.findall(r"^```(\w*)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE) if found == language
    ]


def commands() -> list[str]:
    lines = [line for block in blocks("README.md", "") for line in block.splitlines()]
    return [line for line in lines if line.startswith("python -m cfx ")]


def test_there_are_commands_to_check() -> None:
    assert len(commands()) >= 3


@pytest.mark.parametrize("command", commands())
def test_the_readmes_commands_compose(command: str) -> None:
    overrides = [word.split(",")[0] for word in shlex.split(command)[3:] if word != "-m"]
    assert composed(overrides)


def test_the_readmes_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    (block,) = blocks("README.md", "python")
    names: dict[str, object] = {}
    exec(block, names)  # noqa: S102 - it is our own README
    again, result = names["again"], names["result"]
    assert isinstance(again, cfx.JobResult)
    assert isinstance(result, cfx.JobResult)
    assert again.metrics == result.metrics
    assert "pair_id" in capsys.readouterr().out


def test_the_model_in_contributing_drives() -> None:
    (block,) = blocks("CONTRIBUTING.md", "python")
    names: dict[str, object] = {"__name__": "example"}
    exec(block, names)  # noqa: S102 - it is our own document
    kind = names["Pipes"]
    assert isinstance(kind, type)
    assert issubclass(kind, DrivingModel)
    batch = cfx.PairBatch.of(straight_pairs([600]))
    leader = cfx.Leader(batch.leader_position, batch.leader_speed, batch.leader_acceleration, batch.leader_length)
    start = cfx.Start(batch.follower_position[:, 0], batch.follower_speed[:, 0], batch.follower_acceleration[:, 0])
    drive = cfx.simulate(kind(), {"headway": 2.0}, leader, start, batch.dt)
    assert not bool(drive.collided.any())
    torch.testing.assert_close(drive.gap[0, -1], torch.tensor(20.0, dtype=torch.float64), atol=0.5, rtol=0)

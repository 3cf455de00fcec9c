"""Compiled code is never taken from another kind of processor."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from cfx.simulation.kernel import compiler

SUM = """
import torch
from cfx.simulation.kernel.compiler import torch_compiled

def steps(x, y):
    return (x.exp() * y).sum(-1) + torch.where(x > 0, x.log1p(), y).sum(-1)

x = torch.linspace(-1, 1, 5 * 35).view(5, 35)
y = torch.linspace(0, 2, 5 * 35).view(5, 35)
torch.testing.assert_close(torch_compiled(steps, dynamic=False)(x, y), steps(x, y))
print(torch.backends.cpu.get_cpu_capability())
"""


def folder() -> str:
    compiler.separate_cache()
    return os.environ["TORCHINDUCTOR_CACHE_DIR"]


def test_each_kind_of_processor_has_its_own_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    first = folder()
    assert Path(first).parent == tmp_path
    assert folder() == first
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "another")
    second = folder()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiler, "processor", lambda: "flags: fewer")
    assert len({first, second, folder()}) == 3


def test_without_a_wish_the_cache_lies_where_this_user_alone_writes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # monkeypatch gives the variable back that `folder` sets.
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")
    assert Path(folder()).parent == compiler.cache_folder() / "torch"


@pytest.mark.slow
def test_code_for_longer_vectors_is_not_taken_for_shorter_ones(tmp_path: Path) -> None:
    environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}
    environment.pop("ATEN_CPU_CAPABILITY", None)
    for capability in ({}, {"ATEN_CPU_CAPABILITY": "avx2"}, {}):
        subprocess.run(
            [sys.executable, "-c", SUM], env={**environment, **capability}, check=True, timeout=300
        )

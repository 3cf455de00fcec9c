"""`cfx cite` and `CITATION.cff` say what pyproject says."""

from __future__ import annotations

import tomllib

import pytest
import yaml

from cfx.app import cli, nodes
from tests.checkout import ROOT


def test_cite_prints_bibtex_with_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    entry = yaml.safe_load(nodes.shipped("CITATION.cff").read_text("utf-8"))
    assert entry["version"] == project["version"]
    assert entry["license"] == project["license"]
    assert cli.main(["cite"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("@software{cfx,\n")
    assert f"version = {{{project['version']}}}" in printed
    assert printed.count("{") == printed.count("}")
    assert "author = {Yang, Z. and Masuda, S. and Tatsubori, M.}" in printed

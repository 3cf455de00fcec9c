"""The contract of a sub-command, and what this one prints."""

from types import SimpleNamespace

import cfx
from cfx_contracts import check_contract

from cfx_example.command import IMPROVEMENT, Gains


def test_contract():
    check_contract(Gains())


def test_cfx_finds_it():
    found = cfx.get("command", "gains")
    assert found is Gains, "install it first: pip install --editable ."


def test_it_prints_a_line_for_each_job(monkeypatch, capsys):
    metrics = {"a": {IMPROVEMENT: 0.123}, "b": {}}
    monkeypatch.setattr(cfx, "load", lambda job: SimpleNamespace(metrics=metrics[job]))
    command = Gains()
    assert command.run(command.parse(["a", "b", "--digits", "2"])) == 0
    assert capsys.readouterr().out.splitlines() == ["a: +12.30%", "b: no policy was tested"]

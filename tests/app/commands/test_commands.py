"""Sub-commands are components: cfx's own keep the contract, a third party's harms nobody else."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from cfx.app import cli
from cfx.core import registry
from cfx.core.distributions import OWN
from tests.installer import Installer

OWN = [one.name for one in registry.entries("command") if one.distribution == OWN]

CENSUS = """
    import argparse
    from cfx.plugin import Command
    {loaded}

    class Census(Command):
        summary = "counts"

        def parser(self):
            parser = argparse.ArgumentParser("cfx census", description="Counts.")
            parser.add_argument("--city", choices=["ulm", "uppsala"], help="which")
            return parser

        def run(self, options):
            {run}
"""

COUNTS = CENSUS.format(loaded="", run="print('counted', options.city)\n            return 1")


@pytest.fixture
def census(install: Installer) -> Installer:
    points = {"cfx.commands": {"census": "cfx_census:Census"}}
    install("cfx-census", points, {"cfx_census.py": COUNTS})
    return install


def test_a_third_partys_is_run_and_its_exit_code_is_the_programs(
    census: Installer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["census", "--city", "ulm"]) == 1
    assert capsys.readouterr().out == "counted ulm\n"


def test_help_completion_and_advice_know_it(
    census: Installer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert cli.main(["cenus"]) == 2
    assert "Did you mean 'census'?" in capsys.readouterr().err
    monkeypatch.setenv("COMP_LINE", "cfx cen")
    monkeypatch.setenv("COMP_POINT", "7")
    assert cli.main(["-sc", "query=bash"]) == 0
    assert "cfx_census" not in sys.modules
    assert capsys.readouterr().out.split() == ["census"]
    assert cli.main(["--help"]) == 0
    assert re.search(r"cfx census +counts \(from cfx-census\)", capsys.readouterr().out)
    monkeypatch.setenv("COMP_LINE", "cfx census --city u")
    monkeypatch.setenv("COMP_POINT", "19")
    assert cli.main(["-sc", "query=bash"]) == 0
    assert capsys.readouterr().out.split() == ["ulm", "uppsala"]


def test_two_of_one_name_are_named_and_the_rest_works(
    census: Installer, capsys: pytest.CaptureFixture[str]
) -> None:
    points = {"cfx.commands": {"census": "cfx_count:Census"}}
    census("cfx-count", points, {"cfx_count.py": COUNTS})
    assert cli.main(["census"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("cfx census: two distributions bring a command 'census': cfx-census 1.0")
    assert "and cfx-count 1.0" in said
    assert len(said.splitlines()) == 1
    assert cli.main(["cite"]) == 0
    assert cli.main(["--help"]) == 0
    assert "two distributions bring a command 'census'" in capsys.readouterr().out


def test_a_name_of_cfxs_own_is_cfxs_own(
    install: Installer, capsys: pytest.CaptureFixture[str]
) -> None:
    points = {"cfx.commands": {"cite": "usurper:Cite"}}
    install("usurper", points, {"usurper.py": "raise SystemExit(0)"})
    assert cli.main(["cite"]) == 0
    assert capsys.readouterr().out.startswith("@software")
    assert cli.main(["plugins", "check", "command", "cite"]) == 1
    assert "usurper 1.0 is never used" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("module", "complaint"),
    [
        ("raise RuntimeError('no luck')", "cannot be imported: RuntimeError: no luck"),
        (COUNTS.replace("def run", "def go"), "does not implement run"),
        (CENSUS.format(loaded="", run="{}['ulm']"), "failed in cfx_census.py, line 15: KeyError"),
    ],
)
def test_a_broken_one_is_one_sentence_that_names_its_distribution(
    install: Installer, module: str, complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    points = {"cfx.commands": {"census": "cfx_census:Census"}}
    install("cfx-census", points, {"cfx_census.py": module})
    assert cli.main(["census"]) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert "cfx-census 1.0" in said
    assert len(said.splitlines()) == 1


def test_show_says_how_it_is_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plugins", "show", "command", "drive"]) == 0
    assert "Run it with cfx drive; cfx drive --help says" in capsys.readouterr().out
    assert cli.main(["plugins", "show", "command", "drvie"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("cfx drvie: there is no command 'drvie'. Did you mean 'drive'?")


def test_a_sub_command_is_no_key_of_a_job(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "cfx", "-m", "drvie"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "drvie: neither key=value nor a sub-command. Did you mean 'drive'?" in done.stderr

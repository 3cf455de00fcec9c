"""Tab after a sub-command, as the shell asks for it."""

from __future__ import annotations

import pytest

from cfx.app import cli
from tests.checkout import needs


@pytest.fixture
def complete(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def ask(line: str) -> list[str]:
        monkeypatch.setenv("COMP_LINE", line)
        monkeypatch.setenv("COMP_POINT", str(len(line)))
        assert cli.main(["-sc", "query=bash"]) == 0
        said = capsys.readouterr()
        assert said.err == ""
        return said.out.split()

    return ask


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("cfx ga", {"gains"}),
        ("cfx data d", {"describe"}),
        ("cfx gains --d", {"--digits"}),
        pytest.param("cfx data fetch --f", {"--folder", "--force"}, marks=needs("cfx-recordings")),
        ("cfx plugins show mod", {"model"}),
        ("cfx plugins show model hel", {"helly"}),
        ("cfx policies show w9", {"w99"}),
        ("cfx plugins n", {"new"}),
        ("cfx plugins new --fo", {"--folder"}),
        pytest.param("cfx policies m", {"make"}, marks=needs("cfx-report")),
        pytest.param("cfx policies make --w", {"--work"}, marks=needs("cfx-report")),
        pytest.param(
            "cfx report outputs/some --tables ", {"latex", "csv"}, marks=needs("cfx-report")
        ),
        ("cfx data describe ", set()),  # the shell's own completion of files
        ("cfx nonsense more", set()),
    ],
)
def test_words_of_a_line(complete, line: str, words: set[str]) -> None:
    assert set(complete(line)) == words


def test_the_first_word_may_be_a_sub_command_or_a_group(complete) -> None:
    found = set(complete("cfx "))
    assert {"plugins", "gains", "model=", "policy="} <= found

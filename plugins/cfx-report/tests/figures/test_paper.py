"""Figures of a finished job in the width, font size and format of a paper."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from cfx.app import cli
from cfx.core import registry
from cfx.core.distributions import OWN
from cfx.errors import ConfigError
from cfx.figures.canvas import Paper, blank, on_paper, points, side_by_side, wrapped
from cfx.figures.drawing import draw_figure, figure_named
from cfx.results.result import Result
from tests.job_folders import write_job
from tests.made_up import make_results

COLUMN = Paper(width=88 / 25.4, font_size=8.0)


@pytest.fixture(scope="module")
def results() -> Result:
    made = make_results(pairs=5, frames=60)
    return Result.of(made.evaluation, tables={"curves": made.curves})


def test_no_text_of_any_figure_is_larger_than_the_paper_asks_for(results: Result) -> None:
    drawn = 0
    for one in registry.installed("figure"):
        if one.distribution not in {OWN, "cfx-report", "cfx-forecasts"}:
            continue  # a third party's chooses sizes of its own
        with on_paper(COLUMN):
            figure = draw_figure(one, results)
        if figure is None:
            continue
        drawn += 1
        assert figure.get_figwidth() == pytest.approx(COLUMN.width), one.name
        sizes = [text.get_fontsize() for text in figure.findobj(Text) if text.get_text()]
        assert max(sizes) <= 8.0 * 11 / 10.5 + 1e-9, one.name
        assert any(size == pytest.approx(8.0) for size in sizes), one.name
    assert drawn >= 9


def test_panels_stand_below_each_other_where_text_has_no_room() -> None:
    usual = blank(3.0)
    left, right = side_by_side(usual, (2, 1))
    assert left.get_subplotspec().colspan != right.get_subplotspec().colspan
    with on_paper(COLUMN):
        narrow = blank(3.0)
        above, below = side_by_side(narrow, (2, 1))
        assert above.get_subplotspec().colspan == below.get_subplotspec().colspan
        assert narrow.get_figheight() == pytest.approx(2 * 3.0 * 8 / 10.5)
        assert points(10.5) == pytest.approx(8.0)
        assert "\n" in wrapped("word " * 40)
    assert points(10.5) == 10.5
    assert wrapped("word " * 40) == "word " * 40


def test_the_usual_paper_is_as_it_was(results: Result) -> None:
    figure = draw_figure(figure_named("error_over_time"), results)
    assert figure is not None
    assert tuple(figure.get_size_inches()) == (10.5, 3.9)
    assert mpl.rcParams["font.size"] == mpl.rcParamsDefault["font.size"]


def test_the_command_writes_a_jobs_figures_and_compares_several(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    write_job(first, model="idm", pairs=3)
    write_job(second, pairs=3, seed=1)
    own = ["--width", "88mm", "--only", "drives", "--format", "svg"]
    assert cli.main(["figures", str(first), *own]) == 0
    (path,) = (first / "figures").iterdir()
    assert path.name == "drives.svg"
    width = path.read_text().partition('width="')[2].partition("pt")[0]
    assert float(width) == pytest.approx(72 * 88 / 25.4, abs=0.5)
    folder = tmp_path / "both"
    words = ["figures", str(first), str(second), "--format", "svg", "--folder", str(folder)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda figure, file, **options: file.touch())
        assert cli.main(words) == 0
    assert (folder / "models.svg").is_file()
    assert len(list(folder.glob("*/error_distribution.svg"))) == 2
    assert "Closest to the drivers" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--width", "88"], "--width 88: give a length with its unit, such as 88mm or 3.5in"),
        (["--width", "5kg"], "--width 5kg: give a length"),
        (["--width", "2mm"], "give a width between 30 and 1000 mm"),
        (["--font-size", "90"], "--font-size 90: give points between 3 and 40"),
        (["--format", "gif"], "--format gif: there is no 'gif'.* Known: pdf, svg, png"),
        (["--only", "drive"], "--only drive: there is no 'drive'.* Did you mean 'drives'?"),
    ],
)
def test_what_no_paper_has_is_refused(words: list[str], said: str) -> None:
    command = registry.create("command", {"name": "figures"})
    with pytest.raises(ConfigError, match=said):
        command.run(command.parse(["absent", *words]))  # type: ignore[attr-defined]

"""`cfx figures JOB`: the figures of finished jobs anew, in the size and format of a paper."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cfx.errors import ConfigError
from cfx.plugin import Command

if TYPE_CHECKING:
    from cfx.plugin import Result

_FORMATS = ("pdf", "svg", "png")
_WIDTHS_MM = (30.0, 1000.0)
_FONTS_PT = (3.0, 40.0)


class FiguresCommand(Command):
    """Draws the figures of finished jobs for a paper."""

    summary = "a finished job's figures in a paper's width, font size and format"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx figures",
            description="Draws the figures of finished jobs, in the width and font size of a"
            " paper. Several jobs, or a sweep, are also compared with one another.",
        )
        parser.add_argument(
            "runs",
            nargs="+",
            metavar="JOB",
            help="output folder of a job or a sweep, its URL (output.url), or id of an MLflow run",
        )
        parser.add_argument(
            "--width",
            default="267mm",
            help="of a figure, in a unit of length: 88mm (one column of many journals), 3.5in;"
            " default: 267mm, for screens",
        )
        parser.add_argument(
            "--font-size",
            type=float,
            metavar="POINTS",
            help="of the text of axes; default: 8 below 200 mm, else 10.5",
        )
        parser.add_argument(
            "--format",
            default="pdf",
            help=f"{', '.join(_FORMATS)}, or several with commas; default: pdf",
        )
        parser.add_argument(
            "--only", metavar="NAMES", help="some figures, by their names with commas; default: all"
        )
        parser.add_argument(
            "--folder", metavar="FOLDER", help="where they go; default: JOB/figures"
        )
        return parser

    def run(self, options: argparse.Namespace) -> int:
        width_mm = _width_mm(options.width)
        font = options.font_size
        if font is None:
            font = 8.0 if width_mm < 200 else 10.5
        if not _FONTS_PT[0] <= font <= _FONTS_PT[1]:
            raise ConfigError(
                f"--font-size {font:g}: give points between {_FONTS_PT[0]:g} and {_FONTS_PT[1]:g}"
            )
        formats = _words(options.format, "--format", _FORMATS)
        for line in draw(
            options.runs, width_mm, font, formats, only=options.only, folder=options.folder
        ):
            print(line)
        return 0


def draw(
    runs: Sequence[str],
    width_mm: float,
    font_size: float,
    formats: Sequence[str] = ("pdf",),
    *,
    only: str | None = None,
    folder: str | None = None,
) -> list[str]:
    """Draws and writes figures of finished jobs; returns what to tell the user.

    Args:
        runs: as `cfx_report.runs.read_runs` takes them.
        width_mm: of each figure, mm.
        font_size: of the text of axes, points.
        formats: files of each figure.
        only: names of figures, with commas; None: all.
        folder: where the files go; None: `figures` in each job's folder.

    Raises:
        ConfigError: there is no such figure.
        DataError, TrackingError: the jobs cannot be read.
        OutputError: a file cannot be written.
    """
    from cfx.plugin import canvas, drawing, registry, wording
    from cfx_report.runs import read_runs

    figures = {figure.name: figure for figure in registry.installed("figure")}
    if only is not None:
        figures = {name: figures[name] for name in _words(only, "--only", sorted(figures))}
    jobs = read_runs(runs).jobs
    said = []
    with canvas.on_paper(canvas.Paper(width_mm / 25.4, font_size)):
        for job in jobs:
            target = Path(job.place) / "figures"
            if folder is not None or not Path(job.place).is_dir():
                target = Path(folder or "figures").expanduser()
                if len(jobs) > 1:
                    target /= job.name
            paths = drawing.write_figures(target, job, figures.values(), formats=formats)
            said.append(f"{wording.plural(len(paths), 'file')} in {target.absolute()}")
        if len(jobs) > 1 and only is None:
            said += _compared(jobs, Path(folder or "figures").expanduser(), formats)
    return said


def _compared(jobs: Sequence[Result], folder: Path, formats: Sequence[str]) -> list[str]:
    """Draws jobs against the one that is closest to the drivers; returns what to tell the user."""
    from cfx.plugin import comparison, drawing
    from cfx_report.figures.models import draw_models

    compared = comparison.Comparison.of({job.name: [job] for job in jobs})
    if not compared.ranking.against:
        return ["The jobs share no pairs on the same frames, so that they are not compared."]
    errors = {job.name: job.errors_by(compared.judge.name) for job in jobs}
    figure = draw_models(errors, compared.ranking.against, compared.judge)
    paths = [drawing.write_figure(figure, folder / f"models.{form}") for form in formats]
    return [
        *compared.sentences(),
        *[f"Model against model: {path.absolute()}" for path in paths],
    ]


def _width_mm(text: str) -> float:
    """Returns a width in mm.

    Raises:
        ConfigError: it is no length, or one that no figure has.
    """
    from cfx.plugin import length_mm

    least, most = _WIDTHS_MM
    try:
        width = length_mm(text)
    except ValueError as error:
        raise ConfigError(f"--width {text}: {error}") from None
    if not least <= width <= most:
        raise ConfigError(f"--width {text}: give a width between {least:g} and {most:g} mm")
    return width


def _words(text: str, option: str, allowed: Sequence[str]) -> tuple[str, ...]:
    """Returns words that stand with commas between them.

    Raises:
        ConfigError: one is not known.
    """
    from cfx.errors import nearest

    words = tuple(filter(None, map(str.strip, text.split(","))))
    for word in words or ("",):
        if word not in allowed:
            raise ConfigError(
                f"{option} {text}: there is no '{word}'.{nearest(word, allowed)} Known:"
                f" {', '.join(allowed)}."
            )
    return words

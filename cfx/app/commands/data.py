"""`cfx data`: what recordings hold."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cfx.core.command import Command
from cfx.errors import ConfigError, DataError


class DataCommand(Command):
    """Looks at recordings."""

    summary = "what a recording holds (describe), and at which flow its drivers settle (flows)"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser("cfx data", description="Looks at recordings.")
        actions = parser.add_subparsers(dest="action", required=True)
        describe = actions.add_parser("describe", help="what recordings hold")
        describe.add_argument(
            "files",
            nargs="+",
            metavar="FILE",
            help="a recording; and settings of the reader, such as data.columns.speed=v_kmh"
            " data.units.speed=km/h (of data=tidy unless data=NAME is among them)",
        )
        describe.add_argument(
            "--style",
            action="store_true",
            help="compare the driving styles of several files' sites too",
        )
        describe.add_argument(
            "--figure",
            metavar="FILE",
            help="draw the driving styles of the sites into a file (.png, .svg, .pdf)",
        )
        flows = actions.add_parser(
            "flows", help="at which gap drivers settle by speed, and the flow of such traffic"
        )
        flows.add_argument(
            "files",
            nargs="+",
            metavar="FILE",
            help="a recording; and settings of the reader, as for describe",
        )
        flows.add_argument(
            "--output",
            metavar="FILE",
            help="JSON: the relation of speed and gap of each type of driver, for cfx drive stress"
            " --recorded FILE",
        )
        return parser

    def run(self, options: argparse.Namespace) -> int:
        if options.action == "flows":
            _flows(options)
        else:
            _describe(options)
        return 0


def _flows(options: argparse.Namespace) -> None:
    """Prints the recorded relation of speed and flow of each type of driver.

    Raises:
        ConfigError: no file is named.
        DataError: a file cannot be used, or nobody follows steadily in it.
    """
    from cfx.core import console, files
    from cfx.core.registry import create
    from cfx.data.base import Dataset
    from cfx.data.known import with_known_types
    from cfx.data.steady import flow, relations_of_types

    overrides, paths = _overrides_and_files(options.files)
    if not paths:
        raise ConfigError("cfx data flows: name the recording")
    node = _settings([*overrides, f"data.path=[{','.join(map(_quoted, paths))}]"])
    dataset = create("dataset", node)
    assert isinstance(dataset, Dataset)
    pairs = with_known_types(dataset.load())
    table = console.blank_table(
        "driver", "speed [m/s]", "drivers", "flow [veh/h]", "quartiles of drivers [veh/h]"
    )
    for column in table.columns[1:]:
        column.justify = "right"
    relations = {}
    for kind, relation in relations_of_types(pairs).items():
        if len(relation.speed):
            relations[kind or "unknown"] = relation.columns()
        mean = flow(relation.speed, relation.gap)
        # Of drivers at one speed, those with small gaps have the large flow.
        high, low = flow(relation.speed, relation.low), flow(relation.speed, relation.high)
        for row, speed in enumerate(relation.speed):
            table.add_row(
                kind or "unknown",
                f"{speed:.1f}",
                str(relation.drivers[row]),
                f"{mean[row]:,.0f}",
                f"{low[row]:,.0f} to {high[row]:,.0f}",
            )
    if not relations:
        raise DataError(
            f"{pairs.source}: fewer than three drivers follow a leader steadily at any speed"
            " (within 0.5 m/s and 0.4 m/s2 for 3 s), so there is no flow to measure"
        )
    console.print_table(table)
    if options.output is not None:
        words = shlex.join(["cfx", "data", "flows", *map(_name_alone, options.files)])
        output = Path(options.output).expanduser()
        files.write_json(output, {"command": words, "relations": relations})


def _quoted(path: str) -> str:
    """Returns a path in quotes, within which Hydra takes commas and brackets as letters."""
    return "'" + path.replace("'", "\\'") + "'"


def _name_alone(word: str) -> str:
    """Returns a setting as it is, and a file's name without its folders, for a file to share."""
    return word if _is_setting(word) else Path(word).name


def _describe(options: argparse.Namespace) -> None:
    """Prints what each file holds, and compares their sites if there are several.

    Raises:
        ConfigError: no file is named, `--figure` has another ending than a figure, or it or
            `--style` has nothing to compare.
        DataError: a file cannot be used; or a pair stands in two of those that are compared.
    """
    from cfx.core.storage import path_or_url
    from cfx.data.base import joined
    from cfx.data.describe import describe, describe_sites, describe_style
    from cfx.data.known import with_names
    from cfx.data.style import StyleSettings, measure_style, style_distances

    overrides, files = _overrides_and_files(options.files)
    if not files:
        raise ConfigError("cfx data describe: name the file to look at")
    figure = None if options.figure is None else Path(options.figure).expanduser()
    if figure is not None and figure.suffix not in _FIGURES:
        raise ConfigError(f"--figure {figure}: its name must end in {', '.join(_FIGURES)}")
    settings = _settings(overrides) if overrides else None
    words = _words_to_use_it(overrides)
    read = []
    for file in files:
        description = describe(path_or_url(file), settings, words)
        print(description.text, end="\n\n" if len(files) > 1 else "\n")
        if description.pairs is not None and len(description.pairs):
            read.append(description.pairs)
    compares = options.style or figure is not None
    try:
        pairs = joined(read) if read else None
    except DataError as error:  # the files overlap
        if compares:
            raise
        print(f"Problem: {error}")
        return
    settings = settings or {}
    if pairs is not None:
        pairs = with_names(pairs, settings.get("site"), settings.get("vehicle"))
    if pairs is None or len(set(pairs.sites)) < 2:
        if compares:
            raise ConfigError(
                "cfx data describe: --style and --figure compare sites, and there is one alone;"
                " name the files of several, or say which recordings are of which site (data.site)"
            )
        return
    print(describe_sites(pairs))
    if compares:
        style = measure_style(pairs, StyleSettings())
        distances = style_distances(style)
        print(f"\n{describe_style(style, distances)}")
        if figure is not None:
            from cfx.figures.drawing import drawn, write_figure
            from cfx.results.result import Result

            tables = {} if distances is None else {"style_distances": distances}
            result = Result(tables={"style": style.table, **tables})
            write_figure(drawn("site_styles", result), figure)
            print(f"\nFigure: {figure}")


_FIGURES = (".png", ".svg", ".pdf")


def _overrides_and_files(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns the settings and the files among the words of a command line."""
    overrides: list[str] = []
    files: list[str] = []
    for word in words:
        if _is_setting(word):
            overrides.append(word)
        else:
            files.append(word)
    return overrides, files


def _words_to_use_it(overrides: Sequence[str]) -> str:
    """Returns the settings that a job needs besides the file's path, quoted for a shell."""
    words = ""
    for override in overrides:
        if not override.startswith("data="):
            words += f" {shlex.quote(override)}"
    return words


def _is_setting(word: str) -> bool:
    """Says whether a word of the command line is a setting of the dataset, not a file."""
    key, is_setting, _ = word.partition("=")
    return bool(is_setting) and (key == "data" or key.lstrip("+~").startswith("data."))


def _settings(overrides: Sequence[str]) -> dict[str, Any]:
    """Returns the node of the dataset that a job with these overrides would have.

    Raises:
        ConfigError: one of them fits nothing.
    """
    from cfx.app import hydra_source
    from cfx.app.user_errors import explained

    if not any(word.startswith("data=") for word in overrides):
        overrides = ["data=tidy", *overrides]
    with explained(overrides):
        return dict(hydra_source.plain(hydra_source.composed(overrides))["data"])

"""The sub-command `cfx benchmark`."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from cfx.plugin import Command
from cfx_report.benchmark.frozen import DATA_NAME, METHODS, VERSION, protocol_hash


class BenchmarkCommand(Command):
    """Sets a model or a policy beside all others under one frozen protocol."""

    summary = "a model or policy on the frozen benchmark, beside all others"

    def parser(self) -> argparse.ArgumentParser:
        made = argparse.ArgumentParser(
            "cfx benchmark",
            description=f"Runs one frozen protocol ({VERSION}, {protocol_hash()}), and writes a"
            " row.",
            epilog="cfx benchmark model=mine --data i80_reconstructed_pairs.parquet",
        )
        made.add_argument(
            "overrides",
            nargs="*",
            metavar="OVERRIDE",
            help="what is benchmarked: model=, policy=, learner=, objective= and their settings",
        )
        made.add_argument("--data", metavar="FILE", help=f"{DATA_NAME}; a tidy table")
        made.add_argument(
            "--method",
            choices=list(METHODS),
            help="how the model is used; default: constant, unless policy= or learner= is given",
        )
        made.add_argument("--name", help="of the row; default: made of the overrides")
        made.add_argument(
            "--output", type=Path, metavar="FOLDER", help="default: outputs/benchmark/NAME"
        )
        made.add_argument(
            "--against",
            action="append",
            default=[],
            metavar="FILE",
            help="another's benchmark_pairs.csv, to compare with pair by pair; may be repeated",
        )
        made.add_argument(
            "--other-data", action="store_true", help="allow other pairs, and mark the row"
        )
        made.add_argument(
            "--table",
            nargs="+",
            metavar="ROW",
            help="print these rows (files or job folders) as one table, and run nothing",
        )
        return made

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Reads the command line, where overrides may stand between options."""
        parser = self.parser()
        options = parser.parse_intermixed_args(list(arguments))
        if options.data is None and not options.table:
            parser.error(f"--data FILE is needed: the recordings ({DATA_NAME}) in the tidy layout")
        options.arguments = list(arguments)
        return options

    def run(self, options: argparse.Namespace) -> int:
        if options.table:
            _table(options.table)
        else:
            _row(options)
        return 0


def _row(options: argparse.Namespace) -> None:
    from cfx_report.benchmark.compare import compared, lines_of, read_errors
    from cfx_report.benchmark.row import PAIRS, ROW, markdown
    from cfx_report.benchmark.run import overrides_of, row_name, run

    overrides = overrides_of(options.method, options.overrides)
    others = [(file, read_errors(Path(file))) for file in options.against]
    row, job = run(
        overrides,
        Path(options.data).expanduser().absolute(),
        options.output,
        name=options.name or row_name(options.method, options.overrides),
        other_data=options.other_data,
    )
    print(f"\nThe row, on {row.pairs} pairs of {row.drivers} unseen drivers, full trajectories:\n")
    print("\n".join(markdown([row])))
    for file, table in others:
        print("\n".join(["", *lines_of(compared(read_errors(job / PAIRS), table, file))]))
    print(f"\nThe row: {job / ROW}\nErrors of each pair: {job / PAIRS}")
    if not others:
        again = shlex.join(["python", "-m", "cfx", "benchmark", *options.arguments])
        print(f"Compare it, without running again: {again} --against FILE, another's {PAIRS}")


def _table(files: Sequence[str]) -> None:
    from cfx_report.benchmark.row import ROW, Row, markdown

    rows = []
    for file in files:
        path = Path(file)
        if path.is_dir():
            path = path / ROW
        rows.append(Row.read(path))
    print("\n".join(markdown(rows)))

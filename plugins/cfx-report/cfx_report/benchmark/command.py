"""The sub-command `cfx benchmark`."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cfx.plugin import Command
from cfx_report.benchmark.frozen import METHODS

if TYPE_CHECKING:
    import pandas as pd

    from cfx_report.benchmark.methods import Entry
    from cfx_report.benchmark.suite import Suite
    from cfx_report.benchmark.work import Recordings


class BenchmarkCommand(Command):
    """Sets a model, a policy or a rival beside all others under a frozen protocol."""

    summary = "a model, a policy or a rival on a frozen benchmark, beside all others"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx benchmark",
            description="Runs a frozen protocol, and writes a row. cfx benchmark table prints rows,"
            " and writes the page of them.",
            epilog="cfx benchmark model=mine --data i80_reconstructed_pairs.parquet; cfx benchmark"
            " --suite roads rival=ridge --data FOLDER",
        )
        parser.add_argument(
            "overrides",
            nargs="*",
            metavar="OVERRIDE",
            help="what is benchmarked: model=, policy=, learner=, objective= and their settings; or"
            " rival= and its settings",
        )
        parser.add_argument(
            "--suite",
            choices=["i80", "roads"],
            default="i80",
            help="i80: one recording; roads: every openly licensed one; default: i80",
        )
        parser.add_argument(
            "--data", metavar="PATH", help="the recordings, tidy tables: a file, or their folder"
        )
        parser.add_argument(
            "--method",
            choices=list(METHODS),
            help="how the model is used; default: constant, unless policy= or learner= is given",
        )
        parser.add_argument("--quick", action="store_true", help="of roads: two roads alone")
        parser.add_argument(
            "--all", action="store_true", help="every row of the documentation, one after the other"
        )
        parser.add_argument("--seed", type=int, default=0, help="of training; default: 0")
        parser.add_argument("--name", help="of the row; default: made of the overrides")
        parser.add_argument(
            "--output",
            type=Path,
            metavar="FOLDER",
            help="of the row; default: outputs/benchmark/NAME, of roads"
            " outputs/benchmark/roads-1/NAME, where the baseline's row and the recordings lie too",
        )
        parser.add_argument(
            "--submission",
            nargs="+",
            type=Path,
            metavar="FILE",
            help="score these trajectories and forecasts (Parquet) in place of a method",
        )
        parser.add_argument(
            "--card", type=Path, metavar="FILE", help="of a submission: JSON, who and how"
        )
        parser.add_argument(
            "--against",
            action="append",
            default=[],
            metavar="FILE",
            help="another's benchmark_pairs.csv, to compare with pair by pair; may be repeated",
        )
        parser.add_argument(
            "--other-data", action="store_true", help="allow other pairs, and mark the row"
        )
        return parser

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Reads the command line, where overrides may stand between options."""
        parser = self.parser()
        options = parser.parse_intermixed_args(list(arguments))
        if options.data is None:
            parser.error("--data PATH is needed: the recordings, in the tidy layout")
        if options.submission and (options.overrides or options.method):
            parser.error("--submission takes the place of a method; leave its overrides out")
        if options.submission and options.card is None:
            parser.error("--card FILE is needed with --submission: who, paper, licence, trained_on")
        if options.seed and options.suite == "i80":
            parser.error("--seed: i80 freezes the seed 0, of its folds too")
        if options.quick and options.suite == "i80":
            parser.error("--quick: i80 is one recording; write --suite roads")
        options.arguments = list(arguments)
        return options

    def run(self, options: argparse.Namespace) -> int:
        if options.all:
            from cfx_report.benchmark.everything import run_all

            return run_all(options)
        from cfx_report.benchmark.compare import read_errors
        from cfx_report.benchmark.work import Recordings

        suite = _suite(options)
        entry = None
        if options.submission is None:
            entry = _entry(options)
        others = [(file, read_errors(Path(file))) for file in options.against]
        source = Path(options.data).expanduser().absolute()
        recordings = Recordings.read(suite, source, other_data=options.other_data)
        if entry is None:
            folder = _submission(options, recordings)
        else:
            folder = _row(options, entry, recordings)
        _print(folder, others, options)
        return 0


def _suite(options: argparse.Namespace) -> Suite:
    from cfx_report.benchmark.i80 import I80
    from cfx_report.benchmark.roads import QUICK, ROADS

    if options.suite == "i80":
        return I80
    return QUICK if options.quick else ROADS


def _entry(options: argparse.Namespace) -> Entry:
    from cfx_report.benchmark.entries import entry_of

    return entry_of(options.method, options.overrides, options.name, options.seed)


def _row(options: argparse.Namespace, entry: Entry, recordings: Recordings) -> Path:
    """Makes a row, and that of the baseline before it, which scores are relative to."""
    from cfx_report.benchmark.entries import entry_of, folder_of
    from cfx_report.benchmark.work import make_row

    suite = recordings.suite
    folder = options.output or folder_of(suite, entry.name)
    if suite.name != "i80" and entry.name != suite.baseline:
        baseline = folder_of(suite, suite.baseline, folder.parent)
        print(f"Scores are relative to the row '{suite.baseline}': {baseline}", flush=True)
        make_row(entry_of(None, suite.baseline_words, suite.baseline, 0), recordings, baseline, 0)
    print(f"Benchmark {recordings.protocol}, row '{entry.name}': {folder}", flush=True)
    make_row(entry, recordings, folder, options.seed)
    return Path(folder)


def _submission(options: argparse.Namespace, recordings: Recordings) -> Path:
    from cfx_report.benchmark.entries import folder_of
    from cfx_report.benchmark.submission import score_submission

    name = options.name or options.submission[0].stem
    folder = options.output or folder_of(recordings.suite, name)
    score_submission(options.submission, options.card, recordings, folder, name)
    return Path(folder)


def _print(
    folder: Path, others: Sequence[tuple[str, pd.DataFrame]], options: argparse.Namespace
) -> None:
    """Prints a row, and how it compares."""
    from cfx_report.benchmark.board import Entered, lines_of_row
    from cfx_report.benchmark.compare import compared, lines_of
    from cfx_report.benchmark.row import PAIRS, ROW

    mine = Entered.read(folder)
    row = mine.row
    print(f"\nThe row, on {row.pairs} pairs of {row.drivers} unseen drivers:\n")
    print("\n".join(lines_of_row(mine)))
    if options.quick:
        print(
            "\nTwo roads, where each is learned from the other alone: this shows that a method"
            " runs, not how good it is; leave --quick out for that."
        )
    for file, table in others:
        print("\n".join(["", *lines_of(compared(mine.errors, table, file))]))
    print(f"\nThe row: {folder / ROW}\nErrors of each pair: {folder / PAIRS}")
    if not others:
        again = shlex.join(["python", "-m", "cfx", "benchmark", *options.arguments])
        print(f"Compare it, without running again: {again} --against FILE, another's {PAIRS}")


class TableCommand(Command):
    """Prints rows of the benchmark beside one another, and writes the page of them."""

    summary = "rows of the benchmark as one table, and as a page"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser("cfx benchmark table", description=self.__doc__)
        parser.add_argument(
            "rows",
            nargs="+",
            type=Path,
            metavar="ROW",
            help="folders of rows, benchmark.json, or a file of many rows (--save)",
        )
        parser.add_argument(
            "--page", type=Path, metavar="FILE", help="write the leaderboard as one HTML file"
        )
        parser.add_argument(
            "--json", type=Path, metavar="FILE", help="write what is printed, and more, as data"
        )
        parser.add_argument(
            "--save",
            type=Path,
            metavar="FILE.parquet",
            help="write the rows with the errors of each pair as one file, which may be a ROW",
        )
        return parser

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Reads the command line."""
        from cfx_report.benchmark.board import SAVED

        parser = self.parser()
        options = parser.parse_args(list(arguments))
        if options.save is not None and options.save.suffix != SAVED:
            parser.error(f"--save {options.save}: give the file a name that ends in {SAVED}")
        return options

    def run(self, options: argparse.Namespace) -> int:
        from cfx_report.benchmark.board import Entered, lines_of_rows, save_rows, write_standings

        rows = Entered.read_several(options.rows)
        print("\n".join(lines_of_rows(rows)))
        if options.json is not None:
            write_standings(rows, options.json)
            print(f"\nAs data: {options.json}")
        if options.save is not None:
            save_rows(rows, options.save)
            print(f"\nThe rows: {options.save}")
        if options.page is not None:
            from cfx_report.benchmark.leaderboard import write_page

            print(f"\nThe page: {write_page(rows, options.page)}")
        return 0


class PublishedCommand(Command):
    """Scores a method on pairs and events that others have published, beside their numbers."""

    summary = "a method on published splits, beside the published numbers"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser("cfx benchmark published", description=self.__doc__)
        parser.add_argument(
            "split",
            choices=["segments", "transfollower", "follownet", "opencf"],
            help="whose; opencf writes a submission for OpenCF-Benchmark",
        )
        parser.add_argument(
            "overrides",
            nargs="+",
            metavar="OVERRIDE",
            help="model=, rival= and their settings; or driver=cfx://idm, or a job's folder",
        )
        parser.add_argument("--learn", nargs="+", type=Path, metavar="FILE", help="to learn from")
        parser.add_argument(
            "--test", nargs="+", type=Path, metavar="FILE", required=True, help="to be driven"
        )
        parser.add_argument(
            "--pairs",
            type=Path,
            metavar="FILE",
            help="text: the ids of the tested pairs, one a line",
        )
        parser.add_argument(
            "--output",
            type=Path,
            metavar="FILE",
            help="CSV: errors of each pair, or the submission",
        )
        parser.add_argument("--samples", type=int, default=6, help="of opencf; default: 6")
        parser.add_argument("--seed", type=int, default=0, help="of training; default: 0")
        return parser

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Reads the command line, where overrides may stand between options."""
        parser = self.parser()
        options = parser.parse_intermixed_args(list(arguments))
        if options.split == "opencf" and (options.output is None or len(options.test) != 1):
            parser.error("opencf takes one --test test_input.csv and writes --output FILE")
        if not 1 <= options.samples <= 6:
            parser.error(f"--samples {options.samples}: OpenCF takes 1 to 6")
        return options

    def run(self, options: argparse.Namespace) -> int:
        from cfx_report.benchmark import opencf, published
        from cfx_report.benchmark.entries import entry_of

        entry = entry_of(None, options.overrides, None, options.seed)
        if options.split == "opencf":
            learned = None
            if options.learn:
                learned = opencf.read_opencf(options.learn[0])[0]
            driven = opencf.write_opencf(
                entry, learned, options.test[0], options.output, options.samples, options.seed
            )
            print(f"{driven} pairs driven from 3.0 s on: {options.output}")
            return 0
        tested = published.read(options.test, options.pairs)
        learned = published.read(options.learn, None) if options.learn else None
        errors = published.scores(entry, learned, tested, options.seed)
        print("\n".join(published.lines(published.SPLITS[options.split], entry.name, errors)))
        if options.output is not None:
            from cfx.plugin import files

            files.write_output(
                options.output, errors.to_csv(index=False), "the errors of each pair"
            )
        return 0


class WatchCommand(Command):
    """Says what 0 to 40 s of watching a driver bring, on roads that are left out."""

    summary = "what some seconds of watching a driver bring"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser("cfx benchmark watch", description=self.__doc__)
        parser.add_argument("overrides", nargs="+", metavar="OVERRIDE", help="as of cfx benchmark")
        parser.add_argument("--data", type=Path, metavar="FOLDER", required=True, help="recordings")
        parser.add_argument("--method", choices=list(METHODS), help="how a model is used")
        parser.add_argument("--quick", action="store_true", help="two roads alone")
        parser.add_argument("--seed", type=int, default=0, help="of training; default: 0")
        parser.add_argument(
            "--other-data", action="store_true", help="allow other pairs than the suite's"
        )
        return parser

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Reads the command line, where overrides may stand between options."""
        return self.parser().parse_intermixed_args(list(arguments))

    def run(self, options: argparse.Namespace) -> int:
        from cfx_report.benchmark.entries import entry_of, folder_of
        from cfx_report.benchmark.roads import QUICK, ROADS
        from cfx_report.benchmark.watching import SECONDS, lines, watch
        from cfx_report.benchmark.work import Recordings

        suite = QUICK if options.quick else ROADS
        entry = entry_of(options.method, options.overrides, None, options.seed)
        source = options.data.expanduser().absolute()
        recordings = Recordings.read(suite, source, other_data=options.other_data)
        folder = folder_of(suite, entry.name)
        errors = watch(entry, recordings, folder, options.seed, SECONDS)
        print(
            "\n".join(["", *lines(errors), "", f"Errors of each pair: {folder / 'watching.csv'}"])
        )
        return 0

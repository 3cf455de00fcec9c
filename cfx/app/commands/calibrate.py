"""`cfx calibrate FILE`: a job that calibrates and trains nothing, in one word."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from cfx.core.command import Command
from cfx.core.files import path_override
from cfx.core.storage import path_or_url
from cfx.errors import ConfigError

_CHOSEN = {"policy": "fixed", "protocol": "within_driver"}
"""What a calibration chooses in place of the usual options; the command line may choose others."""


class CalibrateCommand(Command):
    """Calibrates a driving model to recordings."""

    summary = "calibrate a model to recordings: cfx calibrate pairs.csv model=idm"

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            "cfx calibrate",
            description="Calibrates a driving model to each driver of recordings, on the first part"
            " of their trajectories, and tests it on the rest.",
        )
        parser.add_argument(
            "words",
            nargs="+",
            metavar="FILE|KEY=VALUE",
            help="recordings of one layout, and settings of the job: model=idm"
            " objective=gap_rmse protocol=across_drivers (pooled parameters too) split=0.5",
        )
        parser.add_argument(
            "-m", "--multirun", action="store_true", help="a job for each of model=idm,krauss"
        )
        parser.add_argument("--verbose", action="store_true", help="print all that was measured")
        return parser

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        return self.parser().parse_intermixed_args(list(arguments))

    def run(self, options: argparse.Namespace) -> int:
        from cfx.app import application

        arguments = overrides_of(options.words)
        if options.verbose:
            arguments.append("output.verbose=true")
        if options.multirun:
            arguments = ["--multirun", *arguments]
        return application.start(arguments)


def overrides_of(words: Sequence[str]) -> list[str]:
    """Returns the overrides of the job that calibrates a model; words are files and overrides.

    Raises:
        ConfigError: an override chooses a policy that is trained.
        DataError: a file cannot be read, or no dataset knows its layout.
    """
    typed: list[str] = []
    files: list[Path | str] = []
    keys = set()
    has_named_columns = False
    for word in words:
        key, is_override, value = word.partition("=")
        if not is_override:
            files.append(path_or_url(word))
            continue
        if key == "policy" and value not in {"fixed", "default"}:
            raise ConfigError(
                f"cfx calibrate trains no policy: leave {word} out, or write cfx {word}"
            )
        has_named_columns |= word.startswith(("data.columns", "data.units"))
        keys.add(key)
        typed.append(word)
    overrides = [f"{key}={value}" for key, value in _CHOSEN.items() if key not in keys]
    if files and "data" not in keys:
        from cfx.data.describe import dataset_of

        # Names and units of columns are settings of `data=tidy` alone.
        dataset = "tidy" if has_named_columns else dataset_of(files[0])
        overrides.append(f"data={dataset}")
    if len(files) == 1:
        overrides.append(path_override("data.path", files[0]))
    elif files:
        paths = [path_override("", file).removeprefix("=") for file in files]
        overrides.append(f"data.path=[{','.join(paths)}]")
    return [*overrides, *typed]

"""Scores files that anybody has made, without their code."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from cfx.errors import DataError
from cfx_report.benchmark import predictions
from cfx_report.benchmark.row import Row
from cfx_report.benchmark.work import Recordings, write_row

CARD = {
    "who": "names of the authors",
    "paper": "where the method is published, or 'none'",
    "licence": "of the predictions",
    "trained_on": "recordings that were learned from, and how tested drivers were left out",
}
"""What a card says."""


def score_submission(
    paths: Sequence[Path], card: Path, recordings: Recordings, folder: Path, name: str
) -> Row:
    """Scores files of trajectories and forecasts, and writes their row.

    Args:
        paths: one of each kind at most.
        card: JSON, with the texts of `CARD`.
        recordings: of the suite.
        folder: of the row, which gets copies.
        name: of the row.

    Raises:
        DataError: a file or the card is wrong, in one sentence with row and column.
    """
    about = read_card(card)
    tables: dict[str, tuple[Path, pd.DataFrame]] = {}
    for path in paths:
        table = predictions.read(path)
        kind = predictions.FORECASTS if "horizon_s" in table else predictions.TRAJECTORIES
        if kind in tables:
            raise DataError(f"{path}: is the second file of {kind.partition('.')[0]}; give one")
        tables[kind] = (path, table)
    row = write_row(
        recordings,
        folder,
        tables,
        name=name,
        command=f"cfx benchmark --suite {recordings.suite.name} --submission",
        seconds={},
        flows={},
        card=about,
    )
    for kind, (_, table) in tables.items():
        predictions.write(table, folder / kind)
    return row


def read_card(path: Path) -> dict[str, str]:
    """Reads a card.

    Raises:
        DataError: it cannot be read, or does not say everything.
    """
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: is no card; write JSON ({error})") from None
    for key, meaning in CARD.items():
        if (
            not isinstance(card, dict)
            or not isinstance(card.get(key), str)
            or not card[key].strip()
        ):
            raise DataError(f'{path}: "{key}" is missing: {meaning}')
    return {key: str(value) for key, value in card.items()}

"""A demonstration: what a finished job shows besides tables and figures. This one is a page.

A job calls `check` before its work and `write` at its end. The page ranks the pairs by how well
the policy followed them.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from cfx.plugin import Demo, PairSet

PAGE = "demo.html"
"""The job says where a page of this name is."""


class Ranking(Demo):
    """Lists the pairs of a job, the policy's smallest error of speed first."""

    def write(
        self,
        folder: Path,
        pairs: PairSet,
        policy: Any,
        evaluation: Any,
        protocol: Mapping[str, Any],
    ) -> list[Path]:
        table = evaluation.table
        ranked = table[table["method"] == "policy"].sort_values("rmse_speed")
        text = f"<!doctype html>\n<title>Pairs</title>\n<h1>{escape(pairs.source)}</h1>\n<ol>\n"
        for row in ranked.to_dict("records"):
            text += f"<li>{escape(row['pair_id'])}: {row['rmse_speed']:.2f} m/s</li>\n"
        page = folder / PAGE
        page.write_text(f"{text}</ol>\n", encoding="utf-8")
        return [page]

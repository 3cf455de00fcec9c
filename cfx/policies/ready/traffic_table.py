"""The table of traffic of a ready-made policy, which stands on its card.

`traffic.json` beside the card holds what `cfx drive stress --traffic` measured, and its command.
"""

from __future__ import annotations

import json
from typing import Any

from cfx.policies.ready import SCHEME, folder_of_ready_made

__all__ = [
    "FILE",
    "outside_words",
    "traffic_lines",
    "traffic_of",
]
"""What plugins may use, as `cfx.plugin.traffic_table`."""

FILE = "traffic.json"


def traffic_of(name: str) -> dict[str, Any] | None:
    """Returns what was measured of a policy; None if nothing was.

    Raises:
        DataError: there is no such policy.
    """
    file = folder_of_ready_made(f"{SCHEME}{name.removeprefix(SCHEME)}") / FILE
    if not file.is_file():
        return None
    measured: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return measured


def traffic_lines(measured: dict[str, Any]) -> list[str]:
    """Returns the section of a card as Markdown, word by word as it was measured."""
    lines = [
        "## Traffic",
        "",
        f"Flows beside those of recorded drivers ({measured['recorded']}), within 10 %.",
        "",
        "| | step, s | measured | usual | |",
        "| --- | ---: | ---: | ---: | --- |",
    ]
    for row in measured["rows"]:
        word = f"**{row['outside']}**" if row["outside"] else ""
        cells = (row["meaning"], f"{row['step_s']:g}", row["text"], row["usual"], word)
        lines.append(f"| {' | '.join(cells)} |")
    lines.append("")
    gaps = measured.get("time_gaps") or []
    if gaps:
        lines += [
            "Time gaps of a fleet, each vehicle with a driver of its own, beside recorded ones"
            " (25, 50, 75 % of drivers, s):",
            "",
            "| speed, m/s | fleet | recorded |",
            "| ---: | --- | --- |",
        ]
        for row in gaps:
            driven, there = _listed(row["driven_s"]), _listed(row["recorded_s"])
            lines.append(f"| {row['speed_mps']:g} | {driven} | {there} |")
    else:
        lines.append("A fleet is one average driver: the policy knows no drivers to draw from.")
    return [*lines, "", "Measured by", "", "```", measured["command"], "```", ""]


def outside_words(measured: dict[str, Any]) -> tuple[int, int]:
    """Returns how many values are outside of what is usual, and how many have usual values."""
    outside = compared = 0
    for row in measured["rows"]:
        if row["usual"]:
            compared += 1
            outside += bool(row["outside"])
    return outside, compared


def _listed(values: list[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)

"""What SUMO leaves out of a scenario, by its own warnings.

SUMO warns of much that a run counts anyway (teleports, collisions, hard braking), so its warnings
are not shown. They go to a file, and those are kept by which a vehicle or a flow never enters.
"""

from __future__ import annotations

import re
from pathlib import Path

_LEFT_OUT = re.compile(
    r"sorted by departure time, ignoring"
    r"|is not allowed to depart"
    r"|^Warning: Invalid depart\w+ definition for vehicle"
    r"|has no (valid )?route"
)
"""SUMO's words for a vehicle or a flow that it ignores or removes; most only where the user has set
`ignore-route-errors`, without which SUMO ends the run."""


def left_out(log: Path) -> tuple[str, ...]:
    """Returns what SUMO says it left out of a simulation, a sentence for each vehicle or flow.

    Args:
        log: SUMO's `--error-log`, complete once the simulation is closed.
    """
    if not log.is_file():
        return ()
    sentences: dict[str, None] = {}  # in their order, each once
    for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
        if _LEFT_OUT.search(line):
            sentences[line.removeprefix("Warning: ")] = None
    return tuple(sentences)

"""A job in a few lines of Markdown: what MLflow shows as the run's description."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

from cfx.core.errors import without_passwords
from cfx.evaluation.headline import headline
from cfx.evaluation.result import Purpose
from cfx.results.config import JobConfig
from cfx.results.table import Findings

_CHOSEN = ("model", "policy", "learner", "optimizer", "objective", "protocol")


def described(config: JobConfig, findings: Findings, metrics: Mapping[str, float]) -> str:
    """Returns what the job is, its result, its recordings, and the command that was typed.

    Args:
        config: of the job.
        findings: of the job.
        metrics: its results.
    """
    pairs = findings.pairs
    chosen = []
    for group in _CHOSEN:
        if group == "learner" and findings.evaluation.purpose is Purpose.CALIBRATION:
            continue
        chosen.append(f"{group} **{getattr(config, group)['name']}**")
    drivers = len({pair.driver for pair in pairs})
    _, result = headline(metrics)
    source = Path(pairs.source).name
    lines = [
        f"{result[:1].upper()}{result[1:]}.",
        "",
        ", ".join(chosen) + ".",
        "",
        f"{len(pairs)} pairs of {drivers} drivers from {source} (data **{config.data['name']}**),"
        f" in steps of {pairs.dt:g} s; seed {config.seed}.",
    ]
    typed = [without_passwords(one) for one in sys.argv[1:]]
    if typed and Path(sys.argv[0]).name in {"cfx", "__main__.py"}:
        lines += ["", "```", f"cfx {' '.join(typed)}", "```"]
    return "\n".join(lines)

"""The project's own words of earlier versions are gone: the field's words stand everywhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.conftest import ROOT

WORDS: dict[str, str] = {
    r"strangers?": "unseen driver(s); cold start",
    r"(?<!unless )told(?! (?:apart|not to|otherwise))": "conditioned (on driver features); says",
    r"traits?": "driver features",
    r"taught|untaught|teachers?|teaches|pupils?": "distillation; expert and student",
    r"committees?": "ensemble",
    r"w99_reaching|model\.reach|the reach": "w99_wide; model.adaptation_bounds",
    r"softness": "temperature",
    r"damping": "gradient_decay",
    r"truncation": "tbptt_windows",
    r"bent ends|bent at": "boundary artefacts of smoothing (Montanino & Punzo)",
    r"the mark": "upper reference (direct-acceleration network)",
    r"drawn (?:towards|sets?|by 0)|own, drawn": "shrunk",
    r"known[ _]drivers|told_drivers|calm_strangers": "with_history, conditioned, unseen_drivers",
    r"rollout_taught": "rollout_distilled",
    r"history read|reads? (?:a driver's )?history|reading history": "burn-in, context, history",
    r"window labels?": "per-window calibrated parameters (labels)",
    r"driver features features|training_data data": "a slip of an automatic rename",
    r"beyond the first (?:5|five) (?:s|seconds)": "after the transient (transient_s); steady",
    r"START_S": "transient_s",
    r"drives\.parquet": "trajectories.parquet",
    r"(?:a|the|each|every|whole|test|training|recorded|per|one|another|this|their) drive(?! off)": (
        "trajectory, rollout"
    ),
    r"(?:the|whole|test|training|recorded|closed-loop|these|those|of|all|made-up) drives": (
        "trajectories, rollouts"
    ),
    r"he|him|his|himself": "they, them, their (a driver); it (a policy)",
}
"""Words that nobody but us would understand, as regular expressions, and what to write instead."""

EXACT: dict[str, str] = {
    r"\bLetters:": "Shapes:",
    r"\b(?:class|import|:|->) (?:Lesson|Learned|Material)\b|\b(?:Lesson|Learned|Material)\(": (
        "TrainingData, TrainingResult, RolloutDataset"
    ),
    r"\bStudy\b": "ProtocolContext",
    r"\bOutcome\b": "ProtocolResult, JobStatus",
    r"\b(?:cfx[./])?(?:probes|mistakes)\.py\b|cfx\.(?:probes|mistakes)\b": ("user_errors.py"),
    r"(?<![\w/.])later/": "steady/",
    r"(?<![\w/.])whole/": "full_trajectory/",
    r"\bfiles\.whole\(|\bimport whole\b|\bwith whole\(": "atomic_write(",
    r"\bfollows = (?:True|False)|\bclaims `follows`": "has_constant_baseline",
}
"""The same where the case of letters or the characters beside them matter."""

SUFFIXES = {".py", ".md", ".yaml", ".toml", ".html", ".js", ".j2", ".tmpl", ".txt"}


def texts() -> list[Path]:
    """Returns the files that a user or a reader of the code reads."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "Makefile"]
    for folder in ("cfx", "conf", "docs", "plugins"):
        for path in sorted((ROOT / folder).rglob("*")):
            hidden = "__pycache__" in path.parts or ".min." in path.name
            if path.suffix in SUFFIXES and not hidden:
                found.append(path)
    return found


def patterns() -> list[tuple[re.Pattern[str], str]]:
    compiled = []
    for words, instead in WORDS.items():
        compiled.append((re.compile(rf"\b(?:{words})\b", re.IGNORECASE), instead))
    for expression, instead in EXACT.items():
        compiled.append((re.compile(expression), instead))
    return compiled


def old_words(text: str) -> list[tuple[int, str, str]]:
    """Returns line, word and what to write instead, for each old word."""
    found = []
    known = patterns()
    for number, line in enumerate(text.splitlines(), start=1):
        for pattern, instead in known:
            for hit in pattern.finditer(line):
                found.append((number, hit.group(), instead))
    return found


def test_the_old_words_are_gone() -> None:
    wrong = []
    for path in texts():
        for number, word, instead in old_words(path.read_text(encoding="utf-8")):
            where = path.relative_to(ROOT).as_posix()
            wrong.append(f"{where}:{number}: '{word}': write {instead}")
    assert not wrong, f"{len(wrong)} old words\n" + "\n".join(wrong)


@pytest.mark.parametrize(
    ("text", "hits"),
    [
        ("policies for strangers, which a teacher taught", 3),
        ("he drives as his leader does", 2),
        ("the policy drives; drivers drive; `cfx drive` runs a scenario", 0),
        ("RMSE over the whole drive, and over all drives", 2),
        ("later/rmse_speed/policy and whole/rmse_gap/policy", 2),
        ("files.whole(path); then whole(x)", 1),
        ("folder/later/on, this happens sooner or later; the whole trajectory", 0),
        ("Letters: D drivers. The letters of the paper.", 1),
        ("told apart; float64 unless told otherwise; the theory of others", 0),
    ],
)
def test_the_search_sees_what_it_should(text: str, hits: int) -> None:
    assert len(old_words(text)) == hits


def test_every_kind_of_text_is_searched() -> None:
    names = {str(path.relative_to(ROOT)) for path in texts()}
    expected = {
        "README.md",
        "docs/results.md",
        "conf/config.yaml",
        "cfx/cli.py",
        "plugins/cfx-idm/README.md",
    }
    assert expected <= names

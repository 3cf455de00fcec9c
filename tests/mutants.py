"""Changes code at random, one place at a time, and says which changes no test notices.

    python -m tests.mutants --count 300 --seed 0 --rooms calibration simulation

Cosmic Ray makes the mutants: another operator, comparison or number, a branch or a decorator left
out. They are drawn by a seed, the place first and then the change, so that places with many possible
changes do not outweigh others. What changes annotations alone, or `strict` of a `zip`, is left out.
Each mutant is a change of a copy of the checkout in `.mutants`, and runs against the tests of its
room there, those that import its module first: the first failure kills it, as does a run of more
than three times as long as without a change.

Verdicts are kept in `.mutants/verdicts.jsonl`, by the content of what was changed: a run that
was interrupted goes on, and a mutant of a file that has changed since is tried again. The table of
survivors lists each with its line before and after. Some cannot be noticed: a bound of memory, a
number of things done at once, a digit beyond rounding. The others want a test.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import importlib
import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tests.checkout import ROOT

ROOMS = ("evaluation", "calibration", "learners", "policies", "simulation", "models")
FOLDER = ROOT / ".mutants"
TREE = FOLDER / "tree"
"""The copy of the checkout, whose files are changed and tested."""
LEAST_TIMEOUT_S = 60.0
SLOWER = 3.0
"""A mutant that takes so many times as long as the tests without a change is killed."""

TESTS = ("-x", "-q", "-n0", "-p", "no:cacheprovider", "--timeout=0")


class Mutant(NamedTuple):
    """One change.

    Attributes:
        module: path of the file, below the checkout.
        operator: of Cosmic Ray.
        occurrence: which place of the operator in the file.
        line: on which it changes something.
    """

    module: str
    operator: str
    occurrence: int
    line: int

    @property
    def room(self) -> str:
        """The room that the file is in."""
        return Path(self.module).parts[1]


class Verdict(NamedTuple):
    """What tests say of a mutant: killed, survived or timeout; and its line before and after."""

    outcome: str
    before: str
    after: str


def places(module: Path) -> Iterator[tuple[int, Mutant]]:
    """Yields the mutants of a file, each with the place in it: the position of what is changed."""
    plugins = importlib.import_module("cosmic_ray.plugins")
    trees = importlib.import_module("cosmic_ray.ast")
    tree = trees.get_ast(module.read_text(encoding="utf-8"))
    name = module.relative_to(TREE).as_posix()
    nodes = list(_in_order(tree))
    for operator in plugins.operator_names():
        if plugins.get_operator(operator).arguments():
            continue  # is told which variable to replace
        changes = plugins.get_operator(operator)()
        occurrence = 0
        for node in nodes:
            for (line, column), _ in changes.mutation_positions(node):
                yield line * 1_000 + column, Mutant(name, operator, occurrence, line)
                occurrence += 1


def _in_order(node: Any) -> Iterator[Any]:
    """Yields the nodes of a tree as Cosmic Ray counts them: a node before its children."""
    yield node
    for child in getattr(node, "children", ()):
        yield from _in_order(child)


def mutated(mutant: Mutant) -> str | None:
    """Returns the changed file; None where what is changed alone cannot be noticed."""
    mutating = importlib.import_module("cosmic_ray.mutating")
    plugins = importlib.import_module("cosmic_ray.plugins")
    before = (TREE / mutant.module).read_text(encoding="utf-8")
    changes = plugins.get_operator(mutant.operator)()
    after: str | None = mutating.mutate_code(before, changes, mutant.occurrence)
    if after is None or _noticeable(after) == _noticeable(before):
        return None
    return after


def _noticeable(source: str) -> str:
    """Returns what tests may notice of a file, in one form.

    Without annotations, and without `zip`'s `strict`: it guards against a mistake in the file.
    """
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return source
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign):
            node.annotation = ast.Constant(value=None)
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.Call):
            node.keywords = [keyword for keyword in node.keywords if keyword.arg != "strict"]
    return ast.dump(tree)


def drawn(rooms: Sequence[str], count: int, seed: int) -> Iterator[Mutant]:
    """Yields so many mutants, drawn among all places of the rooms."""
    by_place: dict[tuple[str, int], list[Mutant]] = {}
    for room in rooms:
        for module in sorted((TREE / "cfx" / room).rglob("*.py")):
            for place, mutant in places(module):
                by_place.setdefault((mutant.module, place), []).append(mutant)
    generator = random.Random(seed)  # noqa: S311 - no secret
    order = sorted(by_place)
    generator.shuffle(order)
    yielded = 0
    for place in order:
        mutant = generator.choice(by_place[place])
        if yielded < count and mutated(mutant) is not None:
            yielded += 1
            yield mutant


def copy_checkout() -> None:
    """Copies the files of the checkout that git does not ignore."""
    shutil.rmtree(TREE, ignore_errors=True)
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    for name in listed.stdout.split("\0"):
        source = ROOT / name
        if name and source.is_file():
            target = TREE / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)


def tests_of(mutant: Mutant) -> list[str]:
    """Returns what pytest runs: files of the room that import the module first, then the room."""
    dotted = mutant.module.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    first = []
    for file in sorted((TREE / "tests" / mutant.room).rglob("test_*.py")):
        if dotted in file.read_text(encoding="utf-8"):
            first.append(file.relative_to(TREE).as_posix())
    return [*first, f"tests/{mutant.room}"]


def fails(tests: Sequence[str], timeout_s: float | None) -> bool | None:
    """Runs tests of the copy; says whether they fail, None where they take too long."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(TREE),
        "PYTHONDONTWRITEBYTECODE": "1",
        "CFX_KERNEL_CACHE": str(FOLDER / "kernels"),
    }
    (FOLDER / "kernels").mkdir(mode=0o700, exist_ok=True)
    command = [sys.executable, "-m", "pytest", *TESTS, *tests]
    try:
        done = subprocess.run(
            command,
            cwd=TREE,
            env=environment,
            capture_output=True,
            check=False,
            timeout=timeout_s,
        )
    except subprocess.TimeoutExpired:
        return None
    return done.returncode != 0


def seconds_without_change(room: str) -> float:
    """Returns how long a room's tests take, the second time, when code is compiled.

    Raises:
        SystemExit: they fail.
    """
    tests = [f"tests/{room}"]
    if fails(tests, None):
        sys.exit(f"tests/{room} fails in a copy without a change: {TREE}")
    began = time.monotonic()
    fails(tests, None)
    return time.monotonic() - began


def judged(mutant: Mutant, timeout_s: float) -> Verdict:
    """Runs the tests of a mutant's room against it."""
    path = TREE / mutant.module
    source, changed = path.read_text(encoding="utf-8"), mutated(mutant)
    assert changed is not None
    path.write_text(changed, encoding="utf-8")
    try:
        outcome = {True: "killed", False: "survived", None: "timeout"}
        verdict = outcome[fails(tests_of(mutant), timeout_s)]
    finally:
        path.write_text(source, encoding="utf-8")
    before, after = _first_difference(source.splitlines(), changed.splitlines())
    return Verdict(verdict, before, after)


def _first_difference(before: list[str], after: list[str]) -> tuple[str, str]:
    for line, changed in zip(before, after, strict=False):
        if line != changed:
            return line.strip(), changed.strip()
    return "", ""


def key_of(mutant: Mutant) -> str:
    """Returns what a verdict belongs to: the mutant, in a file of this content."""
    content = (TREE / mutant.module).read_bytes()
    named = f"{mutant.module} {mutant.operator} {mutant.occurrence} ".encode()
    return hashlib.sha256(named + content).hexdigest()


def kept() -> dict[str, Verdict]:
    """Returns the verdicts of earlier runs."""
    file = FOLDER / "verdicts.jsonl"
    verdicts = {}
    if file.is_file():
        for line in file.read_text(encoding="utf-8").splitlines():
            key, *verdict = json.loads(line)
            verdicts[key] = Verdict(*verdict)
    return verdicts


def keep(key: str, verdict: Verdict) -> None:
    """Adds a verdict to those that are kept."""
    with (FOLDER / "verdicts.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps([key, *verdict]) + "\n")


def table(verdicts: Sequence[tuple[Mutant, Verdict]]) -> str:
    """Returns the survivors in Markdown, below how many mutants of each room were noticed."""
    lines = ["| room | mutants | noticed |", "| --- | --- | --- |"]
    for room in ROOMS:
        outcomes = [verdict.outcome for mutant, verdict in verdicts if mutant.room == room]
        if outcomes:
            noticed = len(outcomes) - outcomes.count("survived")
            lines.append(f"| {room} | {len(outcomes)} | {noticed} |")
    lines += ["", "| survivor | before | after |", "| --- | --- | --- |"]
    for mutant, verdict in sorted(verdicts):
        if verdict.outcome == "survived":
            before, after = verdict.before.replace("|", "\\|"), verdict.after.replace("|", "\\|")
            lines.append(f"| {mutant.module}:{mutant.line} | `{before}` | `{after}` |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rooms", nargs="*", choices=ROOMS, default=list(ROOMS))
    options = parser.parse_args()
    os.nice(10)
    FOLDER.mkdir(parents=True, exist_ok=True)
    copy_checkout()
    verdict_of = kept()
    timeouts: dict[str, float] = {}
    verdicts = []
    for number, mutant in enumerate(drawn(options.rooms, options.count, options.seed), start=1):
        key = key_of(mutant)
        if key not in verdict_of:
            if mutant.room not in timeouts:
                usual = seconds_without_change(mutant.room)
                timeouts[mutant.room] = max(LEAST_TIMEOUT_S, SLOWER * usual)
            verdict_of[key] = judged(mutant, timeouts[mutant.room])
            keep(key, verdict_of[key])
        verdicts.append((mutant, verdict_of[key]))
        outcome = verdict_of[key].outcome
        print(f"{number}/{options.count} {outcome}: {mutant.module}:{mutant.line}", flush=True)
    text = table(verdicts)
    (FOLDER / "survivors.md").write_text(text + "\n", encoding="utf-8")
    print(f"\n{text}\n\nin {FOLDER / 'survivors.md'}")


if __name__ == "__main__":
    main()

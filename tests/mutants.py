"""Changes code at random, one place at a time, and says which changes no test notices.

    python -m tests.mutants --count 300 --seed 0 --rooms calibration simulation

Cosmic Ray makes the mutants: another operator, comparison or number, a branch or a decorator left
out. They are drawn by a seed, the place first and then the change, so that places with many possible
changes do not outweigh others. What changes annotations alone, or `strict` of a `zip`, is left out.
Each mutant is a change of a copy of the checkout in `.mutants`, and meets those tests of its room
that run its lines (coverage.py), files with the quickest first; where no test does by itself, as
with what is run on import, those of the whole room. They are as many as take `--seconds` without a
change. The first failure kills it, as does a run of more than three times as long.

Verdicts are kept in `.mutants/verdicts.jsonl`, by the content of what was changed and, of
survivors, of their room's tests: a run that was interrupted goes on, a mutant of a file that has
changed since is tried again, and so is a survivor when a test has. The table of survivors lists
each with its line before and after. Some cannot be noticed: a bound of memory, a
number of things done at once, a digit beyond rounding. The others want a test.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import importlib
import itertools
import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from tests.checkout import ROOT

ROOMS = ("evaluation", "calibration", "learners", "policies", "simulation", "models")
FOLDER = ROOT / ".mutants"
TREE = FOLDER / "tree"
"""The copy of the checkout, whose files are changed and tested."""
LEAST_TIMEOUT_S = 120.0
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


class Covered(NamedTuple):
    """Which tests of a room run which lines.

    Attributes:
        tests: that run a line, by file of the code and number of the line.
        seconds: that each test takes, with its fixtures.
    """

    tests: dict[str, dict[int, list[str]]]
    seconds: dict[str, float]

    @classmethod
    def by(cls, room: str) -> Covered:
        """Returns what the tests of a room run, from the last time if nothing has changed.

        Raises:
            SystemExit: they fail.
        """
        digest = digest_of("cfx", f"tests/{room}")
        file = FOLDER / f"covered-{room}.json"
        if file.is_file():
            saved = json.loads(file.read_text(encoding="utf-8"))
            if saved["digest"] == digest:
                by_number = {
                    module: {int(line): tests for line, tests in lines.items()}
                    for module, lines in saved["tests"].items()
                }
                return cls(by_number, saved["seconds"])
        covered = cls._measured(room)
        file.write_text(json.dumps({"digest": digest, **covered._asdict()}))
        return covered

    @classmethod
    def _measured(cls, room: str) -> Covered:
        coverage = importlib.import_module("coverage")
        data, times = FOLDER / f"coverage-{room}", FOLDER / f"times-{room}.xml"
        data.unlink(missing_ok=True)
        measuring = ["--cov", f"cfx/{room}", "--cov-context", "test", "--cov-report", ""]
        tests = [*measuring, "--junitxml", str(times), f"tests/{room}"]
        if fails(tests, None, COVERAGE_FILE=str(data)):
            sys.exit(f"tests/{room} fails in a copy without a change: {TREE}")
        seconds = {}
        for case in ElementTree.parse(times).iter("testcase"):  # noqa: S314 - pytest's own file
            name = f"{case.attrib['classname'].replace('.', '/')}.py::{case.attrib['name']}"
            seconds[name] = float(case.attrib["time"])
        ran = coverage.CoverageData(basename=str(data))
        ran.read()
        by_line: dict[str, dict[int, list[str]]] = {}
        for module in ran.measured_files():
            lines = by_line.setdefault(Path(module).relative_to(TREE).as_posix(), {})
            for line, contexts in ran.contexts_by_lineno(module).items():
                named = {context.rpartition("|")[0] for context in contexts}
                lines[line] = sorted(named & seconds.keys())
        return cls(by_line, seconds)

    def of(self, mutant: Mutant, most_s: float) -> list[str]:
        """Returns the quickest tests that run the statement of a mutant, the quickest file first.

        Args:
            mutant: where no test runs it, all tests of the room count.
            most_s: how long they take at most without a change; the quickest is kept in any case.
        """
        lines = self.tests.get(mutant.module, {})
        tests: set[str] = set()
        for line in _statement(TREE / mutant.module, mutant.line):
            tests.update(lines.get(line, ()))
        quickest = sorted(tests or self.seconds, key=lambda test: (self.seconds[test], test))
        ends = itertools.accumulate(self.seconds[test] for test in quickest)
        kept = [test for test, end in zip(quickest, ends, strict=True) if end <= most_s]
        kept = kept or quickest[:1]
        files = list(dict.fromkeys(test.partition("::")[0] for test in kept))
        return sorted(kept, key=lambda test: (files.index(test.partition("::")[0]), test))


def _statement(path: Path, line: int) -> range:
    """Returns the lines of the innermost statement that a line is in, without its body."""
    lines = range(line, line + 1)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or line):
            body = getattr(node, "body", None)
            end = body[0].lineno if body else (node.end_lineno or line) + 1
            if line < end:
                lines = range(node.lineno, end)
    return lines


def fails(tests: Sequence[str], timeout_s: float | None, **variables: str) -> bool | None:
    """Runs tests of the copy; says whether they fail, None where they take too long.

    Args:
        tests: what pytest is told to run.
        timeout_s: after which they are ended.
        variables: of the environment, further ones.
    """
    environment = {
        **os.environ,
        "PYTHONPATH": str(TREE),
        "PYTHONDONTWRITEBYTECODE": "1",
        "CFX_KERNEL_CACHE": str(FOLDER / "kernels"),
        **variables,
    }
    (FOLDER / "kernels").mkdir(mode=0o700, exist_ok=True)
    # Names of many tests are longer than a command may be.
    (FOLDER / "tests").write_text("\n".join(tests), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", *TESTS, f"@{FOLDER / 'tests'}"]
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


def judged(mutant: Mutant, tests: Sequence[str], usual_s: float) -> Verdict:
    """Runs tests against a mutant.

    Args:
        mutant: what is changed.
        tests: of its room.
        usual_s: how long they take without a change.
    """
    timeout_s = max(LEAST_TIMEOUT_S, SLOWER * usual_s)
    path = TREE / mutant.module
    source, changed = path.read_text(encoding="utf-8"), mutated(mutant)
    assert changed is not None
    path.write_text(changed, encoding="utf-8")
    try:
        outcome = {True: "killed", False: "survived", None: "timeout"}
        verdict = outcome[fails(tests, timeout_s)]
    finally:
        path.write_text(source, encoding="utf-8")
    before, after = _first_difference(source.splitlines(), changed.splitlines())
    return Verdict(verdict, before, after)


def _first_difference(before: list[str], after: list[str]) -> tuple[str, str]:
    for line, changed in zip(before, after, strict=False):
        if line != changed:
            return line.strip(), changed.strip()
    return "", ""


def digest_of(*folders: str) -> str:
    """Returns a digest of the Python files in folders of the copy."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted((TREE / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


class Verdicts:
    """The verdicts of earlier runs, in a file.

    Each has the key of its mutant in a file of its content, and the digest of the tests.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._verdicts: dict[str, tuple[str, Verdict]] = {}
        if file.is_file():
            for line in file.read_text(encoding="utf-8").splitlines():
                key, tests, *verdict = json.loads(line)
                self._verdicts[key] = tests, Verdict(*verdict)

    def of(self, mutant: Mutant) -> Verdict | None:
        """Returns a mutant's verdict; None: there is none, or tests changed since it survived."""
        tests, verdict = self._verdicts.get(self._key(mutant), ("", None))
        if verdict and verdict.outcome == "survived" and tests != self._tests(mutant):
            return None
        return verdict

    def keep(self, mutant: Mutant, verdict: Verdict) -> None:
        """Adds a verdict."""
        key, tests = self._key(mutant), self._tests(mutant)
        self._verdicts[key] = tests, verdict
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps([key, tests, *verdict]) + "\n")

    @staticmethod
    def _key(mutant: Mutant) -> str:
        content = (TREE / mutant.module).read_bytes()
        named = f"{mutant.module} {mutant.operator} {mutant.occurrence} ".encode()
        return hashlib.sha256(named + content).hexdigest()

    @staticmethod
    def _tests(mutant: Mutant) -> str:
        return digest_of(f"tests/{mutant.room}")


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
    parser.add_argument("--seconds", type=float, default=60.0, help="of tests for each mutant")
    options = parser.parse_args()
    os.nice(10)
    FOLDER.mkdir(parents=True, exist_ok=True)
    copy_checkout()
    kept = Verdicts(FOLDER / "verdicts.jsonl")
    covered: dict[str, Covered] = {}
    verdicts = []
    for number, mutant in enumerate(drawn(options.rooms, options.count, options.seed), start=1):
        verdict = kept.of(mutant)
        if verdict is None:
            if mutant.room not in covered:
                covered[mutant.room] = Covered.by(mutant.room)
            of_room = covered[mutant.room]
            tests = of_room.of(mutant, options.seconds)
            verdict = judged(mutant, tests, sum(of_room.seconds[test] for test in tests))
            kept.keep(mutant, verdict)
        verdicts.append((mutant, verdict))
        print(
            f"{number}/{options.count} {verdict.outcome}: {mutant.module}:{mutant.line}", flush=True
        )
    text = table(verdicts)
    (FOLDER / "survivors.md").write_text(text + "\n", encoding="utf-8")
    print(f"\n{text}\n\nin {FOLDER / 'survivors.md'}")


if __name__ == "__main__":
    main()

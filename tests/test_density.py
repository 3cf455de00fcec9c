"""Plain statements: few comprehensions and conditional expressions, short functions."""

from __future__ import annotations

import ast
import textwrap
from typing import NamedTuple

from tests.conftest import ROOT

COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)

MOST_COMPREHENSIONS = 15.0
"""In a thousand lines of `cfx/`."""

MOST_CONDITIONALS = 10.0
"""Conditional expressions, `a if b else c`, in a thousand lines of `cfx/`."""

LONG = 50
"""Lines from which a function is long; its docstring does not count."""

MOST_LONG = 0.01
"""Share of long functions among all."""


class Density(NamedTuple):
    """What one file or the whole package has."""

    lines: int
    comprehensions: int
    nested: tuple[int, ...]
    conditionals: int
    functions: int
    long: tuple[str, ...]


def density(source: str) -> Density:
    """Counts what a file has; `nested` holds the lines of comprehensions within others."""
    comprehensions = conditionals = functions = 0
    nested: list[int] = []
    long: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, COMPREHENSIONS):
            comprehensions += 1
            if _holds_another(node):
                nested.append(node.lineno)
        elif isinstance(node, ast.IfExp):
            conditionals += 1
        elif isinstance(node, FUNCTIONS):
            functions += 1
            length = _length(node)
            if length > LONG:
                long.append(f"{node.name} ({length} lines, line {node.lineno})")
    lines = len(source.splitlines())
    return Density(lines, comprehensions, tuple(nested), conditionals, functions, tuple(long))


def _holds_another(node: ast.AST) -> bool:
    """Says whether a comprehension has two loops, or another comprehension within."""
    loops = getattr(node, "generators", [])
    inner = [one for one in ast.walk(node) if isinstance(one, COMPREHENSIONS)]
    return len(loops) > 1 or len(inner) > 1


def _length(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Returns the lines of a function from its name to its end, without its docstring."""
    total = (node.end_lineno or node.lineno) - node.lineno + 1
    first = node.body[0]
    documented = ast.get_docstring(node, clean=False) is not None
    if documented and first.end_lineno is not None:
        total -= first.end_lineno - first.lineno + 1
    return total


def package() -> dict[str, Density]:
    """Returns each file of `cfx/`, but for the templates of new packages."""
    found = {}
    for path in sorted((ROOT / "cfx").rglob("*.py")):
        if "template" not in path.parts:
            name = str(path.relative_to(ROOT))
            found[name] = density(path.read_text(encoding="utf-8"))
    return found


def per_thousand(count: int, lines: int) -> float:
    return 1000.0 * count / lines


def worst(files: dict[str, Density], field: str) -> str:
    """Returns the ten files with most of something, for a message."""
    counts = [(getattr(one, field), name) for name, one in files.items()]
    counts.sort(reverse=True)
    return "\n".join(f"{count:4d} {name}" for count, name in counts[:10])


def test_no_comprehension_stands_within_another() -> None:
    wrong = []
    for name, one in package().items():
        for line in one.nested:
            wrong.append(f"{name}:{line}")
    assert not wrong, "write a loop with named values:\n" + "\n".join(wrong)


def test_comprehensions_are_few() -> None:
    files = package()
    lines = sum(one.lines for one in files.values())
    count = sum(one.comprehensions for one in files.values())
    assert per_thousand(count, lines) <= MOST_COMPREHENSIONS, worst(files, "comprehensions")


def test_conditional_expressions_are_few() -> None:
    files = package()
    lines = sum(one.lines for one in files.values())
    count = sum(one.conditionals for one in files.values())
    assert per_thousand(count, lines) <= MOST_CONDITIONALS, worst(files, "conditionals")


def test_long_functions_are_few() -> None:
    files = package()
    functions = sum(one.functions for one in files.values())
    long = []
    for name, one in files.items():
        for text in one.long:
            long.append(f"{name}: {text}")
    assert len(long) <= MOST_LONG * functions, "\n".join(long)


def test_the_counts_are_right() -> None:
    source = textwrap.dedent(
        '''
        def f(rows):
            """Text.

            More.
            """
            a = [x for row in rows for x in row]
            b = {k: [v for v in a] for k in a}
            return sum(x for x in a) if b else 0
        '''
    )
    found = density(source)
    assert found.comprehensions == 4
    assert len(found.nested) == 2
    assert (found.conditionals, found.functions, found.long) == (1, 1, ())
    body = "\n".join(f"    x{k} = {k}" for k in range(LONG))
    assert len(density(f"def g():\n{body}\n").long) == 1

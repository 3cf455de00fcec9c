"""Writes `api/plugin.md`, the page of `cfx.plugin`, from its stub and the docstrings of its names.

`make conf` runs it.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import re
from importlib import import_module
from pathlib import Path

import cfx
from cfx.plugin import MODULES

PAGE = Path(__file__).parent / "api" / "plugin.md"
STUB = Path(cfx.__file__).with_name("plugin.pyi")
HEAD = """# The door for plugins

All names of `cfx.plugin`, by what they are for. Base classes and records are imported by their
names, helpers by the module that they belong to: `canvas.blank(3.9)`, `threads.cores()`.
`make conf` writes this page from `cfx/plugin.pyi` and the docstrings.
"""


def text() -> str:
    """Returns the text of the page."""
    lines = [HEAD]
    source = STUB.read_text(encoding="utf-8").splitlines()
    sections = {n: line[2:] for n, line in enumerate(source, 1) if line.startswith("# ")}
    for node in ast.parse("\n".join(source)).body:
        while sections and min(sections) < node.lineno:
            lines += [
                f"## {sections.pop(min(sections))}\n",
                "| name | what it is |",
                "| --- | --- |",
            ]
        if not isinstance(node, ast.ImportFrom):
            continue
        for alias in node.names:
            if alias.name in MODULES:
                lines += module_rows(alias.name)
            else:
                lines.append(row(alias.name, first_sentence(f"cfx.{node.module}", alias.name)))
    page = "\n".join(lines) + "\n"
    return page.replace("|\n## ", "|\n\n## ")


def row(name: str, meaning: str) -> str:
    """Returns a row of a table."""
    meaning = re.sub(r"\s+", " ", meaning).replace("|", "\\|")
    return f"| `{name}` | {meaning} |"


def module_rows(name: str) -> list[str]:
    """Returns the rows of a name that is a module: its own, and one for each name in it."""
    module = import_module(MODULES[name])
    rows = [row(name, (module.__doc__ or "").partition("\n\n")[0])]
    for member in module.__all__:
        rows.append(row(f"{name}.{member}", first_sentence(module.__name__, member)))
    return rows


def first_sentence(module: str, name: str) -> str:
    """Returns the first sentence about a name.

    Of a constant or a name for a type it is in the text below its assignment, because the
    docstring of the value is that of its class; of everything else it is in the docstring.
    """
    documented = texts_below_assignments(module).get(name)
    if documented is None:
        documented = inspect.getdoc(getattr(import_module(module), name)) or ""
    return documented.partition("\n\n")[0]


def texts_below_assignments(module: str) -> dict[str, str]:
    """Returns the text below each assignment of a module, "" if there is none, by name."""
    body = ast.parse(inspect.getsource(import_module(module))).body
    texts = {}
    for node, below in itertools.pairwise([*body, ast.Pass()]):
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        text_below = ""
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            text_below = inspect.cleandoc(str(below.value.value))
        for name in ast.walk(node):
            if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store):
                texts[name.id] = text_below
    return texts


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")

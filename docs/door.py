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

PAGE = Path(__file__).parent / "api" / "plugin.md"
STUB = Path(cfx.__file__).with_name("plugin.pyi")
HEAD = """# The door for plugins

All names of `cfx.plugin`, by what they are for. `make conf` writes this page from
`cfx/plugin.pyi` and the docstrings.
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
            meaning = re.sub(r"\s+", " ", first_sentence(f"cfx.{node.module}", alias.name))
            lines.append(f"| `{alias.name}` | {meaning.replace('|', chr(92) + '|')} |")
    page = "\n".join(lines) + "\n"
    return page.replace("|\n## ", "|\n\n## ")


def first_sentence(module: str, name: str) -> str:
    """Returns the first sentence of a name's docstring; of a constant, of the text below it."""
    value = getattr(import_module(module), name)
    if callable(value) and hasattr(value, "__module__"):
        documented = inspect.getdoc(value) or ""
    else:
        documented = constants(module).get(name, "")
    return documented.partition("\n\n")[0]


def constants(module: str) -> dict[str, str]:
    """Returns the texts that stand below the assignments of a module, by the names assigned."""
    body = ast.parse(inspect.getsource(import_module(module))).body
    texts = {}
    for node, below in itertools.pairwise(body):
        is_text = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        if isinstance(node, ast.Assign | ast.AnnAssign) and is_text:
            for name in ast.walk(node):
                if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store):
                    texts[name.id] = inspect.cleandoc(str(below.value.value))
    return texts


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")

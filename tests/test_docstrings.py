"""Docstrings and comments name what is there: modules, their members and files."""

from __future__ import annotations

import ast
import importlib
import io
import re
import tokenize
from pathlib import Path

import pytest

from cfx.core import registry
from tests.checkout import ROOT, require_distributions

require_distributions()

CODE = (
    ROOT / "cfx",
    *sorted(path for path in ROOT.glob("plugins/*/*") if path.name.startswith("cfx_")),
)


def explanations(source: str) -> list[tuple[int, str]]:
    """Returns the docstrings, other bare strings and comments of a module, with their lines."""
    texts = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            texts.append((node.lineno, str(node.value.value)))
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            texts.append((token.start[0], token.string))
    return texts


def resolves(name: str) -> bool:
    """Says whether a dotted name is a module, or a member of one; fields of dataclasses too."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:count]))
        except ImportError:
            continue
        member: object = module
        for part in parts[count:]:
            if not hasattr(member, part):
                return part in getattr(member, "__annotations__", {})  # a field without a default
            member = getattr(member, part)
        return True
    return False


def missing_names(path: Path) -> list[str]:
    """Returns what a file's docstrings and comments name in backticks though it is not there.

    A name of `cfx` or of a plugin is a module or a member of one, an entry-point group, or a string
    that the file's code uses (a tag of MLflow's). A file lies in the folder of the one that names
    it, below that, or where its path says.
    """
    source = path.read_text(encoding="utf-8")
    groups = {registry.API_GROUP, registry.KINDS_GROUP}
    groups |= {kind.entry_points for kind in registry.every_kind().values()}
    missing = []
    for line, text in explanations(source):
        for name in re.findall(r"`([\w./]+)(?:\(.*?\))?`", text):
            is_module = re.fullmatch(r"cfx(_\w+)?(\.\w+)+", name) is not None
            if is_module and name not in groups and f'"{name}"' not in source:
                there = resolves(name)
            elif re.fullmatch(r"[\w/]+\.py", name):
                there = any(path.parent.rglob(name)) or (ROOT / name).is_file()
            else:
                there = True
            if not there:
                missing.append(f"{path.relative_to(ROOT)}:{line}: {name}")
    return missing


def test_docstrings_and_comments_name_what_is_there() -> None:
    missing = []
    for folder in CODE:
        for path in sorted(folder.rglob("*.py")):
            missing += missing_names(path)
    assert not missing, "\n".join(missing)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("`cfx.data.partitions` finds files", ["cfx.data.partitions"]),
        ("`cfx.data.files.partitions`, `cfx.models`, `Kind.first`", []),
        ("`cfx.data.pairs.Pair.leader_speed`", []),
        ("`gone.py` beside `here.py`", ["gone.py"]),
    ],
)
def test_a_name_that_is_gone_is_noticed(
    text: str, expected: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{__name__}.ROOT", tmp_path)
    path = tmp_path / "here.py"
    path.write_text(f'"""{text}"""\n')
    assert [line.rpartition(" ")[2] for line in missing_names(path)] == expected

"""Writes the templates of `cfx plugins new` from the components of `plugins/cfx-example`.

`make conf` runs it. A template is a component of the example, its tests and its preset, with the
names of the example left blank.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

EXAMPLE = Path(__file__).parent.parent / "cfx-example"
TEMPLATES = Path(__file__).parent / "cfx_contracts" / "template"
WITHOUT_TEMPLATE = {"section"}
"""Kinds whose components hold what the template language would take for its own."""


def components() -> Iterator[tuple[str, str, str]]:
    """Yields kind, name and class of each component of the example."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for group, announced in project["entry-points"].items():
        if group == "cfx.api":
            continue
        for name, target in announced.items():
            module, _, class_name = target.partition(":")
            kind = module.rpartition(".")[2]
            if kind not in WITHOUT_TEMPLATE:
                yield kind, name, class_name


def texts() -> dict[Path, str]:
    """Returns the text of each template but the common ones, by its path below `TEMPLATES`."""
    written = {}
    for kind, name, class_name in components():
        package = Path(kind) / "{{ package }}"
        files = {
            EXAMPLE / "cfx_example" / f"{kind}.py": package / f"{kind}.py.jinja",
            EXAMPLE / "tests" / f"test_{kind}.py": Path(kind, "tests", "test_{{ name }}.py.jinja"),
        }
        for preset in (EXAMPLE / "cfx_example" / "conf").glob(f"*/{name}_*.yaml"):
            blank = preset.name.replace(name, "{{ name }}", 1)
            files[preset] = package / "conf" / preset.parent.name / f"{blank}.jinja"
        for source, target in files.items():
            text = source.read_text(encoding="utf-8")
            written[target] = with_blanks(text, name, class_name)
    return written


def with_blanks(text: str, name: str, class_name: str) -> str:
    """Returns a text of the example with blanks for its package, a component and its class.

    The class is `Helly`, also at the beginning of `HellySettings`, but not in `Helly (1959)`.

    Raises:
        ValueError: the text holds what Jinja would take for its own.
    """
    if re.search(r"\{\{|\{%|\{#", text):
        raise ValueError(f"braces that Jinja reads stand in what begins with {text[:80]!r}")
    text = text.replace("cfx_example", "{{ package }}").replace("cfx-example", "{{ distribution }}")
    text = re.sub(rf"\b{class_name}(?=Settings\b|Stepper\b|\b)(?! \()", "{{ class_name }}", text)
    return re.sub(rf"(?<![a-zA-Z0-9]){name}(?![a-zA-Z0-9])", "{{ name }}", text)


def write() -> None:
    """Writes all templates, and removes those that no component gives any more."""
    current = texts()
    for path in TEMPLATES.rglob("*.jinja"):
        is_common = path.is_relative_to(TEMPLATES / "common")
        if not is_common and path.relative_to(TEMPLATES) not in current:
            path.unlink()
    for target, text in current.items():
        path = TEMPLATES / target
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write()

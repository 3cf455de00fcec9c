"""`cfx cite`: how to cite cfx, made from `CITATION.cff`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cfx
from cfx.core.command import Command


class CiteCommand(Command):
    """Prints how to cite cfx."""

    summary = "how to cite cfx, as BibTeX"

    def parser(self) -> argparse.ArgumentParser:
        return argparse.ArgumentParser("cfx cite", description="Prints how to cite cfx, as BibTeX.")

    def run(self, options: argparse.Namespace) -> int:
        print(bibtex())
        return 0


def citation_file() -> Path:
    """Returns `CITATION.cff`, inside an installed package or beside it in a checkout."""
    package = Path(cfx.__file__).resolve().parent
    inside = package / "CITATION.cff"
    if inside.is_file():
        return inside
    return package.parent / "CITATION.cff"


def bibtex() -> str:
    """Returns cfx's entry of a bibliography, and that of the method that it began from."""
    import yaml

    entry: dict[str, Any] = yaml.safe_load(citation_file().read_text(encoding="utf-8"))
    found = [_software(entry)]
    for reference in entry["references"]:
        found.append(_article(reference))
    return "\n\n".join(found)


def _software(entry: dict[str, Any]) -> str:
    names = [f"{{{author['name']}}}" for author in entry["authors"]]
    return _item(
        "software",
        "cfx",
        title=f"{{{entry['title']}}}",
        author=" and ".join(names),
        version=str(entry["version"]),
        note=f"{entry['license']} licence",
    )


def _article(entry: dict[str, Any]) -> str:
    names = []
    for author in entry["authors"]:
        names.append(f"{author['family-names']}, {author['given-names']}")
    key = f"{entry['authors'][0]['family-names'].lower()}{entry['year']}"
    return _item(
        "misc",
        key,
        title=f"{{{entry['title']}}}",
        author=" and ".join(names),
        year=str(entry["year"]),
    )


def _item(kind: str, key: str, **fields: str) -> str:
    lines = [f"  {name} = {{{value}}}," for name, value in fields.items()]
    return "\n".join([f"@{kind}{{{key},", *lines, "}"])

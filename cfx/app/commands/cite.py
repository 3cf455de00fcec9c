"""`cfx cite`: how to cite cfx, made from `CITATION.cff`."""

from __future__ import annotations

import argparse
from typing import Any

from cfx.core.command import Command


class CiteCommand(Command):
    """Prints how to cite cfx."""

    summary = "how to cite cfx, as BibTeX"

    def parser(self) -> argparse.ArgumentParser:
        return argparse.ArgumentParser("cfx cite", description="Prints how to cite cfx, as BibTeX.")

    def run(self, options: argparse.Namespace) -> int:
        import yaml

        from cfx.app.nodes import shipped

        entry = yaml.safe_load(shipped("CITATION.cff").read_text(encoding="utf-8"))
        groups = []  # the authors of the software are groups, which have no family names
        for author in entry["authors"]:
            groups.append(_in_braces(author["name"]))
        edition = {"version": entry["version"], "note": f"{entry['license']} licence"}
        print(_item("software", "cfx", entry["title"], groups, edition))
        for article in entry["references"]:  # the method that cfx began from
            authors = article["authors"]
            names = []
            for author in authors:
                names.append(f"{author['family-names']}, {author['given-names']}")
            key = f"{authors[0]['family-names'].lower()}{article['year']}"
            print(f"\n{_item('misc', key, article['title'], names, {'year': article['year']})}")
        return 0


def _item(kind: str, key: str, title: str, authors: list[str], more: dict[str, Any]) -> str:
    """Returns an entry of a bibliography in BibTeX; `more` holds its further fields."""
    fields = {"title": _in_braces(title), "author": " and ".join(authors), **more}
    lines = [f"@{kind}{{{key},"]
    for name, value in fields.items():
        lines.append(f"  {name} = {_in_braces(str(value))},")
    return "\n".join([*lines, "}"])


def _in_braces(text: str) -> str:
    """Returns a text that BibTeX leaves as it is: no other capitals, no part taken as a surname."""
    return "{" + text + "}"

"""What a report's page holds, as tests read it."""

from __future__ import annotations

from html.parser import HTMLParser

HOSTILE = "</script><img src=x onerror=alert(1)>&\"'"


class Page(HTMLParser):
    """Reads a page: its elements, its scripts, and the cells of its tables."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.words = ""
        self._inside = ""
        self._sort: str | None = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._inside = tag
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in {"td", "th"}:
            # A number is what it is sorted by, in full; a text is read from the page.
            self._sort = dict(attrs).get("data-sort")
            self.tables[-1][-1].append(self._sort or "")

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts.append(data)
        elif self._inside != "style":
            self.words += data
            if self._inside in {"td", "th", "span"} and self._sort is None:
                self.tables[-1][-1][-1] += data

    def having(self, attribute: str) -> list[str]:
        return [
            str(attributes[attribute]) for _, attributes in self.elements if attribute in attributes
        ]

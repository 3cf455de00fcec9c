"""Figures as SVG inside pages, and scripts that pages may run."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import re
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cfx.plugin import canvas, drawing

_MANY_POINTS = 400
"""A cloud of more points is a picture inside a page's SVG: each point would be an element."""

_MANY_LINES = 60
"""Likewise pale lines of one panel."""

PLACE = "\ue000"
"""Stands before each id of an inline SVG until the page says where the figure stands."""


def inline_svg(figure: Figure) -> str:
    """Returns a figure as an `svg` element for a page.

    Its words are text in the page's font, its clouds of points are pictures, and what `hover` says
    of its parts stands in `title` elements. `PLACE` stands before every id, so that a page can hold
    several figures.
    """
    hovers = _prepare(figure)
    stream = io.StringIO()
    with (
        canvas.figure_style(),
        mpl.rc_context({"svg.fonttype": "none", "path.simplify_threshold": 0.3}),
    ):
        # `savefig` would draw twice, once for the layout alone.
        paper = FigureCanvasSVG(figure)
        paper.print_svg(stream, metadata=drawing.FIGURE_METADATA["svg"])  # type: ignore[no-untyped-call]
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    for pattern in (
        r"<metadata>.*?</metadata>\s*",
        r"<style[^>]*>.*?</style>\s*",
        r"<!--.*?-->\s*",
    ):
        text = re.sub(pattern, "", text, flags=re.DOTALL)
    text = re.sub(r' d="[^"]*"', _shorter, text)
    used = set(re.findall(r"(?:href=\"|url\()#([^\")]+)", text))
    hovered = re.compile(r'<g id="hover-(\d+)">')
    text = hovered.sub(lambda match: f"<g><title>{hovers[int(match[1])]}</title>", text)
    text = re.sub(
        r' id="([^"]*)"',
        lambda match: f' id="{PLACE}{match[1]}"' if match[1] in used else "",
        text,
    )
    text = re.sub(r"(href=\"|url\()#", lambda match: f"{match[1]}#{PLACE}", text)
    # As wide as its paper, beside others that take the page's whole width.
    wide = f"max-width: {100 * figure.get_size_inches()[0] / canvas.WIDTH:.0f}%"
    head = rf'<svg \1 aria-hidden="true" style="{wide}">'
    return re.sub(r'<svg [^>]*(viewBox="[^"]*")[^>]*>', head, text, count=1)


def _prepare(figure: Figure) -> list[str]:
    """Turns clouds into pictures and marks what the mouse says something of; returns the texts."""
    hovers: list[str] = []
    for artist in figure.findobj(Artist):
        text = canvas.hover_text(artist)
        if text:
            artist.set_gid(f"hover-{len(hovers)}")
            hovers.append(html.escape(text))
        points = 0
        if isinstance(artist, PathCollection):
            points = np.shape(artist.get_offsets())[0]
        elif isinstance(artist, Line2D) and artist.get_linestyle() == "None":
            points = np.size(artist.get_xdata())
        if points > _MANY_POINTS:
            artist.set_rasterized(True)
    for axes in figure.axes:
        pale = [line for line in axes.lines if line.get_alpha() is not None]
        if len(pale) > _MANY_LINES:
            for line in pale:
                line.set_rasterized(True)
    return hovers


def _shorter(match: re.Match[str]) -> str:
    """Returns the path of an SVG with hundredths of a point."""
    return re.sub(r"(\.\d\d)\d+", r"\1", match[0])


def embedded_json(value: object) -> str:
    """Returns JSON that can stand inside a script element, whatever names it holds."""
    text = json.dumps(value, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def inline_scripts(sources: Sequence[str]) -> list[str]:
    """Returns scripts as they can stand inside script elements."""
    # An end tag inside a string of a script would end its element.
    return [source.replace("</script", "<\\/script") for source in sources]


def security_policy(scripts: Sequence[str]) -> str:
    """Returns the Content-Security-Policy: only these scripts run, and no network is asked."""
    allowed = []
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        allowed.append(f"'sha256-{digest}'")
    return (
        f"default-src 'none'; script-src {' '.join(allowed)}; style-src 'unsafe-inline';"
        " img-src data: blob:; base-uri 'none'; form-action 'none'"
    )

"""One look for all figures: fonts, paper, dashes, lines of methods, what the mouse shows."""

from __future__ import annotations

import functools
import textwrap
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Literal, ParamSpec
from weakref import WeakKeyDictionary

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from cfx.figures.colours import EDGE, INK, PALE, colour_of
from cfx.figures.wording import method_label, percent

__all__ = [
    "DASHES",
    "HIDDEN",
    "WIDTH",
    "Array",
    "Line",
    "Paper",
    "blank",
    "draw_lines",
    "draw_points",
    "figure_style",
    "finite",
    "hover",
    "hover_text",
    "legend_above",
    "logarithmic",
    "mark_points",
    "method_legend",
    "most_across",
    "on_paper",
    "percent_axis",
    "percent_tick",
    "plain_tick",
    "points",
    "side_by_side",
    "styled",
    "vehicle_colour",
    "wrapped",
]
"""What plugins may use, as `cfx.plugin.canvas`."""


Array = NDArray[np.float64]
"""Values that a figure shows, of any shape."""


def vehicle_colour(vehicle: int, vehicles: int) -> str:
    """Returns the colour of follower `vehicle` (1 and up) of `vehicles`, from dark to light."""
    return to_hex(mpl.colormaps["viridis"](0.9 * (vehicle - 1) / max(vehicles - 1, 1)))


def finite(values: Sequence[float] | Array) -> Array:
    """Returns the finite ones of some values."""
    array: Array = np.asarray(values, dtype=np.float64).ravel()
    return array[np.isfinite(array)]


P = ParamSpec("P")

DPI = 150
WIDTH = 10.5
"""Inches: at 150 dpi twice the width of a README column, with text that is still read there."""

_FONT = 10.5
"""Points: the size of the text of axes on the usual paper."""


@dataclass(frozen=True)
class Paper:
    """Paper that figures are drawn on: sizes of fonts, lines and margins follow.

    Attributes:
        width: inches.
        font_size: of the text of axes, points; other text is larger or smaller in proportion.
    """

    width: float = WIDTH
    font_size: float = _FONT

    @property
    def scale(self) -> float:
        """How large text and lines are, compared with the usual paper."""
        return self.font_size / _FONT

    @property
    def room(self) -> float:
        """How much text fits beside each other, compared with the usual paper."""
        return self.width / WIDTH / self.scale


_PAPER: ContextVar[Paper] = ContextVar("paper", default=Paper())  # noqa: B039 - it is frozen

Dash = Literal["solid"] | tuple[float, tuple[float, ...]]
"""A line as Matplotlib takes it: solid, or an offset and the lengths of dashes and spaces."""

DASHES: dict[str, Dash] = {
    "default": (0, (1.2, 1.4)),
    "pooled": (0, (6.0, 1.5, 1.2, 1.5)),
    "driver_specific": (0, (5.0, 1.8)),
    "shrunk": (0, (8.0, 1.5, 1.2, 1.5, 1.2, 1.5)),
    "constant_speed": (0, (1.2, 1.4)),
    "constant_acceleration": (0, (5.0, 1.8)),
    "pooled_residual": (0, (6.0, 1.5, 1.2, 1.5)),
    "driver_specific_residual": (0, (5.0, 1.8)),
    "pooled_ar": (0, (1.2, 1.4)),
    "driver_specific_ar": (0, (1.2, 1.4)),
    "policy_sampled": (0, (1.2, 1.4)),
}
"""Dashes of each method's line; the others are solid."""
_WIDTHS = {"real": 1.8, "leader": 1.0, "policy": 1.8}
_ORDER = ("leader", "default", "pooled", "driver_specific", "shrunk", "real", "policy")
"""The real driver lies on top of leader and baselines, and below the policy compared with it."""

HIDDEN = frozenset({"shrunk"})
"""Methods whose lines are left out: with one more nobody tells the lines apart."""

_HOVER: WeakKeyDictionary[Artist, str] = WeakKeyDictionary()
"""What the mouse shows over parts of figures."""

_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same figure on every machine
    "font.size": 10.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 10.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": EDGE,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "grid.color": PALE,
    "grid.linewidth": 0.8,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 9.5,
    "ytick.labelsize": 9.5,
    "xtick.major.size": 3.5,
    "xtick.major.width": 0.8,
    "xtick.major.pad": 3.5,
    "ytick.major.size": 3.5,
    "ytick.major.width": 0.8,
    "ytick.major.pad": 3.5,
    "legend.frameon": False,
    "legend.fontsize": 10.0,
    "legend.title_fontsize": 10.5,
    "figure.dpi": DPI,
    "savefig.dpi": DPI,
    "pdf.fonttype": 42,  # letters stay letters, as journals ask
    "svg.hashsalt": "cfx",  # the same figure has the same ids
    # A pair id may hold a dollar sign: it is text, never a formula.
    "text.parse_math": False,
}


@dataclass(frozen=True)
class Line:
    """A signal.

    Attributes:
        method: whose it is: a method, `real` or `leader`.
        time: `(T,)` s.
        values: `(T,)`, NaN where there is none, and for infinity, which no axis can show.
        steps: whether a value holds until the next frame.
    """

    method: str
    time: Array
    values: Array
    steps: bool = False

    def __post_init__(self) -> None:
        values = np.where(np.isfinite(self.values), self.values, np.nan)
        object.__setattr__(self, "values", values)

    @property
    def hidden(self) -> bool:
        """Whether it is left out."""
        return self.method in HIDDEN


@contextmanager
def on_paper(paper: Paper) -> Iterator[None]:
    """Draws the figures of the block on this paper."""
    before = _PAPER.set(paper)
    try:
        yield
    finally:
        _PAPER.reset(before)


def points(size: float) -> float:
    """Returns a size of text or lines in points: `size` on the usual paper."""
    return size * _PAPER.get().scale


def most_across(panels: int) -> int:
    """Returns how many panels stand beside each other where `panels` do on the usual paper."""
    return max(1, min(panels, round(panels * _PAPER.get().room)))


def wrapped(text: str) -> str:
    """Returns a text in lines that fit the width of the paper; on the usual one as it is."""
    room = _PAPER.get().room
    if room >= 1:
        return text
    return "\n".join(textwrap.wrap(text, max(20, round(120 * room))))


def side_by_side(figure: Figure, widths: Sequence[float], **more: Any) -> list[Axes]:
    """Returns panels of relative widths beside each other; `more` as of `Figure.subplots`.

    On narrow paper each is as wide as the figure, which becomes higher.
    """
    count = len(widths)
    if count == 1 or _PAPER.get().room >= 0.75:
        return list(figure.subplots(1, count, width_ratios=widths, squeeze=False, **more)[0])
    figure.set_figheight(count * figure.get_figheight())
    return list(figure.subplots(count, 1, squeeze=False, **more)[:, 0])


def _style() -> dict[str, Any]:
    """Returns Matplotlib's settings for the paper: its sizes are those of `_STYLE`, scaled."""
    style = dict(_STYLE)
    for key, value in _STYLE.items():
        if key.endswith(("size", "width", "pad")):  # in points
            style[key] = points(value)
    return style


@contextmanager
def figure_style() -> Iterator[None]:
    """Draws in this look, without warnings of names and values; the reader's settings come back."""
    with (
        mpl.rc_context(_style()),  # type: ignore[arg-type]  # the stubs want literal keys
        warnings.catch_warnings(),
    ):
        # A name in a script that the font lacks shows boxes; the names are in pairs.csv.
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        # Values of a damaged folder may all be one, or farther apart than floats can tell.
        warnings.filterwarnings("ignore", message="Attempting to set identical")
        yield


def hover(artist: Artist, text: str) -> None:
    """Says what the mouse shows over a part of a figure on a page; files of figures show none."""
    _HOVER[artist] = text


def hover_text(artist: Artist) -> str:
    """Returns what the mouse shows over a part of a figure, "" for nothing."""
    return _HOVER.get(artist, "")


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Makes a function draw its figure in the common look."""

    @functools.wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with figure_style():
            return _fitted(draw(*args, **kwargs))

    return drawn


_PAGE_IN = 250 / 25.4
"""Inches that a figure may be high on paper: A4 less its margins."""


def _fitted(figure: Figure) -> Figure:
    """Returns a figure whose titles end where it ends, and which fits a page of paper."""
    for axes in figure.axes:
        for child in axes.get_children():
            if isinstance(child, Text) and child not in axes.texts:  # its titles
                child.set_wrap(True)
        axes.xaxis.label.set_wrap(True)
    if _PAPER.get().room < 1:
        figure.set_figheight(min(figure.get_figheight(), _PAGE_IN))
    return figure


def blank(height: float, width: float = WIDTH) -> Figure:
    """Returns an empty figure that belongs to no pyplot state and no window.

    Height and width are inches on the usual paper; on another they follow the text.
    """
    paper = _PAPER.get()
    share = width / WIDTH / min(1.0, paper.room)
    size = (paper.width * min(1.0, share), height * paper.scale)
    return Figure(figsize=size, dpi=DPI, layout="constrained")


def draw_lines(axes: Axes, lines: Sequence[Line]) -> None:
    """Draws the lines of methods that are not hidden, in their colours and dashes."""
    for line in lines:
        if line.hidden:
            continue
        method = line.method
        above = _ORDER.index(method) if method in _ORDER else 0
        (drawn,) = axes.plot(
            line.time,
            line.values,
            color=colour_of(method),
            linestyle=DASHES.get(method, "solid"),
            linewidth=points(_WIDTHS.get(method, 1.6)),
            drawstyle="steps-post" if line.steps else "default",
            zorder=2.0 + 0.05 * above,
        )
        hover(drawn, method_label(method))
    axes.margins(x=0.01)


def draw_points(
    axes: Axes, x: ArrayLike, y: ArrayLike, marker: str, colour: str, size: float, **more: Any
) -> Line2D:
    """Draw points without a line between them; `more` as of `Line2D`."""
    style = {"marker": marker, "color": colour, "markersize": points(size), "linestyle": "none"}
    (drawn,) = axes.plot(x, y, **{**style, **more})
    return drawn


def mark_points(axes: Axes) -> None:
    """Puts a point where each value of the lines stands."""
    for line in axes.lines:
        line.set_marker("o")
        line.set_markersize(points(3.5))


def logarithmic(axes: Axes) -> None:
    """Makes the vertical axis logarithmic, with plain numbers at 1, 2 and 5."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(plain_tick))
    axes.yaxis.set_minor_formatter(NullFormatter())


def plain_tick(value: float, _position: int) -> str:
    """Return what stands beside a tick of plain numbers."""
    return f"{value:g}"


def method_handles(methods: Iterable[str]) -> list[Line2D]:
    """Returns legend entries."""
    handles = []
    for method in methods:
        handle = Line2D([], [], color=colour_of(method), linestyle=DASHES.get(method, "solid"))
        handle.set(linewidth=points(_WIDTHS.get(method, 1.6) + 0.4), label=method_label(method))
        handles.append(handle)
    return handles


def method_legend(figure: Figure, methods: Sequence[str], title: str | None = None) -> None:
    """Puts a legend of methods above a figure, in one row; many take two."""
    rows = -(-len(methods) // 5)
    columns = -(-len(methods) // rows)
    spacing = {"columnspacing": 1.4, "handlelength": 2.2, "title_fontsize": points(11)}
    legend_above(figure, method_handles(methods), columns, title=title, **spacing)


def legend_above(
    figure: Figure, handles: Sequence[Artist] | None = None, columns: int = 3, **more: Any
) -> None:
    """Puts a legend above a figure, in so many columns at most; `more` as of `Figure.legend`.

    Without `handles` its entries are what the figure's panels have labelled.
    """
    if handles is not None:
        columns = min(columns, max(len(handles), 1))
    columns = most_across(columns)
    if more.get("title"):
        more["title"] = wrapped(more["title"])
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, **more)


def percent_axis(axes: Axes) -> None:
    """Makes the vertical axis say signed percentages."""
    axes.yaxis.set_major_formatter(FuncFormatter(percent_tick))


def percent_tick(value: float, _position: int) -> str:
    """Returns what stands beside a tick of signed percentages."""
    return percent(value) if value else "0 %"


def write_note(axes: Axes, text: str) -> None:
    """Writes a sentence into an empty panel."""
    axes.text(0.5, 0.75, text, transform=axes.transAxes, ha="center", va="center", color=INK)

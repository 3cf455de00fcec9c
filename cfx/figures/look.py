"""One look for all figures: colours, fonts, canvas, labels.

Colours are Okabe and Ito's (2008), and Tol's purple, told apart by readers with any colour vision; each method also has its own
dash, so that a grey print can be read too. A method has one colour in every figure.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

P = ParamSpec("P")

DPI = 150
WIDTH = 10.5
"""Inches: at 150 dpi twice the width of a README column, with text that is still read there."""

COLOURS = {
    "real": "#000000",
    "leader": "#9a9a9a",
    "default": "#009e73",
    "population": "#aa4499",
    "fixed": "#0072b2",
    "shrunk": "#7a5c3e",
    "policy": "#d55e00",
}
DASHES: dict[str, Any] = {
    "real": "solid",
    "leader": "solid",
    "default": (0, (1.2, 1.4)),
    "population": (0, (6.0, 1.5, 1.2, 1.5)),
    "fixed": (0, (5.0, 1.8)),
    "shrunk": (0, (8.0, 1.5, 1.2, 1.5, 1.2, 1.5)),
    "policy": "solid",
}
WIDTHS = {
    "real": 1.8,
    "leader": 1.0,
    "default": 1.6,
    "population": 1.6,
    "fixed": 1.6,
    "shrunk": 1.6,
    "policy": 1.8,
}
LABELS = {
    "real": "real driver",
    "leader": "leader",
    "default": "default parameters",
    "population": "population's parameters",
    "fixed": "own fixed parameters",
    "shrunk": "own parameters, shrunk",
    "policy": "policy",
}
CLUSTER_COLOURS = ("#56b4e9", "#8c8c8c", "#e69f00")
"""Conservative, normal, aggressive: none of them a method's colour."""
TRAIN_COLOUR, VALIDATION_COLOUR = "#56b4e9", "#cc79a7"
INK, PALE, BAND = "#333333", "#e4e4e4", "#f3f3f3"

_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same figure on every machine
    "font.size": 10.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 10.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#808080",
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
    "legend.frameon": False,
    "legend.fontsize": 10.0,
    "figure.dpi": DPI,
    "savefig.dpi": DPI,
    # A pair id may hold a dollar sign: it is text, never a formula.
    "text.parse_math": False,
}


def look() -> Any:
    """Returns a context in which matplotlib draws in this look; the reader's own settings come back afterwards."""
    return mpl.rc_context(_STYLE)  # type: ignore[arg-type]  # the stubs want literal keys


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Makes a function draw its figure in the common look."""

    @functools.wraps(draw)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with look():
            return draw(*args, **kwargs)

    return wrapped


def canvas(height: float, width: float = WIDTH) -> Figure:
    """Returns an empty figure; sizes in inches. It belongs to no pyplot state and no window."""
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained")


def method_line(axes: Axes, method: str, time: Any, values: Any, *, steps: bool = False) -> None:
    """Draws a method's signal in its colour and dash; `steps` for what holds until the next frame."""
    # The real driver lies on top of leader and baselines, and below the policy that is compared with it.
    order = {
        "leader": 2.0,
        "default": 2.2,
        "population": 2.25,
        "fixed": 2.3,
        "shrunk": 2.35,
        "real": 2.4,
        "policy": 2.5,
    }[method]
    axes.plot(
        time,
        values,
        color=COLOURS[method],
        linestyle=DASHES[method],
        linewidth=WIDTHS[method],
        drawstyle="steps-post" if steps else "default",
        zorder=order,
    )


def method_handles(methods: Iterable[str]) -> list[Line2D]:
    """Returns legend entries."""
    return [
        Line2D(
            [],
            [],
            color=COLOURS[m],
            linestyle=DASHES[m],
            linewidth=WIDTHS[m] + 0.4,
            label=LABELS[m],
        )
        for m in methods
    ]


def short(name: str, limit: int = 26) -> str:
    """Returns a name that fits, its middle left out if it is longer than `limit` characters."""
    if len(name) <= limit:
        return name
    tail = (limit - 1) // 2
    return f"{name[: limit - 1 - tail]}…{name[-tail:]}"


def percent(fraction: float, digits: int = 0) -> str:
    """Returns a signed percentage with a real minus sign: 0.1234 -> "+12 %"."""
    return f"{100 * fraction:+.{digits}f} %".replace("-", "\N{MINUS SIGN}")


def number(value: float) -> str:
    """Returns up to three significant digits, with a real minus sign."""
    return f"{value:.3g}".replace("-", "\N{MINUS SIGN}")


def unit_label(name: str, unit: str) -> str:
    """Returns an axis label such as "t_r (s)"; a pure number (unit "1" or "") has no bracket."""
    return name if unit in {"", "1"} else f"{name} ({pretty_unit(unit)})"


def pretty_unit(unit: str) -> str:
    """Returns a unit with raised digits: "m/s2" -> "m/s²"."""
    for plain, raised in (("1e-4", "10⁻⁴"), ("m/s2", "m/s²"), ("m2/s2", "m²/s²")):
        unit = unit.replace(plain, raised)
    return unit

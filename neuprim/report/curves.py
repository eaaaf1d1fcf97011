"""The report's curves: small SVG charts that take their colours from the page, so that they follow its light and dark
mode."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neuprim.report.record import RunRecord, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import Locator

__all__ = [
    "GRID",
    "HELD_OUT",
    "INK",
    "TRAINING",
    "Series",
    "curve",
    "dots",
    "look",
    "series",
    "short_number",
    "svg",
    "together",
]

# Colours no chart uses otherwise: matplotlib draws with them, and the page's CSS variables take their place in the SVG.
INK, GRID, TRAINING, HELD_OUT = "#010203", "#010204", "#010205", "#010206"
VARIABLES = {INK: "var(--muted)", GRID: "var(--line)", TRAINING: "var(--training)", HELD_OUT: "var(--held-out)"}

WIDTH, HEIGHT = 360, 210
"""Size of a chart in points. Panels are about as wide in CSS pixels, so text keeps its size."""

WIDTH_TOGETHER, HEIGHT_TOGETHER = 540, 300
"""The same of a chart with the curves of several runs."""

BUCKETS = 120
"""A series of more points than twice this is drawn as medians of so many groups, inside a band from the least to the
greatest."""

UNITS = {"step": "steps", "frame": "frame"}

LOG_RATIO = 4.0
"""Positive values that span at least this factor get a logarithmic axis, where one is asked for."""

Series = tuple[NDArray[np.float64], NDArray[np.float64]]


def series(run: RunRecord, x: str, y: str) -> Series:
    """(x, y) of the log lines that have finite numbers for both."""
    pairs = [(number(line.get(x)), number(line.get(y))) for line in run.log]
    finite = [(a, b) for a, b in pairs if a is not None and b is not None and math.isfinite(a) and math.isfinite(b)]
    table = np.array(finite, dtype=np.float64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def curve(training: Series, held_out: Series | None, x: str, label: str, log: bool = False) -> str | None:
    """One chart over ``x`` ("seconds", "step" or "frame") as an ``<svg>`` element; None where there is nothing to draw.

    Args:
        training: drawn as a line, or as median and range where it has many points.
        held_out: drawn as a line, its points marked while they are few.
        label: the chart in words, for readers who do not see it.
        log: ask for a logarithmic y axis; see :data:`LOG_RATIO`.
    """
    drawn = [s for s in (training, held_out) if s is not None and s[0].size]
    if not drawn:
        return None
    unit, divisor = _time_unit(max(float(s[0].max()) for s in drawn)) if x == "seconds" else (UNITS[x], 1.0)
    with look():
        figure, axes = _axes()
        if training[0].size:
            _line(axes, training[0] / divisor, training[1])
        if held_out is not None and held_out[0].size:
            size = 4 if held_out[0].size <= 40 else 0
            axes.plot(
                held_out[0] / divisor, held_out[1], color=HELD_OUT, linewidth=1.6, marker="o", markersize=size, zorder=4
            )
        values = np.concatenate([s[1] for s in drawn])
        if log and values.min() > 0 and values.max() / values.min() >= LOG_RATIO:
            _log_axis(axes, float(values.min()), float(values.max()))
        axes.set_xlabel(unit)
        right = max(float(s[0].max()) for s in drawn) / divisor
        axes.set_xlim(0, right * 1.02 if right > 0 else 1)
        return svg(figure, label)


def together(lines: Sequence[tuple[Series, str]], x: str, label: str) -> str | None:
    """Curves of several runs in one chart over ``x`` ("seconds" or "step"), each with its own colour; None where there
    is nothing to draw."""
    drawn = [(one, colour) for one, colour in lines if one[0].size]
    if not drawn:
        return None
    right = max(float(one[0].max()) for one, _ in drawn)
    unit, divisor = _time_unit(right) if x == "seconds" else (UNITS[x], 1.0)
    with look():
        figure, axes = _axes(WIDTH_TOGETHER, HEIGHT_TOGETHER)
        for one, colour in drawn:
            size = 3 if one[0].size <= 40 else 0
            axes.plot(
                one[0] / divisor,
                one[1],
                color=colour,
                linewidth=1.4,
                marker="o",
                markersize=size,
                markeredgewidth=0,
                zorder=3,
            )
        axes.set_xlabel(unit)
        axes.set_xlim(0, right / divisor * 1.02 if right > 0 else 1)
        return svg(figure, label)


def dots(values: Sequence[float | None], mean: float | None, worst: str | None, label: str) -> str | None:
    """One value per view, in the split's order, hung from their mean (the dashed line); infinite and missing values are
    left out.

    Args:
        worst: text for the lowest dot, e.g. the view's name.
    """
    known = [(i, v) for i, v in enumerate(values) if v is not None and math.isfinite(v)]
    if not known:
        return None
    xs, ys = (np.array(column, dtype=np.float64) for column in zip(*known, strict=True))
    with look():
        figure, axes = _axes()
        if mean is not None and math.isfinite(mean):
            axes.axhline(mean, color=INK, linewidth=1, linestyle=(0, (4, 3)), zorder=2)
            axes.vlines(xs, mean, ys, color=HELD_OUT, linewidth=1, alpha=0.45, zorder=3)
        axes.plot(
            xs, ys, linestyle="none", marker="o", markersize=4.5 if len(known) <= 60 else 2.5, color=HELD_OUT, zorder=4
        )
        lowest = int(ys.argmin())
        side = "left" if lowest < len(ys) / 2 else "right"
        if worst and len(known) > 1:
            offset = (8 if side == "left" else -8, 0)
            axes.annotate(
                worst,
                (xs[lowest], ys[lowest]),
                offset,
                textcoords="offset points",
                ha=side,
                va="center",
                fontsize=9,
                color=INK,
                parse_math=False,
            )
        axes.set_xlabel("view")
        axes.set_xlim(-0.7, len(values) - 0.3)
        axes.xaxis.set_major_locator(_ticks(6, integer=True))
        axes.margins(y=0.14)
        return svg(figure, label)


def _line(axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    if x.size > 2 * BUCKETS:
        groups = np.array_split(np.arange(x.size), BUCKETS)
        middle, low, high = (np.array([f(y[g]) for g in groups]) for f in (np.median, np.min, np.max))
        x = np.array([x[g].mean() for g in groups])
        axes.fill_between(x, low, high, color=TRAINING, alpha=0.22, linewidth=0, zorder=2)
        y = middle
    axes.plot(x, y, color=TRAINING, linewidth=1.5, marker="o" if x.size == 1 else None, markersize=4, zorder=3)


def _log_axis(axes: Axes, low: float, high: float) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0,) if high / low > 300 else (1.0, 2.0, 5.0)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))


def short_number(value: float) -> str:
    """Tick labels without powers of ten: 12k, 0.002, 3M."""
    for size, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{suffix}"
    return f"{value:g}".replace("-", "−")


def _time_unit(seconds: float) -> tuple[str, float]:
    if seconds < 180:
        return "seconds", 1.0
    return ("minutes", 60.0) if seconds < 3 * 3600 else ("hours", 3600.0)


def look() -> AbstractContextManager[None]:
    """Settings of every chart, to hold from its axes' creation to its SVG."""
    import matplotlib  # slow to import, and only reports need it

    settings: Any = {
        "svg.fonttype": "none",
        "svg.hashsalt": "neuprim",
        "font.size": 10,
        "axes.edgecolor": GRID,
        "axes.labelcolor": INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.spines.left": False,
        "axes.grid": True,
        "axes.grid.axis": "y",
        "axes.axisbelow": True,
        "grid.color": GRID,
        "grid.linewidth": 0.8,
        "xtick.color": GRID,
        "ytick.color": GRID,
        "xtick.labelcolor": INK,
        "ytick.labelcolor": INK,
        "ytick.major.size": 0,
        "xtick.major.size": 3,
    }
    return matplotlib.rc_context(settings)


def _axes(width: float = WIDTH, height: float = HEIGHT) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    figure = Figure(figsize=(width / 72, height / 72))
    left, bottom = 41.4 / width, 42 / height  # room for the labels
    axes = figure.add_axes((left, bottom, 0.98 - left, 0.96 - bottom))
    for axis, most in ((axes.xaxis, 6), (axes.yaxis, 5)):
        axis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))
        axis.set_major_locator(_ticks(most))
    return figure, axes


def _ticks(most: int, integer: bool = False) -> Locator:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=most, steps=[1, 2, 2.5, 5, 10], integer=integer)


def svg(figure: Figure, label: str) -> str:
    """The chart as an element of the page: no outside addresses, no global styles, own ids, the page's font and
    colours."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True)
    body = buffer.getvalue()
    body = re.sub(
        r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>", "", body[body.index("<svg") :], flags=re.DOTALL
    )
    width, height = 72 * figure.get_size_inches()
    opening = f'<svg class="chart" role="img" aria-label="{html.escape(label, quote=True)}" viewBox="0 0 {width:g} {height:g}">'
    body = opening + body[body.index(">") + 1 :]
    body = re.sub(r'\bfont: ([\d.]+px) [^;"]*', r"font-size: \1", body)
    body = re.sub(r'\bfont-family: [^;"]*;? ?', "", body)
    prefix = re.sub(r"\W+", "-", label.lower()) + "-"
    body = re.sub(r'\bid="', f'id="{prefix}', body.replace("xlink:href", "href"))
    body = body.replace('href="#', f'href="#{prefix}').replace("url(#", f"url(#{prefix}")
    for color, variable in VARIABLES.items():
        body = body.replace(color, variable)
    return re.sub(r"\s*\n\s*", " ", body)

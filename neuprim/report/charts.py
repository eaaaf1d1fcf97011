"""Draw charts, curves and Pareto fronts, as SVG for a page or as a PNG file.

An SVG takes its colours from the page's CSS variables, so that it follows light and dark mode.
"""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuprim.core.io.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# Placeholders that no chart uses otherwise; they become CSS variables in a page, and colours in a PNG.
INK, GRID, TRAINING, HELD_OUT = "#010203", "#010204", "#010205", "#010206"
_VARIABLES = {INK: "var(--muted)", GRID: "var(--line)", TRAINING: "var(--training)", HELD_OUT: "var(--held-out)"}
_PNG_COLOURS = {INK: "#5d6670", GRID: "#e2e4e3", TRAINING: "#6884a6", HELD_OUT: "#c9551c"}

SMALL, LARGE = (360, 210), (540, 300)
"""Sizes (width, height) of charts in points. A page shows a chart at about as many CSS pixels, so that the text keeps
its size."""

_BUCKETS = 120
"""Number of groups into which the points of a long line are divided. Each group is drawn as its median and range. A
line is long if it has more than twice this number of points."""

_FEW = 40  # points of a line up to which each is marked

_LOG_RATIO, _FRONT_LOG_RATIO = 4.0, 1.5
"""Ratios of the largest to the smallest value from which an axis is logarithmic. The first ratio is for the y axis of
curves with positive values, the second for the x axis of charts of quality against cost."""

_LEAST_DECIBELS = 0.4  # least range of the y axis of a front: smaller differences are invisible


@dataclass(frozen=True)
class ChartPoints:
    """Points of one colour in a chart; points that are not finite are not drawn.

    Attributes:
        joined: connect the points by a line; markers are only drawn if there are few points.
        band: divide many points into groups; draw a line of the groups' medians, and a band from their minima to
            their maxima.
        spread: half-lengths of horizontal error bars; no bars if empty.
        labels: texts below the points.
        name: text in the chart's legend.
    """

    x: Sequence[float] | NDArray[np.float64]
    y: Sequence[float] | NDArray[np.float64]
    colour: str = TRAINING
    joined: bool = True
    band: bool = False
    spread: Sequence[float] = ()
    labels: Sequence[str] = ()
    name: str = ""

    def finite(self) -> ChartPoints:
        """Return only the points with finite coordinates."""
        x, y = np.asarray(self.x, dtype=np.float64), np.asarray(self.y, dtype=np.float64)
        rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y)).tolist()
        spread = [self.spread[i] for i in rows] if self.spread else ()
        labels = [self.labels[i] for i in rows] if self.labels else ()
        return replace(self, x=x[rows], y=y[rows], spread=spread, labels=labels)


@dataclass(frozen=True)
class Chart:
    """A chart of any kind; :func:`curve_chart` and :func:`front_chart` make the usual ones.

    Attributes:
        title: text for screen readers, and the heading above a PNG.
        ring: (x, y) of a point that is highlighted by a ring.
        log_x, log_y: whether the axis is logarithmic.
        least: smallest range of the y axis. The axis is extended if the values have a smaller range.
    """

    title: str
    points: Sequence[ChartPoints]
    x_label: str
    y_label: str = ""
    size: tuple[int, int] = SMALL
    ring: tuple[float, float] | None = None
    log_x: bool = False
    log_y: bool = False
    least: float = 0.0

    def known(self) -> list[ChartPoints]:
        """Return the point sets that have at least one finite point, reduced to their finite points."""
        return [finite for points in self.points if len((finite := points.finite()).x)]


class Dot(NamedTuple):
    """A point in a chart of quality against cost.

    Attributes:
        cost, spread: cost, drawn along x, and the half-length of its error bar.
        good: quality, drawn along y.
        mark: text beside a point on the Pareto front; None for a point that is not on the front.
        reference: whether other points are compared with this point. A ring highlights this point.
    """

    cost: float
    good: float
    spread: float = 0.0
    mark: str | None = None
    reference: bool = False


def curve_chart(
    title: str, unit: str, lines: Sequence[ChartPoints], log: bool = False, size: tuple[int, int] = SMALL
) -> Chart:
    """Return a chart of values over seconds, steps, views or frames.

    Args:
        unit: label of the x axis. "seconds" becomes minutes or hours for long times.
        log: use a logarithmic y axis if all values are positive and the largest is at least four times the smallest.
    """
    known = [line.finite() for line in lines]
    longest, divisor = float(max((np.max(line.x) for line in known if len(line.x)), default=0.0)), 1.0
    if unit == "seconds" and longest >= 180:
        unit, divisor = ("minutes", 60.0) if longest < 3 * 3600 else ("hours", 3600.0)
    values = np.concatenate([line.y for line in known]) if known else np.zeros(0)
    log = log and values.size > 0 and bool(values.min() > 0 and values.max() / values.min() >= _LOG_RATIO)
    return Chart(title, [replace(line, x=np.asarray(line.x) / divisor) for line in known], unit, size=size, log_y=log)


def front_chart(
    title: str, x_label: str, y_label: str, dots: Sequence[Dot], joined: bool = True, most: float = math.inf
) -> Chart:
    """Return a chart of quality against cost with the Pareto front marked.

    Args:
        joined: connect the points of the front by a line.
        most: largest cost shown. Points with a higher cost are left out, unless they are on the front. The label of
            the x axis says how many are left out.
    """
    known = [dot for dot in dots if math.isfinite(dot.cost) and math.isfinite(dot.good) and dot.cost > 0]
    drawn = [dot for dot in known if dot.cost <= most or dot.mark is not None]
    if len(drawn) < len(known):
        x_label += f" ({len(known) - len(drawn)} beyond {most:g})"
    marked = sorted((dot for dot in drawn if dot.mark is not None), key=lambda dot: dot.cost)
    others = [dot for dot in drawn if dot.mark is None]

    def points(dots: Sequence[Dot], colour: str, joined: bool) -> ChartPoints:
        x, y, spread = [dot.cost for dot in dots], [dot.good for dot in dots], [dot.spread for dot in dots]
        return ChartPoints(x, y, colour, joined, spread=spread, labels=[dot.mark or "" for dot in dots])

    costs = [dot.cost for dot in drawn]
    log = bool(costs) and max(costs) / min(costs) >= _FRONT_LOG_RATIO
    ring = next(((dot.cost, dot.good) for dot in drawn if dot.reference), None)
    both = [points(others, TRAINING, False), points(marked, HELD_OUT, joined)]
    return Chart(title, both, x_label, y_label, LARGE, ring=ring, log_x=log, least=_LEAST_DECIBELS)


def draw_svg(chart: Chart) -> str | None:
    """Return the chart as an ``<svg>`` element in the page's colours; None if there is nothing to draw."""
    from matplotlib.figure import Figure

    if not chart.known():
        return None
    width, height = chart.size
    with _style():
        figure = Figure(figsize=(width / 72, height / 72))
        left, bottom = 41.4 / width, 42 / height  # room for the labels
        axes = figure.add_axes((left, bottom, 0.98 - left, 0.96 - bottom))
        _draw_chart(axes, chart, {name: name for name in _VARIABLES})
        return _chart_to_svg_element(figure, chart.title)


def write_png_charts(path: Path, charts: Sequence[Chart], rows: int = 1) -> None:
    """Write charts side by side into a PNG file, in ``rows`` rows."""
    from matplotlib.figure import Figure

    charts = [chart for chart in charts if chart.known()]
    columns, (width, height) = -(-len(charts) // rows), LARGE
    with _style():
        size = (columns * width / 72, rows * 1.12 * height / 72)
        figure = Figure(figsize=size, layout="constrained", facecolor="white")
        for axes, chart in zip(figure.subplots(rows, columns, squeeze=False).flat, charts, strict=False):
            _draw_chart(axes, chart, _PNG_COLOURS)
            axes.set_title(chart.title, fontsize=11, loc="left", color=_PNG_COLOURS[INK])
            axes.set_ylabel(chart.y_label, color=_PNG_COLOURS[INK])
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png", dpi=130)


# ---------------------------------------------------------------- drawing


def _draw_chart(axes: Axes, chart: Chart, palette: Mapping[str, str]) -> None:
    known, ink, grid = chart.known(), palette[INK], palette[GRID]
    for points in known:
        _draw_chart_points(axes, points, palette.get(points.colour, points.colour), ink)
    if any(points.name for points in known):
        axes.legend(frameon=False, labelcolor=ink)
    if chart.ring is not None:
        axes.plot(*chart.ring, marker="o", markersize=11, markerfacecolor="none", markeredgecolor=ink, zorder=4)
    axes.set_xlabel(chart.x_label, color=ink)
    axes.margins(x=0.05, y=0.13 if chart.least else 0.05)
    axes.set_xscale("log" if chart.log_x else "linear")
    axes.set_yscale("log" if chart.log_y else "linear")
    _set_ticks(axes.xaxis, chart.log_x, np.concatenate([np.asarray(points.x) for points in known]))
    _set_ticks(axes.yaxis, chart.log_y, np.concatenate([np.asarray(points.y) for points in known]))
    bottom, top = axes.get_ylim()
    if top - bottom < chart.least:
        axes.set_ylim((bottom + top - chart.least) / 2, (bottom + top + chart.least) / 2)
    axes.tick_params(colors=grid, labelcolor=ink)
    axes.grid(True, axis="both" if chart.least else "y", color=grid)
    for spine in axes.spines.values():
        spine.set_color(grid)


def _draw_chart_points(axes: Axes, points: ChartPoints, colour: str, ink: str) -> None:
    x, y = np.asarray(points.x), np.asarray(points.y)
    marked = not points.joined or x.size == 1 or (x.size <= _FEW and not points.band)
    if points.band and x.size > 2 * _BUCKETS:
        groups = np.array_split(np.arange(x.size), _BUCKETS)
        middle, low, high = (np.array([f(y[group]) for group in groups]) for f in (np.median, np.min, np.max))
        x, y = np.array([x[group].mean() for group in groups]), middle
        axes.fill_between(x, low, high, color=colour, alpha=0.22, linewidth=0, zorder=2)
    if points.joined:
        axes.plot(x, y, color=colour, linewidth=1.5, label=points.name or None, zorder=3)
    if marked:
        errors = points.spread if any(points.spread) else None
        look: Any = {"color": colour, "linestyle": "none", "marker": "o", "markersize": 4.5, "markeredgewidth": 0}
        axes.errorbar(x, y, xerr=errors, zorder=4, **look)
    for at, text in zip(zip(x, y, strict=True), points.labels, strict=False):
        style: Any = {"ha": "center", "color": ink, "fontsize": 9, "parse_math": False}
        axes.annotate(text, at, (0, -13), textcoords="offset points", **style)


def _set_ticks(axis: Axis, log: bool, values: NDArray[np.float64]) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    if log:
        ratio = float(values.max() / values.min())
        few, many = (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
        axis.set_major_locator(LogLocator(subs=(1.0,) if ratio > 300 else few if ratio > _LOG_RATIO else many))
        axis.set_minor_locator(NullLocator())
    else:
        axis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: _format_tick(value)))


def _format_tick(value: float) -> str:
    """Format a number without powers of ten, e.g. 12k, 0.002, 3M."""
    for size, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{suffix}"
    return f"{value:g}".replace("-", "−")


def _style() -> AbstractContextManager[None]:
    """Return a context manager that applies the matplotlib settings of all charts.

    Create the axes and write the file inside this context.
    """
    import matplotlib  # slow to import, and only reports need it

    settings: Any = {"svg.fonttype": "none", "svg.hashsalt": "neuprim", "font.size": 10}
    settings |= {f"axes.spines.{side}": False for side in ("top", "right", "left")}
    settings |= {"axes.axisbelow": True, "grid.linewidth": 0.8, "ytick.major.size": 0, "xtick.major.size": 3}
    return matplotlib.rc_context(settings)


def _chart_to_svg_element(figure: Figure, label: str) -> str:
    """Return a matplotlib figure as an ``<svg>`` element for a page. ``label`` is the text for screen readers.

    The element has the page's font, no outside addresses, no global styles, and ids that are unique for each label.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True)
    body = buffer.getvalue()
    body = body[body.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>", "", body, flags=re.DOTALL)
    width, height = 72 * figure.get_size_inches()
    name, box = html.escape(label, quote=True), f"0 0 {width:g} {height:g}"
    body = f'<svg class="chart" role="img" aria-label="{name}" viewBox="{box}">' + body[body.index(">") + 1 :]
    body = re.sub(r'\bfont: ([\d.]+px) [^;"]*', r"font-size: \1", body)
    body = re.sub(r'\bfont-family: [^;"]*;? ?', "", body)
    prefix = re.sub(r"\W+", "-", label.lower()) + "-"
    body = re.sub(r'\bid="', f'id="{prefix}', body.replace("xlink:href", "href"))
    body = body.replace('href="#', f'href="#{prefix}').replace("url(#", f"url(#{prefix}")
    for colour, variable in _VARIABLES.items():
        body = body.replace(colour, variable)
    return re.sub(r"\s*\n\s*", " ", body)

"""Charts of what a point costs against how good it is, with the front marked: for a page, and as a picture of their
own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.core.io.files import atomic_path
from neuprim.report.curves import GRID, HELD_OUT, INK, TRAINING, look, short_number, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Chart", "Dot", "chart_svg", "write_charts"]

WIDTH, HEIGHT = 540, 300
"""Of a chart, points."""

COLOURS = {INK: "#5d6670", GRID: "#e2e4e3", TRAINING: "#6884a6", HELD_OUT: "#c9551c"}
"""What stands for the page's colours in a picture of its own."""

LEAST = 0.4
"""Decibels that a chart spans at least: smaller differences are none that one sees."""

LINEAR_BELOW = 1.5
"""Costs whose greatest is less than this many times the least have a linear axis."""


@dataclass(frozen=True)
class Dot:
    """A point.

    Attributes:
        cost, spread: along x. good: along y.
        mark: what stands beside a point of the front; None for the others.
        reference: whether all costs are compared with this one.
    """

    cost: float
    good: float
    spread: float = 0.0
    mark: str | None = None
    reference: bool = False


@dataclass(frozen=True)
class Chart:
    """Points with a title and what their axes mean. ``joined`` draws a line through those of the front; what costs more
    than ``most`` and is not on it is off the chart."""

    title: str
    x: str
    y: str
    dots: Sequence[Dot]
    joined: bool = True
    most: float = math.inf

    @property
    def known(self) -> list[Dot]:
        return [dot for dot in self.dots if math.isfinite(dot.cost) and math.isfinite(dot.good) and dot.cost > 0]

    @property
    def drawn(self) -> list[Dot]:
        return [dot for dot in self.known if dot.cost <= self.most or dot.mark is not None]

    @property
    def axis(self) -> str:
        """What x means, and how many points are off the chart."""
        off = len(self.known) - len(self.drawn)
        return self.x + (f" ({off} beyond {self.most:g})" if off else "")


def chart_svg(chart: Chart) -> str | None:
    """An ``<svg>`` element in the page's colours; None where there is nothing to draw."""
    from matplotlib.figure import Figure

    if not chart.drawn:
        return None
    with look():
        figure = Figure(figsize=(WIDTH / 72, HEIGHT / 72))
        _draw(figure.add_axes((0.1, 0.16, 0.88, 0.8)), chart, {colour: colour for colour in COLOURS})
        return svg(figure, chart.title)


def write_charts(path: Path, charts: Sequence[Chart]) -> None:
    """A PNG of charts side by side."""
    from matplotlib.figure import Figure

    charts = [chart for chart in charts if chart.drawn]
    with look():
        figure = Figure(figsize=(len(charts) * WIDTH / 72, 1.12 * HEIGHT / 72), layout="constrained", facecolor="white")
        axes = figure.subplots(1, len(charts), squeeze=False)[0]
        for axis, chart in zip(axes, charts, strict=True):
            _draw(axis, chart, COLOURS)
            axis.set_title(chart.title, fontsize=11, loc="left", color=COLOURS[INK])
            axis.set_ylabel(chart.y)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png", dpi=130)


def _draw(axes: Axes, chart: Chart, colours: dict[str, str]) -> None:
    dots = chart.drawn
    low, high = min(d.cost for d in dots), max(d.cost for d in dots)
    if high / low >= LINEAR_BELOW:
        _log_axis(axes, low, high)
    marked = [d for d in dots if d.mark is not None]
    others = [d for d in dots if d.mark is None]
    kind: dict[str, Any] = {"linestyle": "none", "capsize": 0, "elinewidth": 1, "zorder": 3}
    for group, colour, size, alpha in ((others, TRAINING, 4.5, 0.75), (marked, HELD_OUT, 6.0, 1.0)):
        if group:
            x, y, e = ([getattr(d, name) for d in group] for name in ("cost", "good", "spread"))
            axes.errorbar(
                x, y, xerr=e, marker="o", markersize=size, color=colours[colour], alpha=alpha, markeredgewidth=0, **kind
            )
    if chart.joined and len(marked) > 1:
        line = sorted(marked, key=lambda d: d.cost)
        axes.plot(
            [d.cost for d in line], [d.good for d in line], color=colours[HELD_OUT], linewidth=1.2, alpha=0.6, zorder=2
        )
    for dot in (d for d in dots if d.reference):
        axes.plot(
            [dot.cost],
            [dot.good],
            marker="o",
            markersize=11,
            markerfacecolor="none",
            markeredgecolor=colours[INK],
            zorder=4,
        )
    for dot in marked:
        axes.annotate(
            dot.mark or "",
            (dot.cost, dot.good),
            (0, -13),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            color=colours[INK],
        )
    axes.set_xlabel(chart.axis, color=colours[INK])
    axes.yaxis.label.set_color(colours[INK])
    axes.margins(x=0.05, y=0.12)
    axes.ticklabel_format(axis="y", useOffset=False)
    bottom, top = axes.get_ylim()
    if top - bottom < LEAST:
        axes.set_ylim((bottom + top - LEAST) / 2, (bottom + top + LEAST) / 2)
    axes.tick_params(colors=colours[GRID], labelcolor=colours[INK])
    axes.grid(True, color=colours[GRID])
    for spine in axes.spines.values():
        spine.set_color(colours[GRID])


def _log_axis(axes: Axes, low: float, high: float) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axes.set_xscale("log")
    subs = (
        (1.0,)
        if high / low > 300
        else (1.0, 2.0, 5.0)
        if high / low > 8
        else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    )
    axes.xaxis.set_major_locator(LogLocator(subs=subs))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_number(value)))

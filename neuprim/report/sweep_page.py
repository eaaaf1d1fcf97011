"""The page of a sweep: its runs in one table, their curves in one chart, and the same held-out views side by side."""

from __future__ import annotations

import hashlib
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from neuprim.core.io.files import write_text
from neuprim.core.metrics import metric_from_json
from neuprim.report import report_page as page
from neuprim.report.charts import LARGE, ChartPoints, curve_chart
from neuprim.report.report_page import (
    escape,
    format_decimal,
    format_report_bytes,
    format_report_count,
    format_report_duration,
    report_note,
    section,
)
from neuprim.report.run_record import ReportedRun

_LESS, _MORE = "less", "more"
_BETTER = {
    **dict.fromkeys(("psnr", "ssim", "render_fps", "sigma_correlation", "sigma_psnr"), _MORE),
    **dict.fromkeys(("lpips", "flip", "model_bytes", "primitives", "parameters", "train_seconds"), _LESS),
    **dict.fromkeys(("sigma_relative", "sigma_max_error"), _LESS),
}
"""Beginning of a metric's name -> whether more of it is better, or less. Of any other the page does not say."""

_FIRST = (
    *("psnr", "ssim", "psnr_worst", "psnr_mask", "lpips"),
    *("primitives", "model_bytes", "train_seconds", "render_fps", "iterations"),
)
"""Metrics in the order of the table; the others follow."""

_TITLES = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "model_bytes": "model file", "train_seconds": "training"}

_BEST = {"psnr": "Best PSNR", "ssim": "Best SSIM", "model_bytes": "Smallest model", "train_seconds": "Fastest training"}

_NOT_COMPARED = ("psnr_black_image", "seed", "vdb_bytes")
"""Beginning of names of numbers that say something of the data or the request."""

COLOURS = ("#4878a8", "#d9782d", "#4f9a56", "#c44e52", "#8a6fb3", "#8c6d52", "#cf79b0", "#7f7f7f", "#a3a23a", "#3fa6b5")
"""Of the first runs, on light and dark pages; of more runs than these a colour map's."""

_MOST_PICTURES, _MOST_VIEWS = 8, 3  # runs whose pictures are shown, and held-out views of each


@dataclass(frozen=True)
class SweepPageRun:
    """One run of a sweep.

    Attributes:
        name: of its folder in the sweep's.
        swept: key -> value, as typed, of the words that differ between runs.
        state, line: how it ended, and why it failed.
        seconds, attempts: from its start to its end; how often it was started.
        run: what its directory holds; None where there is nothing yet.
    """

    name: str
    swept: Mapping[str, str]
    state: str
    line: str
    seconds: float
    attempts: int
    run: ReportedRun | None

    @property
    def numbers(self) -> dict[str, float]:
        """Metric -> value of the single numbers of ``metrics.json``; none of a run that has not finished."""
        metrics = {} if self.run is None else self.run.metrics or {}
        found = {name: metric_from_json(metrics, name) for name in metrics if not name.endswith("_infinite")}
        return {name: value for name, value in found.items() if value is not None}


def better_table_direction(name: str) -> str | None:
    """Return whether "more" or "less" of a metric is better; None where that is not known."""
    known = [start for start in _BETTER if name == start or name.startswith(f"{start}_")]
    return _BETTER[max(known, key=len)] if known and name != "parameters_per_primitive" else None


def write_sweep_page(folder: Path, runs: Sequence[SweepPageRun], words: Sequence[str]) -> Path:
    """Write ``sweep.html`` into a sweep's directory, finished or not, and return its path.

    The page needs nothing else; without scripts it stands in the order of the mean PSNR.

    Args:
        words: what the sweep was asked for, after ``neuprim run -m``.
    """
    drawn = _SweepPage(folder, runs, words)
    script = files("neuprim.report").joinpath("sweep.js").read_text(encoding="utf-8")
    sections = [
        drawn.heading(),
        drawn.banner(),
        drawn.headline(),
        drawn.table(),
        drawn.charts(),
        drawn.pictures(),
        drawn.facts(),
    ]
    nonce = hashlib.sha256("".join([script, *sections]).encode()).hexdigest()[:32]  # no text inside can know it
    target, policy = folder / "sweep.html", f"; script-src 'nonce-{nonce}'"
    element = f'<script nonce="{nonce}">\n{script}\n</script>'
    title = f"{folder.resolve().name} – sweep"
    write_text(target, page.render_page(title, sections, "compared", policy, element))
    return target


class _SweepPage:
    def __init__(self, folder: Path, runs: Sequence[SweepPageRun], words: Sequence[str]) -> None:
        self.folder, self.words = folder, words
        self.numbers = {run.name: run.numbers for run in runs}
        self.runs = sorted(runs, key=lambda run: -self.numbers[run.name].get("psnr", -math.inf))
        self.colours = dict(zip((run.name for run in runs), _run_colours(len(runs)), strict=True))
        names = dict.fromkeys(name for run in self.runs for name in self.numbers[run.name])
        kept = [name for name in names if not name.startswith(_NOT_COMPARED)]
        differ = {name for name in kept if len({self.numbers[run.name].get(name) for run in self.runs}) > 1}
        first = [name for name in _FIRST if name in kept]
        self.metrics = [*first, *(name for name in kept if name not in first and name in differ)]
        self.best = {name: self._best(name) for name in {*self.metrics, *_BEST}}

    def _best(self, name: str) -> SweepPageRun | None:
        sign = {_MORE: 1.0, _LESS: -1.0, None: 0.0}[better_table_direction(name)]
        having = [run for run in self.runs if name in self.numbers[run.name] and sign]
        return max(having, key=lambda run: sign * self.numbers[run.name][name], default=None)

    def heading(self) -> str:
        command = shlex.join(["neuprim", "run", "-m", *self.words])
        return page.masthead("sweep", self.folder.resolve().name, "\n" + report_note(f"<code>{escape(command)}</code>"))

    def banner(self) -> str:
        lines = []
        for run in self.runs:
            if run.state == "failed":
                lines.append(f"<strong>{escape(run.name)} failed:</strong> {escape(run.line)}")
            elif run.state != "done":
                lines.append(f"<strong>{escape(run.name)}</strong> has not finished.")
        return page.report_banner(lines)

    def headline(self) -> str:
        done = sum(run.state == "done" for run in self.runs)
        tiles = [("Runs", format_report_count(len(self.runs)), "", f"{format_report_count(done)} done")]
        for name, title in _BEST.items():
            best = self.best[name]
            if best is not None:
                tiles.append((title, *_format_metric(name, self.numbers[best.name][name]), escape(best.name)))
        rule = "Metrics of the last checkpoints, on the held-out views of each run."
        return page.report_tiles(tiles, lead=range(1, len(tiles))) + f'<p class="rule">{rule}</p>'

    def table(self) -> str:
        keys = list(dict.fromkeys(key for run in self.runs for key in run.swept))
        heads = [escape(title) for title in ("run", *keys, "state")]
        options = ""
        for name in self.metrics:
            title, known = escape(_TITLES.get(name, name.replace("_", " "))), better_table_direction(name)
            heads.append(f'<th data-metric="{escape(name)}" data-better="{known or ""}">{title}</th>')
            options += "" if known is None else f'<option value="{escape(name)}">{title}</option>'
        rows = [self._row(run, keys) for run in self.runs]
        table = page.number_table([*heads, "seconds in all"], rows, "numbers runs")
        choice = ""
        if options:
            label = '<label for="metric">Best by</label>'
            choice = f'<p class="choose" hidden>{label}<select id="metric">{options}</select><b id="best"></b></p>'
        text = "Orange: the best of a column. A name leads to the run’s own report."
        return section("All runs", choice + table + report_note(text))

    def _row(self, run: SweepPageRun, keys: Sequence[str]) -> str:
        name = escape(run.name)
        if run.run is not None and (run.run.run_dir / "report.html").is_file():
            name = f'<a href="{escape(quote(run.name))}/report.html">{name}</a>'
        cells = [escape(run.swept.get(key)) for key in keys]
        bad = "" if run.state == "done" else ' class="bad"'
        cells.append(f"<td{bad}>{escape(run.state)}</td>")
        for metric in self.metrics:
            value, best = self.numbers[run.name].get(metric), self.best[metric]
            first = best is not None and value == self.numbers[best.name][metric] and len(self.runs) > 1
            data = "" if value is None else repr(value).replace("inf", "Infinity")
            text = " ".join(filter(None, _format_metric(metric, value)))
            kind = ' class="best"' if first else ""
            cells.append(f'<td{kind} data-value="{data}">{text}</td>')
        cells.append(f'<td data-value="{run.seconds:.3f}">{format_decimal(run.seconds, 1)}</td>')
        return page.table_row(self._chip(run) + name, cells, f' data-run="{escape(run.name)}"')

    def _chip(self, run: SweepPageRun) -> str:
        return f'<span class="chip" style="background: {self.colours[run.name]}"></span>'

    def charts(self) -> str:
        known = [(run, run.run) for run in self.runs if run.run is not None]
        charts = []
        for x, unit, title in (("seconds", "seconds", "training time"), ("step", "steps", "steps")):
            lines = [ChartPoints(*record.series(x, "eval_psnr"), self.colours[run.name]) for run, record in known]
            title = f"Held-out PSNR over {title}, dB"
            charts.append((title, curve_chart(title, unit, lines, size=LARGE)))
        panels = page.chart_panels(charts, "charts")
        keys = "".join(f"<li>{self._chip(run)}{escape(run.name)}</li>" for run, _ in known)
        return section("Curves", f'{panels}<ul class="keys">{keys}</ul>') if panels else ""

    def pictures(self) -> str:
        """Return the same views of the best runs; runs of different data have views of their own."""
        groups: dict[tuple[str | None, str | None], list[tuple[SweepPageRun, ReportedRun]]] = {}
        for run in self.runs:
            if run.run is not None and run.run.views:
                groups.setdefault((run.run.name_of("task"), run.run.name_of("scene")), []).append((run, run.run))
        body = ""
        for (task, scene), members in groups.items():
            body += f"<h3>{escape(task)} / {escape(scene)}</h3>" if len(groups) > 1 else ""
            body += _views_side_by_side(members)
        return section("Held-out views side by side", body) if body else ""

    def facts(self) -> str:
        pairs = [("directory", str(self.folder)), ("all numbers", "sweep.csv"), ("what was asked", "sweep.json")]
        tried = [run for run in self.runs if run.attempts > 1]
        pairs += [(run.name, f"started {run.attempts} times, as its worker died") for run in tried]
        pairs += [("time of all runs together", format_report_duration(sum(run.seconds for run in self.runs)))]
        return section("Where the numbers come from", page.fact_list(pairs))


def _views_side_by_side(members: Sequence[tuple[SweepPageRun, ReportedRun]]) -> str:
    """Return a few views, evenly spread, of the first runs, which are the best."""
    shown, views = members[:_MOST_PICTURES], members[0][1].views
    few = min(len(views), _MOST_VIEWS)
    html = ""
    if len(shown) < len(members):
        html += report_note(f"{len(shown)} of {len(members)} runs, those with the best PSNR.")
    for view in (views[i] for i in sorted({round(k * (len(views) - 1) / max(few - 1, 1)) for k in range(few)})):
        name = escape(view.stem or view.index)
        figures = "" if view.truth is None else page.figure(view.truth, "ground truth", f"view {name}, ground truth")
        for run, record in shown:
            same = next((own for own in record.views if (own.index, own.stem) == (view.index, view.stem)), None)
            if same is not None:
                psnr, of = format_decimal(metric_from_json(record.view_numbers(same), "psnr"), 2), escape(run.name)
                caption, attribute = f"{of} <b>{psnr}</b> dB", f' data-run="{of}"'
                figures += page.figure(same.render, caption, f"view {name}, {of}", attribute)
        html += f'<h3>{name}</h3><div class="pictures">{figures}</div>'
    return html


def _format_metric(name: str, value: float | None) -> tuple[str, str]:
    """Return (number, unit) of a metric's value."""
    if value is None:
        return page.MISSING, ""
    if name.endswith("bytes"):
        return format_report_bytes(value)
    if name.endswith("seconds"):
        return format_decimal(value, 1), "s"
    if "psnr" in name:
        return format_decimal(value, 2), "dB"
    if name.startswith(("primitives", "parameters", "iterations", "train_views")):
        return format_report_count(value), ""
    return format_decimal(value, 1 if name.endswith("fps") else 4), ""


def _run_colours(number: int) -> Iterable[str]:
    if number <= len(COLOURS):
        return COLOURS[:number]
    from matplotlib import colormaps  # slow to import, and only reports need it
    from matplotlib.colors import to_hex

    return [to_hex(colormaps["turbo"](0.06 + 0.88 * i / (number - 1))) for i in range(number)]

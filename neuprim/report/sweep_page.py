"""Write the page of a sweep: one table and one chart of all runs, and the same held-out views of runs side by side."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from neuprim.core.io.files import write_text
from neuprim.core.metrics import metric_from_json
from neuprim.report import report_page as page
from neuprim.report.charts import LARGE, ChartPoints, curve_chart
from neuprim.report.report_page import escape, format_decimal, format_report_count, report_note, section
from neuprim.report.run_record import ReportedRun

_MORE = ("psnr", "ssim", "render_fps", "sigma_correlation", "sigma_psnr")
_LESS = (
    *("lpips", "flip", "model_bytes", "primitives", "parameters", "train_seconds"),
    *("sigma_relative", "sigma_max_error"),
)
"""Beginnings of metric names. ``_MORE``: a higher value is better. ``_LESS``: a lower value is better. Other metrics
are not ranked."""

_FIRST = (
    *("psnr", "ssim", "psnr_worst", "psnr_mask", "lpips"),
    *("primitives", "model_bytes", "train_seconds", "render_fps", "iterations"),
)
"""Metrics of the table's first columns, in order. Other metrics that differ between runs follow."""

_TITLES = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "model_bytes": "model file", "train_seconds": "training"}

_NOT_COMPARED = ("psnr_black_image", "seed", "vdb_bytes")
"""Beginnings of the names of metrics that are not in the table, because they describe the data or the settings."""

_MOST_PICTURES, _MOST_VIEWS = 8, 3  # runs whose pictures are shown, and held-out views of each


@dataclass(frozen=True)
class SweepPageRun:
    """One run of a sweep, as the sweep's page shows it.

    Attributes:
        name: name of the run's folder in the sweep's directory.
        swept: key -> value, as typed, of the settings that differ between runs.
        state, line: how the run ended, and one line of text that says why it failed.
        seconds, attempts: the time from the run's start to its end, and how often the run was started.
        run: content of the run's directory.
    """

    name: str
    swept: Mapping[str, str]
    state: str
    line: str
    seconds: float
    attempts: int
    run: ReportedRun

    @property
    def numbers(self) -> dict[str, float]:
        """Metric -> value, for entries of ``metrics.json`` that are a single number; empty for an unfinished run."""
        metrics = self.run.metrics
        found = {name: metric_from_json(metrics, name) for name in metrics if not name.endswith("_infinite")}
        return {name: value for name, value in found.items() if value is not None}


def better_sign(name: str) -> int:
    """Return 1 if a higher value of the metric is better, -1 if a lower value is better, 0 if neither is known."""
    if name == "parameters_per_primitive":
        return 0
    signs = {**dict.fromkeys(_MORE, 1), **dict.fromkeys(_LESS, -1)}
    return next((sign for start, sign in signs.items() if name == start or name.startswith(f"{start}_")), 0)


def write_sweep_page(folder: Path, runs: Sequence[SweepPageRun], words: Sequence[str]) -> Path:
    """Write ``sweep.html`` into the directory of a sweep, finished or not; return the path.

    The page needs no other files. Runs are sorted by mean PSNR until a script sorts the runs by another column.

    Args:
        words: command-line overrides that define the sweep, as typed after ``neuprim run -m``.
    """
    colours = dict(zip((run.name for run in runs), _run_colours(len(runs)), strict=True))
    runs = sorted(runs, key=lambda run: -run.numbers.get("psnr", -math.inf))
    command, name = shlex.join(["neuprim", "run", "-m", *words]), folder.resolve().name
    done, seconds = sum(run.state == "done" for run in runs), sum(run.seconds for run in runs)
    tiles = [
        ("Runs", format_report_count(len(runs)), f"{done} done"),
        ("Time of all runs", page.format_report_duration(seconds), ""),
    ]
    sections = [
        page.masthead("sweep", name, more="\n" + report_note(f"<code>{escape(command)}</code>")),
        page.report_banner(_failure(run) for run in runs if run.state != "done"),
        page.report_tiles(tiles),
        _table(runs, colours),
        _charts(runs, colours),
        section("Held-out views side by side", _views_side_by_side(runs)),
        section("Where the numbers come from", page.fact_list([("directory", folder), ("all numbers", "sweep.csv")])),
    ]
    target, (script, source) = folder / "sweep.html", page.inline_script("sweep.js")
    write_text(target, page.render_page(f"{name} – sweep", sections, "compared", f"; script-src {source}", script))
    return target


def _failure(run: SweepPageRun) -> str:
    name = escape(run.name)
    failed = run.state == "failed"
    return (
        f"<strong>{name} failed:</strong> {escape(run.line)}"
        if failed
        else f"<strong>{name}</strong> has not finished."
    )


def _table(runs: Sequence[SweepPageRun], colours: Mapping[str, str]) -> str:
    numbers = [run.numbers for run in runs]
    names = [name for name in dict.fromkeys(n for own in numbers for n in own) if not name.startswith(_NOT_COMPARED)]
    first = [name for name in _FIRST if name in names]
    others = [name for name in names if name not in first and len({own.get(name) for own in numbers}) > 1]
    metrics, keys = [*first, *others], list(dict.fromkeys(key for run in runs for key in run.swept))
    best = {
        name: max((sign * own[name] for own in numbers if name in own), default=None)
        for name in metrics
        if (sign := better_sign(name)) and len(runs) > 1
    }
    heads, options = [escape(title) for title in ("run", *keys, "state", "attempts")], ""
    for name in metrics:
        title = escape(_TITLES.get(name, name.replace("_", " ")))
        better = {1: "more", -1: "less", 0: ""}[better_sign(name)]
        heads.append(f'<th data-metric="{escape(name)}" data-better="{better}">{title}</th>')
        options += f'<option value="{escape(name)}">{title}</option>' if better else ""
    rows = []
    for run, own in zip(runs, numbers, strict=True):
        bad = "" if run.state == "done" else ' class="bad"'
        cells = [*(escape(run.swept.get(key)) for key in keys), f"<td{bad}>{escape(run.state)}</td>", str(run.attempts)]
        for name in metrics:
            value = own.get(name)
            kind = ' class="best"' if value is not None and best.get(name) == better_sign(name) * value else ""
            data = "" if value is None else repr(value).replace("inf", "Infinity")
            cells.append(f'<td{kind} data-value="{data}">{_format_metric(name, value)}</td>')
        cells.append(f'<td data-value="{run.seconds:.3f}">{format_decimal(run.seconds, 1)}</td>')
        rows.append(page.table_row(_chip(run, colours) + _link(run), cells, f' data-run="{escape(run.name)}"'))
    choice = (
        '<p class="choose" hidden><label for="metric">Best by</label>'
        f'<select id="metric">{options}</select><b id="best"></b></p>'
    )
    table = page.number_table([*heads, "seconds in all"], rows, "numbers runs")
    text = "Orange: the best of a column, on the held-out views of each run. A name leads to the run’s own report."
    return section("All runs", (choice if options else "") + table + report_note(text))


def _link(run: SweepPageRun) -> str:
    name = escape(run.name)
    report = (run.run.run_dir / "report.html").is_file()
    return f'<a href="{escape(quote(run.name))}/report.html">{name}</a>' if report else name


def _chip(run: SweepPageRun, colours: Mapping[str, str]) -> str:
    return f'<span class="chip" style="background: {colours[run.name]}"></span>'


def _charts(runs: Sequence[SweepPageRun], colours: Mapping[str, str]) -> str:
    charts = []
    for x, unit, title in (("seconds", "seconds", "training time"), ("step", "steps", "steps")):
        lines = [ChartPoints(*run.run.series(x, "eval_psnr"), colours[run.name]) for run in runs]
        title = f"Held-out PSNR over {title}, dB"
        charts.append((title, curve_chart(title, unit, lines, size=LARGE)))
    panels = page.chart_panels(charts, "charts")
    keys = "".join(f"<li>{_chip(run, colours)}{escape(run.name)}</li>" for run in runs)
    return section("Curves", f'{panels}<ul class="keys">{keys}</ul>') if panels else ""


def _views_side_by_side(runs: Sequence[SweepPageRun]) -> str:
    """Return HTML with a few evenly spread held-out views of the best runs; ``runs`` are sorted best first."""
    pictured = [run for run in runs if run.run.views]
    if not pictured:
        return ""
    shown, views = pictured[:_MOST_PICTURES], pictured[0].run.views
    few = min(len(views), _MOST_VIEWS)
    html = ""
    if len(shown) < len(pictured):
        html += report_note(f"{len(shown)} of {len(pictured)} runs, those with the best PSNR.")
    for view in (views[i] for i in sorted({round(k * (len(views) - 1) / max(few - 1, 1)) for k in range(few)})):
        name = escape(view.stem)
        figures = page.figure(view.truth, "ground truth", f"view {name}, ground truth")
        for run in shown:
            same = next((own for own in run.run.views if (own.index, own.stem) == (view.index, view.stem)), None)
            if same is not None:
                psnr, of = format_decimal(metric_from_json(run.run.numbers_of(same), "psnr"), 2), escape(run.name)
                figures += page.figure(same.render, f"{of} <b>{psnr}</b> dB", f"view {name}, {of}", f' data-run="{of}"')
        html += f'<h3>{name}</h3><div class="pictures">{figures}</div>'
    return html


def _format_metric(name: str, value: float | None) -> str:
    if name.endswith("bytes"):
        return page.format_report_bytes(value)
    if name.endswith("seconds"):
        return format_decimal(value, 1, "s")
    if "psnr" in name:
        return format_decimal(value, 2, "dB")
    if name.startswith(("primitives", "parameters", "iterations", "train_views")):
        return format_report_count(value)
    return format_decimal(value, 1 if name.endswith("fps") else 4)


def _run_colours(number: int) -> Sequence[str]:
    from matplotlib import colormaps  # slow to import, and only reports need it
    from matplotlib.colors import to_hex

    return [to_hex(colormaps["turbo"](0.06 + 0.88 * i / max(number - 1, 1))) for i in range(number)]

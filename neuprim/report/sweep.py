"""The page of a sweep: its runs in one table, their curves in one chart, and the same held-out views side by side."""

from __future__ import annotations

import hashlib
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from neuprim.core.io.files import write_text
from neuprim.core.metrics import from_json
from neuprim.report import page
from neuprim.report.charts import LARGE, Points, curve_chart
from neuprim.report.page import escape, format_bytes, format_count, format_decimal, format_duration, section
from neuprim.report.run_record import RunRecord, ViewFiles

__all__ = ["SweepRun", "numbers_of", "write_sweep_page"]

LESS, MORE = "less", "more"
BETTER: dict[str, str] = {
    **dict.fromkeys(("psnr", "ssim", "render_fps", "sigma_correlation", "sigma_psnr"), MORE),
    **dict.fromkeys(
        (
            "lpips",
            "flip",
            "model_bytes",
            "primitives",
            "parameters",
            "train_seconds",
            "sigma_relative",
            "sigma_max_error",
        ),
        LESS,
    ),
}
"""Beginning of a metric's name -> whether more of it is better, or less. Of any other the page does not say."""

FIRST = (
    "psnr",
    "ssim",
    "psnr_worst",
    "psnr_mask",
    "lpips",
    "primitives",
    "model_bytes",
    "train_seconds",
    "render_fps",
    "iterations",
)
"""Metrics in the order of the table; the others follow."""

NOT_COMPARED = ("psnr_black_image", "seed", "vdb_bytes")
"""Beginning of names of numbers that say something of the data or the request."""

COLOURS = ("#4878a8", "#d9782d", "#4f9a56", "#c44e52", "#8a6fb3", "#8c6d52", "#cf79b0", "#7f7f7f", "#a3a23a", "#3fa6b5")
"""Of the first runs, on light and dark pages; of more runs than these a colour map's."""

MOST_PICTURES, MOST_VIEWS = 8, 3
"""Runs whose pictures are shown, and held-out views of each."""


@dataclass(frozen=True)
class SweepRun:
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
    run: RunRecord | None

    @property
    def numbers(self) -> dict[str, float]:
        """Metric -> value of ``metrics.json``; none of a run that has not finished."""
        return {} if self.run is None else numbers_of(self.run.metrics or {})


def numbers_of(metrics: Mapping[str, object]) -> dict[str, float]:
    """The single numbers of ``metrics.json``, infinite ones among them."""
    found = {name: from_json(metrics, name) for name in metrics if not name.endswith("_infinite")}
    return {name: value for name, value in found.items() if value is not None}


def write_sweep_page(folder: Path, runs: Sequence[SweepRun], words: Sequence[str]) -> Path:
    """Write ``sweep.html`` into a sweep's directory, finished or not, and return its path.

    The page needs nothing else; without scripts it stands in the order of the mean PSNR.

    Args:
        words: what the sweep was asked for, after ``neuprim run -m``.
    """
    drawn = _Page(folder, runs, words)
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
    target = folder / "sweep.html"
    text = page.render_page(
        f"{folder.resolve().name} – sweep",
        sections,
        "compared",
        f"; script-src 'nonce-{nonce}'",
        f'<script nonce="{nonce}">\n{script}\n</script>',
    )
    write_text(target, text)
    return target


def better(name: str) -> str | None:
    """Whether "more" or "less" of a metric is better; None where that is not known."""
    beginning = max((known for known in BETTER if name == known or name.startswith(f"{known}_")), key=len, default=None)
    return None if beginning is None or name == "parameters_per_primitive" else BETTER[beginning]


class _Page:
    def __init__(self, folder: Path, runs: Sequence[SweepRun], words: Sequence[str]) -> None:
        self.folder, self.words = folder, words
        self.numbers = {run.name: run.numbers for run in runs}
        self.runs = sorted(runs, key=lambda run: -self.numbers[run.name].get("psnr", -math.inf))
        self.colours = dict(zip((run.name for run in runs), _colours(len(runs)), strict=True))
        self.metrics = self._metrics()

    def _metrics(self) -> list[str]:
        """Those of the table: of the known ones all that any run has, of the others those that differ."""
        names = dict.fromkeys(name for run in self.runs for name in self.numbers[run.name])
        kept = [name for name in names if not name.startswith(NOT_COMPARED)]
        differ = {name for name in kept if len({self.numbers[run.name].get(name) for run in self.runs}) > 1}
        first = [name for name in FIRST if name in kept]
        return [*first, *(name for name in kept if name not in first and name in differ)]

    # ------------------------------------------------------------ sections

    def heading(self) -> str:
        command = shlex.join(["neuprim", "run", "-m", *self.words])
        line = f'\n<p class="note"><code>{escape(command)}</code></p>'
        return page.masthead("sweep", self.folder.resolve().name, line)

    def banner(self) -> str:
        lines = []
        for run in self.runs:
            if run.state == "failed":
                lines.append(f"<strong>{escape(run.name)} failed:</strong> {escape(run.line)}")
            elif run.state != "done":
                lines.append(f"<strong>{escape(run.name)}</strong> has not finished.")
        return page.banner(lines)

    def headline(self) -> str:
        done = sum(run.state == "done" for run in self.runs)
        tiles = [("Runs", format_count(len(self.runs)), "", f"{format_count(done)} done")]
        for name, title in (
            ("psnr", "Best PSNR"),
            ("ssim", "Best SSIM"),
            ("model_bytes", "Smallest model"),
            ("train_seconds", "Fastest training"),
        ):
            best = self._best(name)
            if best is not None:
                number, unit = _shown(name, self.numbers[best.name][name])
                tiles.append((title, number, unit, escape(best.name)))
        rule = "Metrics of the last checkpoints, on the held-out views of each run."
        return page.tiles(tiles, lead=range(1, len(tiles))) + f'<p class="rule">{rule}</p>'

    def table(self) -> str:
        keys = list(dict.fromkeys(key for run in self.runs for key in run.swept))
        best = {name: self._best(name) for name in self.metrics}
        heads = [escape(title) for title in ("run", *keys, "state")]
        heads += [
            f'<th data-metric="{escape(m)}" data-better="{better(m) or ""}">{escape(_title(m))}</th>'
            for m in self.metrics
        ]
        rows = [self._row(run, keys, best) for run in self.runs]
        table = page.number_table([*heads, "seconds in all"], rows, "numbers runs")
        options = "".join(
            f'<option value="{escape(name)}">{escape(_title(name))}</option>'
            for name in self.metrics
            if better(name) is not None
        )
        choice = (
            f'<p class="choose" hidden><label for="metric">Best by</label><select id="metric">{options}</select><b '
            f'id="best"></b></p>'
            if options
            else ""
        )
        note = '<p class="note">Orange: the best of a column. A name leads to the run’s own report.</p>'
        return section("All runs", choice + table + note)

    def _row(self, run: SweepRun, keys: Sequence[str], best: Mapping[str, SweepRun | None]) -> str:
        chip = f'<span class="chip" style="background: {self.colours[run.name]}"></span>'
        name = escape(run.name)
        if run.run is not None and (run.run.run_dir / "report.html").is_file():
            name = f'<a href="{escape(_link(run.name))}">{name}</a>'
        cells = [f"<th scope=row>{chip}{name}</th>", *(f"<td>{escape(run.swept.get(key))}</td>" for key in keys)]
        cells.append(
            f"<td>{escape(run.state)}</td>" if run.state == "done" else f'<td class="bad">{escape(run.state)}</td>'
        )
        for metric in self.metrics:
            value, first = self.numbers[run.name].get(metric), best[metric]
            kind = (
                ' class="best"'
                if first is not None and value == self.numbers[first.name][metric] and len(self.runs) > 1
                else ""
            )
            cells.append(
                f"<td{kind} "
                f'data-value="{"" if value is None else _sortable(value)}">'
                f"{' '.join(filter(None, _shown(metric, value)))}</td>"
            )
        cells.append(f'<td data-value="{run.seconds:.3f}">{format_decimal(run.seconds, 1)}</td>')
        return f'<tr data-run="{escape(run.name)}">{"".join(cells)}</tr>'

    def charts(self) -> str:
        known = [(run, run.run) for run in self.runs if run.run is not None]
        charts = []
        for x, unit, title in (
            ("seconds", "seconds", "Held-out PSNR over training time, dB"),
            ("step", "steps", "Held-out PSNR over steps, dB"),
        ):
            lines = [Points(*record.series(x, "eval_psnr"), self.colours[run.name]) for run, record in known]
            charts.append((title, curve_chart(title, unit, lines, size=LARGE)))
        panels = page.chart_panels(charts, "charts")
        keys = "".join(
            f'<li><span class="chip" style="background: {self.colours[run.name]}"></span>{escape(run.name)}</li>'
            for run, _ in known
        )
        return section("Curves", f'{panels}<ul class="keys">{keys}</ul>') if panels else ""

    def pictures(self) -> str:
        """The same views of the best runs; runs of different data have views of their own."""
        groups: dict[tuple[str | None, str | None], list[tuple[SweepRun, RunRecord]]] = {}
        for run in self.runs:
            if run.run is not None and run.run.views:
                groups.setdefault((run.run.name_of("task"), run.run.name_of("scene")), []).append((run, run.run))
        body = "".join(self._group(members, len(groups) > 1) for members in groups.values())
        return section("Held-out views side by side", body) if body else ""

    def _group(self, members: Sequence[tuple[SweepRun, RunRecord]], titled: bool) -> str:
        shown = members[:MOST_PICTURES]
        views = _spread(shown[0][1].views, MOST_VIEWS)
        html = (
            f"<h3>{escape(shown[0][1].name_of('task'))} / {escape(shown[0][1].name_of('scene'))}</h3>" if titled else ""
        )
        if len(shown) < len(members):
            html += f'<p class="note">{len(shown)} of {len(members)} runs, those with the best PSNR.</p>'
        for view in views:
            figures = "" if view.truth is None else _figure(view.truth, "ground truth", view.stem, None)
            for run, record in shown:
                same = next((own for own in record.views if own.index == view.index and own.stem == view.stem), None)
                if same is not None:
                    psnr = from_json(record.view_numbers(same), "psnr")
                    figures += _figure(
                        same.render, f"{escape(run.name)} <b>{format_decimal(psnr, 2)}</b> dB", view.stem, run.name
                    )
            html += f'<h3>{escape(view.stem or view.index)}</h3><div class="pictures">{figures}</div>'
        return html

    def facts(self) -> str:
        tried = [run for run in self.runs if run.attempts > 1]
        pairs = [("directory", str(self.folder)), ("all numbers", "sweep.csv"), ("what was asked", "sweep.json")]
        pairs += [(f"{run.name}", f"started {run.attempts} times, as its worker died") for run in tried]
        pairs += [("time of all runs together", format_duration(sum(run.seconds for run in self.runs)))]
        return section("Where the numbers come from", page.fact_list(pairs))

    def _best(self, name: str) -> SweepRun | None:
        sign = {MORE: 1.0, LESS: -1.0, None: math.nan}[better(name)]
        having = [run for run in self.runs if name in self.numbers[run.name]]
        return (
            None if math.isnan(sign) else max(having, key=lambda run: sign * self.numbers[run.name][name], default=None)
        )


def _title(name: str) -> str:
    return {
        "psnr": "PSNR",
        "ssim": "SSIM",
        "lpips": "LPIPS",
        "model_bytes": "model file",
        "train_seconds": "training",
    }.get(name, name.replace("_", " "))


def _shown(name: str, value: float | None) -> tuple[str, str]:
    """(number, unit) of a metric's value."""
    if value is None:
        return format_decimal(None, 0), ""
    if name.endswith("bytes"):
        return format_bytes(value)
    if name.endswith("seconds"):
        return format_decimal(value, 1), "s"
    if "psnr" in name:
        return format_decimal(value, 2), "dB"
    if name.startswith(("primitives", "parameters", "iterations", "train_views")):
        return format_count(value), ""
    return format_decimal(value, 1 if name.endswith("fps") else 4), ""


def _sortable(value: float) -> str:
    return repr(value) if math.isfinite(value) else ("Infinity" if value > 0 else "-Infinity")


def _link(name: str) -> str:
    from urllib.parse import quote

    return f"{quote(name)}/report.html"


def _figure(path: Path, caption: str, view: str, run: str | None) -> str:
    attribute = "" if run is None else f' data-run="{escape(run)}"'
    return page.figure(path, caption, f"view {escape(view)}, {escape(run or 'ground truth')}", attribute)


def _spread(views: Sequence[ViewFiles], most: int) -> list[ViewFiles]:
    """As many, evenly."""
    few = min(len(views), most)
    return [views[i] for i in sorted({round(k * (len(views) - 1) / max(few - 1, 1)) for k in range(few)})]


def _colours(number: int) -> Iterable[str]:
    if number <= len(COLOURS):
        return COLOURS[:number]
    from matplotlib import colormaps  # slow to import, and only reports need it
    from matplotlib.colors import to_hex

    return [to_hex(colormaps["turbo"](0.06 + 0.88 * i / (number - 1))) for i in range(number)]

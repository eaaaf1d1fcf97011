"""The report of one run: ``report.html`` with its numbers, held-out views, curves and settings."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuprim.core.conditions import condition_flag
from neuprim.core.io.files import write_text
from neuprim.core.metrics import metric_from_json
from neuprim.core.model.fields import ConditionSpec
from neuprim.report import report_page as page
from neuprim.report.charts import HELD_OUT, Chart, ChartPoints, curve_chart
from neuprim.report.pictures import ERROR_SCALE, Region, color_bar
from neuprim.report.report_page import (
    MISSING,
    Tile,
    escape,
    figure,
    format_decimal,
    format_report_count,
    format_report_duration,
    report_folded,
    report_note,
    section,
)
from neuprim.report.run_record import ReportedRun, ViewFiles, read_reported_run

VIEWER_LIMIT = 4_000_000  # bytes of a report with a viewer in it; the viewer of a larger one becomes a page beside it
_WORST_SHOWN = 12  # worst regions that are shown unfolded

_SOURCES = {"generated": "generated data: not photographs", "simulated": "simulated data: not captured"}
"""Data source -> badge; real data has none."""

_VIEWER_FILE = "viewer.html"


@dataclass(frozen=True)
class Viewer:
    """A page that draws the model, and the nonce of its scripts, which the report's content policy must allow."""

    text: str
    nonce: str


def write_report(
    run_dir: Path,
    conditions: Sequence[ConditionSpec] = (),
    viewer: Viewer | None = None,
    regions: Sequence[tuple[Region, Path]] = (),
) -> Path:
    """Write ``report.html`` into the directory of a run that has just been measured, and return its path.

    An earlier report is replaced only once the new one is complete.

    Args:
        conditions: those of the run's task; the commands that the page offers animate them.
        viewer: becomes a part of the page, or ``viewer.html`` beside it where both exceed :data:`VIEWER_LIMIT`.
        regions: the worst regions with their pictures, the worst first.

    Raises:
        DataError: ``metrics.json`` is damaged.
    """
    run, beside, target = read_reported_run(run_dir), run_dir / _VIEWER_FILE, run_dir / "report.html"
    head = [_report_head(run), page.report_banner(_report_warnings(run.metrics)), _report_headline(run)]
    body = [
        _report_films(run),
        _report_held_out_section(run),
        _report_worst_regions(regions),
        _report_curves(run),
        _report_view_table(run),
        _report_settings_section(run.metrics),
        _report_facts(run.metrics),
        _report_commands_section(run, conditions),
        report_folded("Full configuration", f"<pre><code>{escape(_read_config(run_dir))}</code></pre>"),
    ]

    def render(model: str, policy: str = "") -> str:
        title = f"{run.metrics.get('task')} / {run.metrics.get('scene')}"
        return page.render_page(title, [*head, section("The model", model), *body], policy=policy)

    text = render("") if viewer is None else render(*_embed_viewer(viewer))
    if viewer is not None and len(text.encode()) > VIEWER_LIMIT:
        write_text(beside, viewer.text)
        text = render(f'<p><a href="{_VIEWER_FILE}">{_VIEWER_FILE}</a> draws it, to be turned by hand.</p>')
    else:
        beside.unlink(missing_ok=True)  # of an earlier report
    write_text(target, text)
    return target


def _embed_viewer(viewer: Viewer) -> tuple[str, str]:
    """The model to turn by hand, as HTML, and what the page's content policy allows it."""
    frame = f'<iframe title="the model, drawn by this browser" loading="lazy" srcdoc="{escape(viewer.text)}"></iframe>'
    use = "Drag to turn, wheel to zoom, Shift and drag to move."
    return f'\n{frame}<p class="rule">{use}</p>', f"; script-src 'nonce-{viewer.nonce}'; worker-src blob:"


def _read_config(run_dir: Path) -> str:
    return (run_dir / "config.yaml").read_text(encoding="utf-8")


# ---------------------------------------------------------------- head


def _report_head(run: ReportedRun) -> str:
    """Return task and scene, and a badge unless the data is real."""
    source, drawn = str(run.metrics.get("data_source")), run.metrics.get("rendered_from")
    badge = "" if source == "real" else _SOURCES.get(source, source)
    if badge and drawn is not None:
        badge = f"{source} data: rendered from {drawn}"
    return page.masthead(str(run.metrics.get("task")), str(run.metrics.get("scene")), badge)


def _report_warnings(metrics: Mapping[str, Any]) -> list[str]:
    bad = metrics.get("worse_than_black_image")
    if not bad:
        return []
    views = "1 view is" if len(bad) == 1 else f"{format_report_count(len(bad))} views are"
    names = escape(", ".join(map(str, bad)))
    return [f"<strong>{views} worse than a black image</strong>, which the mean hides: {names}."]


def _report_headline(run: ReportedRun) -> str:
    """Return final numbers in large type, and the orbit."""
    tiles = page.report_tiles(_report_tiles(run))
    caption = "camera orbit" + (f"; shown: {escape(run.shown)}" if run.shown else "")
    orbit = figure(run.run_dir / "renders" / "orbit.webp", caption, "camera orbit around the scene")
    rule = '<p class="rule">Metrics of the last checkpoint, not the best.</p>'
    return f'<div class="with-orbit"><div>{tiles}{rule}</div><div class="orbit">{orbit}</div></div>'


def _report_tiles(run: ReportedRun) -> list[Tile]:
    metrics = run.metrics

    def number(key: str, digits: int, unit: str = "") -> str:
        return format_decimal(metric_from_json(metrics, key), digits, unit)

    fps = metric_from_json(metrics, "render_fps")
    shown = f"{len(run.view_numbers)} {escape(metrics.get('split'))} views"
    tiles = [
        ("PSNR, mean", number("psnr", 2, "dB"), shown),
        ("PSNR, worst view", number("psnr_worst", 2, "dB"), escape(metrics.get("view_worst"))),
        ("SSIM", number("ssim", 4), f"mean over views; as displayed, by 3DGS’s rule: {number('ssim_3dgs', 4)}"),
    ]
    if empty := metrics.get("views_empty"):
        tiles.append(("Empty views", format_report_count(empty), "the model is not in them"))
    if "lpips_network" in metrics:
        network = escape(metrics["lpips_network"])
        tiles.append(
            ("LPIPS", number("lpips", 4), f"{network}, mean over views; by 3DGS’s rule: {number('lpips_3dgs', 4)}")
        )
    else:
        tiles.append(("LPIPS", MISSING, f"not measured: {escape((metrics.get('not_measured') or {}).get('lpips'))}"))
    if "psnr_mask" in metrics:
        black = number("psnr_black_image_mask", 1, "dB")
        tiles.append(
            ("PSNR inside the mask", number("psnr_mask", 2, "dB"), f"where anything ever is; a black image: {black}")
        )
    return [
        *tiles,
        *_report_volume_tiles(metrics),
        ("Primitives", number("primitives", 0), ""),
        ("Parameters", number("parameters", 0), f"{number('parameters_per_primitive', 0)} per primitive"),
        ("Model size", page.format_report_bytes(metrics.get("model_bytes")), ""),
        ("Training", format_report_duration(metrics.get("train_seconds")), f"{number('iterations', 0)} iterations"),
        ("Rendering", format_decimal(fps, 1 if fps is None or fps < 100 else 0, "fps"), escape(metrics.get("backend"))),
    ]


def _report_volume_tiles(metrics: Mapping[str, Any]) -> list[Tile]:
    """Return the largest error of each known volume over the compared frames."""
    tiles: list[Tile] = []
    for key, frames in metrics.items():
        if not key.endswith("_frames") or not isinstance(frames, list):
            continue
        errors = [e for frame in frames if (e := metric_from_json(frame, "max_error")) is not None]
        if errors:
            what = "extinction" if key == "sigma_frames" else escape(key.removesuffix("_frames"))
            text = "of the frame’s largest value, on the files’ voxels"
            tiles.append((f"Largest error of {what}", format_decimal(100 * max(errors), 0, "%"), text))
    return tiles


# ---------------------------------------------------------------- pictures


def _report_films(run: ReportedRun) -> str:
    figures = ""
    for path in run.clips:
        name = escape(path.stem.removeprefix("clip_"))
        figures += figure(path, f"{name}: ground truth, render", f"film of {name}, ground truth beside render")
    body = f'{_report_shown_channels(run)}<div class="films">{figures}</div>' if figures else ""
    return section("Held-out films", body)


def _report_shown_channels(run: ReportedRun) -> str:
    """Return a line on what pictures show of the channels, where that is not plain colour."""
    return report_note(f"Shown: {escape(run.shown)}.") if run.shown else ""


def _report_held_out_section(run: ReportedRun) -> str:
    """Return each view: render, truth and error map with its numbers; the colour bar once."""
    ticks = "".join(f"<span>{'≥ ' if i == 4 else ''}{ERROR_SCALE * i / 4:g}</span>" for i in range(5))
    bar = (
        f'<div class="scale"><p>Error: mean absolute difference over {"all " if run.shown else ""}channels</p>'
        f'<div class="bar" style="background: {color_bar()}"></div><div class="ticks">{ticks}</div></div>'
    )
    rows = "".join(_report_view_row(run, view) for view in run.views)
    exact = report_note("Large pictures are compressed on this page; the PNG files in renders/ are exact.")
    return section("Held-out views", f"{_report_shown_channels(run)}{bar}{rows}{exact}" if rows else "")


def _report_view_row(run: ReportedRun, view: ViewFiles) -> str:
    entry = run.numbers_of(view)
    name = escape(entry.get("name") or view.stem)
    numbers = [
        (format_decimal(metric_from_json(entry, "psnr"), 2), "dB PSNR"),
        (format_decimal(metric_from_json(entry, "ssim"), 4), "SSIM"),
        (format_decimal(metric_from_json(entry, "seconds"), 3), "s to render"),
    ]
    line = "".join(f"<span><b>{value}</b> {what}</span>" for value, what in numbers)
    pictures = ((view.render, "render"), (view.truth, "ground truth"), (view.error, "error"))
    figures = "".join(figure(path, caption, f"{caption} of view {name}") for path, caption in pictures)
    return f'<article class="view"><header><h3>{name}</h3><p>{line}</p></header>{figures}</article>'


def _report_worst_regions(regions: Sequence[tuple[Region, Path]]) -> str:
    """Return the square of every held-out view with the largest error, worst first, folded after the first dozen."""
    figures = []
    for region, path in regions:
        name, place = escape(region.view), f"{region.side}×{region.side} at ({region.x}, {region.y})"
        caption = f"<b>{format_decimal(region.psnr, 1)}</b> dB in {place} of {name}"
        figures.append(figure(path, caption, f"worst region of view {name}: ground truth, render, error"))
    if not figures:
        return ""
    text = (
        "Of every view the square of a quarter of its shorter side with the largest error: ground truth, render, error."
    )
    first, rest = ("".join(part) for part in (figures[:_WORST_SHOWN], figures[_WORST_SHOWN:]))
    body = f'{report_note(text)}<div class="regions">{first}</div>'
    if rest:
        body += report_folded(f"{len(figures) - _WORST_SHOWN} more", f'<div class="regions">{rest}</div>')
    return section("Worst regions", body)


# ---------------------------------------------------------------- curves


def _report_curves(run: ReportedRun) -> str:
    def curve(x: str, key: str, what: str) -> Chart:
        lines = [ChartPoints(*run.series(x, key), band=True)]
        if key == "psnr":
            lines.append(ChartPoints(*run.series(x, "eval_psnr"), HELD_OUT))
        title = f"{what} over {'time' if x == 'seconds' else 'steps'}"
        return curve_chart(title, "steps" if x == "step" else x, lines, log=key == "loss")

    def held_out(title: str, unit: str, entries: Sequence[Mapping[str, Any]], joined: bool) -> Chart:
        known = [
            (i, value) for i, entry in enumerate(entries) if (value := metric_from_json(entry, "psnr")) is not None
        ]
        points = ChartPoints([i for i, _ in known], [value for _, value in known], HELD_OUT, joined)
        return curve_chart(title, unit, [points])

    charts = [
        curve("seconds", "psnr", "PSNR"),
        curve("seconds", "loss", "Loss"),
        curve("seconds", "primitives", "Primitives"),
        curve("step", "psnr", "PSNR"),
        curve("step", "loss", "Loss"),
        held_out("PSNR per view", "view", run.view_numbers, False),
        held_out("PSNR over frames", "frame", run.metrics.get("per_frame") or (), True),
    ]
    body = page.chart_panels(
        (f"{chart.title}, dB" if "PSNR" in chart.title else chart.title, chart) for chart in charts
    )
    key = '<p class="key"><span class="training">training views</span><span class="held-out">held-out views</span></p>'
    return section("Curves", key + body) if body else ""


# ---------------------------------------------------------------- tables


def _report_view_table(run: ReportedRun) -> str:
    digits = {"psnr": 3, "ssim": 5, "seconds": 3}
    rows = [
        page.table_row(
            escape(entry.get("name")), [format_decimal(metric_from_json(entry, key), n) for key, n in digits.items()]
        )
        for entry in run.view_numbers
    ]
    table = page.number_table(("view", "PSNR, dB", "SSIM", "render, s"), rows)
    return report_folded(f"All {format_report_count(len(rows))} held-out views", table)


def _report_settings_section(metrics: Mapping[str, Any]) -> str:
    rows = []
    for key, pair in (metrics.get("non_default") or {}).items():
        default, value = (f"<code>{escape(page.format_report_setting(v))}</code>" for v in pair)
        rows.append(page.table_row(escape(key), (f'<td class="default">{default}</td>', value)))
    table = page.number_table(("setting", "default", "this run"), rows, "")
    body = table if rows else report_note("All settings are at their defaults.")
    return section("Settings changed from their defaults", body)


def _report_facts(metrics: Mapping[str, Any]) -> str:
    keys = ("split", "data_source", "color_space", "downsampling", "background", "seed", "iterations")
    pairs = [(key.replace("_", " "), metrics.get(key)) for key in (*keys, "checkpoint", "backend", "device")]
    pairs.append(("channels", ", ".join(map(str, metrics.get("channels") or ()))))
    pairs += (metrics.get("versions") or {}).items()
    made_by = metrics.get("made_by") or {}
    pairs += [(f"{kind} made by", made_by[kind]) for kind in ("task", "scene", "loss") if kind in made_by]
    return section("Run", page.fact_list(pairs))


def _report_commands_section(run: ReportedRun, conditions: Sequence[ConditionSpec]) -> str:
    """Return the commands that go on from here, among them an animation of each condition of the task that has one."""
    folder = shlex.quote(str(run.run_dir))
    orbit = f"neuprim render {folder} --camera orbit"
    lines = [(f"neuprim eval {folder}", "measure again"), (orbit, "fly around the scene")]
    for spec in conditions:
        if spec.sweep:
            command = f"{orbit} {condition_flag(spec.name)} {shlex.quote(spec.sweep)}"
            lines.append((command, f"fly around it while the {spec.name.replace('_', ' ')} changes"))
    items = "".join(f"<li><code>{escape(line)}</code><span>{escape(what)}</span></li>" for line, what in lines)
    return section("Go on", f'<ul class="commands">{items}</ul>')

"""Write the report of one run, ``report.html``: interactive model, held-out views, measurements, curves, settings."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
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
from neuprim.report.run_record import ReportedRun, ViewFiles, median_and_worst, read_reported_run

VIEWER_LIMIT = 4_000_000  # bytes of a report with a viewer in it; the viewer of a larger one becomes a page beside it
_WORST_SHOWN = 6  # worst regions that are shown unfolded

_SOURCES = {"generated": "generated data: not photographs", "simulated": "simulated data: not captured"}
"""Data source -> text of the badge in the report's head; real data has no badge."""

_VIEWER_FILE = "viewer.html"


@dataclass(frozen=True)
class Viewer:
    """An HTML page that renders the model, and the nonce of the page's scripts.

    The report's content policy must allow this nonce, because the report embeds the page.
    """

    text: str
    nonce: str


def write_report(
    run_dir: Path,
    conditions: Sequence[ConditionSpec] = (),
    viewer: Viewer | None = None,
    regions: Sequence[tuple[Region, Path]] = (),
    command: str = "",
) -> Path:
    """Write ``report.html`` into a run directory that holds ``metrics.json``; return the report's path.

    An earlier report is replaced only when the new one is complete.

    Args:
        conditions: conditions of the run's task, for which the page shows commands that animate them.
        viewer: page that renders the model. The report embeds this page. If the report would then exceed
            :data:`VIEWER_LIMIT`, the page is written to ``viewer.html`` instead, and the report has a link.
        regions: the worst regions with their pictures, worst first.
        command: command line that made the run; "" if no single command made it.

    Raises:
        DataError: ``metrics.json`` is damaged.
    """
    run, beside, target = read_reported_run(run_dir), run_dir / _VIEWER_FILE, run_dir / "report.html"
    head = [_report_head(run, command), page.report_banner(_report_warnings(run.metrics))]
    body = [
        _report_headline(run.metrics),
        _report_curves(run),
        _report_films(run),
        _report_held_out_section(run),
        _report_worst_regions(regions),
        _report_commands_section(run, conditions),
        _report_details(run),
    ]
    script, source = page.inline_script("run.js")

    def render(model: str, sources: str = "") -> str:
        title = f"{run.metrics.get('task')} / {run.metrics.get('scene')}"
        both = section("Model", f'<div class="model">{model}{_report_comparison(run)}</div>')
        return page.render_page(title, [*head, both, *body], policy=f"; script-src {source}{sources}", script=script)

    orbit = _report_orbit(run)
    text = render(orbit) if viewer is None else render(*_embed_viewer(viewer))
    if viewer is not None and len(text.encode()) > VIEWER_LIMIT:
        write_text(beside, viewer.text)
        text = render(f'<div>{orbit}<p><a href="{_VIEWER_FILE}">Open the interactive model</a></p></div>')
    else:
        beside.unlink(missing_ok=True)  # of an earlier report
    write_text(target, text)
    return target


def _embed_viewer(viewer: Viewer) -> tuple[str, str]:
    """Return the interactive model as HTML, and the sources that the page's content policy must allow for it."""
    frame = f'<iframe title="Interactive model" loading="lazy" srcdoc="{escape(viewer.text)}"></iframe>'
    use = "Drag to turn, scroll to zoom, Shift and drag to move."
    return f"<figure>{frame}<figcaption>{use}</figcaption></figure>", f" 'nonce-{viewer.nonce}'; worker-src blob:"


# ---------------------------------------------------------------- head


def _report_head(run: ReportedRun, command: str) -> str:
    """Return the report's head: task and scene, a badge if the data are not real, command, machine and date."""
    metrics = run.metrics
    source, drawn = str(metrics.get("data_source")), metrics.get("rendered_from")
    badge = "" if source == "real" else _SOURCES.get(source, source)
    if badge and drawn is not None:
        badge = f"{source} data: rendered from {drawn}"
    file, size = run.run_dir / "metrics.json", metrics.get("image_size")
    facts = {
        "Date": f"{datetime.fromtimestamp(file.stat().st_mtime):%Y-%m-%d %H:%M}" if file.is_file() else None,
        "Machine": metrics.get("device"),
        "Data": metrics.get("dataset"),
        "Image size": "×".join(map(str, size)) if isinstance(size, list) else None,
    }
    more = f'<div class="command">{page.command_line(command)}</div>' if command else ""
    known = page.fact_list((name, value) for name, value in facts.items() if value is not None)
    return page.masthead(str(metrics.get("task")), str(metrics.get("scene")), badge) + more + known


def _report_warnings(metrics: Mapping[str, Any]) -> list[str]:
    found = []
    if bad := metrics.get("worse_than_black_image"):
        names = escape(", ".join(map(str, bad)))
        found.append(f"<strong>Views that are worse than a black image: {len(bad)}</strong> ({names})")
    if empty := metrics.get("views_empty"):
        found.append(f"<strong>Views in which no primitive is visible: {format_report_count(empty)}</strong>")
    return found


def _report_headline(metrics: Mapping[str, Any]) -> str:
    """Return HTML tiles (large numbers) with quality, size and training time, as far as they were measured."""
    psnr, worst = (metric_from_json(metrics, key) for key in ("psnr", "psnr_worst"))
    tiles: list[Tile] = []
    if psnr is not None:
        views = f"mean of {len(metrics.get('per_view') or ())} held-out views"
        least = f"; worst {format_decimal(worst, 2, 'dB')} ({escape(metrics.get('view_worst'))})"
        tiles.append(("PSNR", format_decimal(psnr, 2, "dB"), views + (least if worst is not None else "")))
    if (ssim := metric_from_json(metrics, "ssim")) is not None:
        tiles.append(("SSIM", format_decimal(ssim, 4), "mean of the same views"))
    if (size := metrics.get("model_bytes")) is not None:
        count = format_report_count(metrics.get("primitives"))
        tiles.append(("Model file", page.format_report_bytes(size), f"{count} primitives"))
    if (seconds := metrics.get("train_seconds")) is not None:
        steps = format_report_count(metrics.get("iterations"))
        tiles.append(("Training time", format_report_duration(seconds), f"{steps} iterations"))
    note = report_note("Measured on the held-out views with the last checkpoint, not the best one.")
    return page.report_tiles(tiles) + note if tiles else ""


# ---------------------------------------------------------------- pictures


def _report_orbit(run: ReportedRun) -> str:
    caption = "camera orbit" + (f"; shown: {escape(run.shown)}" if run.shown else "")
    return figure(run.run_dir / "renders" / "orbit.webp", caption, "camera orbit around the scene")


def _report_comparison(run: ReportedRun) -> str:
    """Return the HTML element in which ``run.js`` shows ground truth and render of a view with a divider."""
    pictured = {view.index for view in run.views}
    chosen = zip(median_and_worst(run.view_numbers), ("Median view", "Worst view"), strict=False)
    buttons = "".join(_view_button(index, text) for index, text in chosen if index in pictured)
    if not buttons:
        return ""
    divider = '<input type="range" value="50" aria-label="Divider between ground truth and render">'
    return (
        f'<figure class="compare" hidden><div class="choose" role="group" aria-label="View">{buttons}</div>'
        f'<div class="slide"></div><label class="choose">ground truth {divider} render</label>'
        '<figcaption aria-live="polite"></figcaption></figure>'
    )


def _view_button(index: int, text: str) -> str:
    """Return an HTML button that shows a view's pictures in the comparison; ``run.js`` makes the button visible."""
    return f'<button type="button" data-view="view-{index}" hidden>{text}</button>'


def _report_films(run: ReportedRun) -> str:
    figures = ""
    for path in run.clips:
        name = escape(path.stem.removeprefix("clip_"))
        figures += figure(path, f"{name}: ground truth, render", f"film of {name}, ground truth beside render")
    body = f'{_report_shown_channels(run)}<div class="films">{figures}</div>' if figures else ""
    return section("Held-out films", body)


def _report_shown_channels(run: ReportedRun) -> str:
    """Return a line that says which channels the pictures show; "" for plain colour."""
    return report_note(f"Shown: {escape(run.shown)}.") if run.shown else ""


def _report_held_out_section(run: ReportedRun) -> str:
    """Return a section with ground truth, render, error map and metrics of each pictured view, and the error scale."""
    bar = f'0<span class="bar" style="background: {color_bar()}"></span>{ERROR_SCALE:g} or more'
    scale = report_note(f"Error: mean absolute difference over {'all ' if run.shown else ''}channels, {bar}.")
    orders = (("0", "view"), ("1", "PSNR, lowest first"), ("-1", "PSNR, highest first"))
    options = "".join(f'<option value="{sign}">{text}</option>' for sign, text in orders)
    order = f'<p class="choose" hidden><label for="order">Sort by</label><select id="order">{options}</select></p>'
    views = f'<div class="gallery">{"".join(_report_view(run, view) for view in run.views)}</div>'
    exact = report_note("Large pictures are compressed on this page. The PNG files in renders/ are exact.")
    body = f"{_report_shown_channels(run)}{scale}{order}{views}{exact}"
    return section("Held-out views", body if run.views else "")


def _report_view(run: ReportedRun, view: ViewFiles) -> str:
    entry = run.numbers_of(view)
    name, psnr = escape(entry.get("name") or view.stem), metric_from_json(entry, "psnr")
    numbers = [(format_decimal(psnr, 2), "dB PSNR"), (format_decimal(metric_from_json(entry, "ssim"), 4), "SSIM")]
    line = "".join(f"<span><b>{value}</b> {what}</span>" for value, what in numbers)
    pictures = ((view.truth, "ground truth"), (view.render, "render"), (view.error, "error"))
    figures = "".join(figure(path, caption, f"{caption} of view {name}") for path, caption in pictures)
    head = f"<header><h3>{name}</h3><p>{line}</p>{_view_button(view.index, 'Compare')}</header>"
    value = "" if psnr is None else repr(psnr).replace("inf", "Infinity")
    return f'<article class="view" id="view-{view.index}" data-psnr="{value}">{head}{figures}</article>'


def _report_worst_regions(regions: Sequence[tuple[Region, Path]]) -> str:
    """Return a section with pictures of the worst regions, worst first; all after the sixth are collapsed."""
    figures = []
    for region, path in regions:
        name, place = escape(region.view), f"{region.side}×{region.side} at ({region.x}, {region.y})"
        caption = f"<b>{format_decimal(region.psnr, 1)}</b> dB in {place} of {name}"
        figures.append(figure(path, caption, f"worst region of view {name}: ground truth, render, error"))
    if not figures:
        return ""
    text = "The square with the largest error in each view: ground truth, render, error."
    first, rest = ("".join(part) for part in (figures[:_WORST_SHOWN], figures[_WORST_SHOWN:]))
    body = f'{report_note(text)}<div class="regions">{first}</div>'
    if rest:
        body += report_folded(f"{len(figures) - _WORST_SHOWN} more", f'<div class="regions">{rest}</div>')
    return section("Worst regions", body)


# ---------------------------------------------------------------- curves


def _report_curves(run: ReportedRun) -> str:
    def curve(key: str, what: str) -> Chart:
        lines = [ChartPoints(*run.series("seconds", key), band=True)]
        if key == "psnr":
            lines.append(ChartPoints(*run.series("seconds", "eval_psnr"), HELD_OUT))
        return curve_chart(f"{what} over time", "seconds", lines, log=key == "loss")

    frames = run.metrics.get("per_frame")
    psnrs = [metric_from_json(entry, "psnr") for entry in frames or run.view_numbers]
    known = {i: value for i, value in enumerate(psnrs) if value is not None}
    points = ChartPoints(list(known), list(known.values()), HELD_OUT, joined=bool(frames))
    title, unit = ("PSNR over frames", "frame") if frames else ("PSNR per view", "view")
    charts = [curve("psnr", "PSNR"), curve("loss", "Loss"), curve_chart(title, unit, [points])]
    body = page.chart_panels(
        (f"{chart.title}, dB" if "PSNR" in chart.title else chart.title, chart) for chart in charts
    )
    key = '<p class="key"><span class="training">training views</span><span class="held-out">held-out views</span></p>'
    return section("Curves", key + body) if body else ""


# ---------------------------------------------------------------- commands and details


def _report_commands_section(run: ReportedRun, conditions: Sequence[ConditionSpec]) -> str:
    """Return a section with commands for this run, including one that animates each condition that can be animated."""
    folder = shlex.quote(str(run.run_dir))
    orbit = f"neuprim render {folder} --camera orbit"
    lines = [(f"neuprim view {folder}", "open the model in the viewer"), (orbit, "render a camera orbit")]
    for spec in conditions:
        if spec.sweep:
            command = f"{orbit} {condition_flag(spec.name)} {shlex.quote(spec.sweep)}"
            lines.append((command, f"render a camera orbit while the {spec.name.replace('_', ' ')} changes"))
    lines.append((f"neuprim compress {folder}", "write a smaller model file"))
    lines.append((f"neuprim eval {folder}", "measure the held-out views again"))
    items = "".join(f'<li class="command">{page.command_line(line, what)}</li>' for line, what in lines)
    return section("Next steps", f'<ul class="commands">{items}</ul>')


def _report_details(run: ReportedRun) -> str:
    """Return a folded section with all measurements, settings and versions."""
    views, file = _report_view_table(run.view_numbers), run.run_dir / "config.yaml"
    parts = {
        "All measurements": page.fact_list(_report_measurements(run.metrics)),
        f"All {format_report_count(len(run.view_numbers))} held-out views": views,
        "Settings changed from their defaults": _report_settings(run.metrics),
        "Data and versions": page.fact_list(_report_facts(run.metrics)),
        "Full configuration": f"<pre><code>{escape(file.read_text(encoding='utf-8'))}</code></pre>",
    }
    return section("Details", "".join(report_folded(title, body) for title, body in parts.items()))


def _report_measurements(metrics: Mapping[str, Any]) -> list[tuple[str, object]]:
    """Return (name, value as text) of the measurements that the large tiles at the top do not show."""
    rows: list[tuple[str, str, int, str]] = [
        ("PSNR of sRGB images", "psnr_srgb", 2, "dB"),
        ("PSNR of displayed images", "psnr_display", 2, "dB"),
        ("PSNR inside the mask", "psnr_mask", 2, "dB"),
        ("PSNR inside the mask, black image", "psnr_black_image_mask", 2, "dB"),
        ("SSIM by the rule of 3DGS", "ssim_3dgs", 4, ""),
        (f"LPIPS ({metrics.get('lpips_network')})", "lpips", 4, ""),
        ("LPIPS by the rule of 3DGS", "lpips_3dgs", 4, ""),
        ("Parameters", "parameters", 0, ""),
        ("Parameters per primitive", "parameters_per_primitive", 0, ""),
        (f"Rendering speed ({metrics.get('backend')})", "render_fps", 1, "fps"),
    ]
    found: list[tuple[str, object]] = [
        (name, format_decimal(value, digits, unit))
        for name, key, digits, unit in rows
        if (value := metric_from_json(metrics, key)) is not None
    ]
    found += [(name.upper(), f"not measured: {why}") for name, why in (metrics.get("not_measured") or {}).items()]
    for key, frames in metrics.items():  # of each known volume, over the compared frames
        if key.endswith("_frames") and isinstance(frames, list):
            errors = [e for frame in frames if (e := metric_from_json(frame, "max_error")) is not None]
            what = "extinction" if key == "sigma_frames" else key.removesuffix("_frames")
            text = f"{format_decimal(100 * max(errors, default=0.0), 0, '%')} of the frame’s maximum"
            found += [(f"Largest error of {what}", text)] if errors else []
    return found


def _report_view_table(entries: Sequence[Mapping[str, Any]]) -> str:
    digits = {"psnr": 3, "ssim": 5, "seconds": 3}
    rows = [
        page.table_row(
            escape(entry.get("name")), [format_decimal(metric_from_json(entry, key), n) for key, n in digits.items()]
        )
        for entry in entries
    ]
    return page.number_table(("view", "PSNR, dB", "SSIM", "render, s"), rows)


def _report_settings(metrics: Mapping[str, Any]) -> str:
    rows = []
    for key, pair in (metrics.get("non_default") or {}).items():
        default, value = (f"<code>{escape(page.format_report_setting(v))}</code>" for v in pair)
        rows.append(page.table_row(escape(key), (f'<td class="default">{default}</td>', value)))
    table = page.number_table(("setting", "default", "this run"), rows, "")
    return table if rows else report_note("All settings are at their defaults.")


def _report_facts(metrics: Mapping[str, Any]) -> list[tuple[str, object]]:
    keys = ("split", "train_views", "data_source", "color_space", "downsampling", "background", "seed", "backend")
    pairs: list[tuple[str, object]] = [(key.replace("_", " "), metrics.get(key)) for key in keys]
    pairs.append(("channels", ", ".join(map(str, metrics.get("channels") or ()))))
    pairs += (metrics.get("versions") or {}).items()
    made_by = metrics.get("made_by") or {}
    return pairs + [(f"{kind} made by", made_by[kind]) for kind in ("task", "scene", "loss") if kind in made_by]

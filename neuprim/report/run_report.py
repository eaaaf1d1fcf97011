"""The report of one run: ``report.html`` with its numbers, held-out views, curves and settings."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from neuprim.core.conditions import condition_flag
from neuprim.core.io.files import write_text
from neuprim.core.metrics import metric_from_json
from neuprim.core.model.fields import ConditionSpec
from neuprim.report import report_page as page
from neuprim.report.charts import HELD_OUT, Chart, ChartPoints, curve_chart, view_chart
from neuprim.report.pictures import ERROR_SCALE, color_bar, inline_picture
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
from neuprim.report.run_record import (
    ReportedRun,
    ViewFiles,
    as_reported_number,
    read_reported_run,
    read_reported_view_numbers,
)

VIEWER_LIMIT = 4_000_000  # bytes of a report with a viewer in it; the viewer of a larger one becomes a page beside it
_WORST_SHOWN = 12  # worst regions that are shown unfolded

_SOURCES = {
    "generated": ("generated data", "ray-cast scenes of our own, not photographs"),
    "simulated": ("simulated data", "a stand-in for data that was not given"),
}
"""Data source -> badge and explanation; real data has none."""

_VIEWER_FILE = "viewer.html"


@dataclass(frozen=True)
class Viewer:
    """A page that draws the model, and the nonce of its scripts, which the report's content policy must allow."""

    text: str
    nonce: str


def write_report(run_dir: Path, conditions: Sequence[ConditionSpec] = (), viewer: Viewer | None = None) -> Path:
    """Write ``report.html`` into a run directory, finished or not, and return its path.

    An earlier report is replaced only once the new one is complete.

    Args:
        conditions: those of the run's task; the commands that the page offers animate them.
        viewer: becomes a part of the page, or ``viewer.html`` beside it where both exceed :data:`VIEWER_LIMIT`.

    Raises:
        DataError: the directory is no run, or its ``config.yaml`` or ``metrics.json`` is damaged.
    """
    run_dir = Path(run_dir)
    run, beside, target = read_reported_run(run_dir), run_dir / _VIEWER_FILE, run_dir / "report.html"
    text = _render_report(run, conditions, viewer)
    if viewer is not None and len(text.encode()) > VIEWER_LIMIT:
        write_text(beside, viewer.text)
        text = _render_report(run, conditions, linked=_VIEWER_FILE)
    else:
        beside.unlink(missing_ok=True)  # of an earlier report
    write_text(target, text)
    return target


def _render_report(
    run: ReportedRun, conditions: Sequence[ConditionSpec], viewer: Viewer | None = None, linked: str = ""
) -> str:
    names = [name for name in (run.name_of("task"), run.name_of("scene")) if name]
    sections = (
        _report_head(run),
        page.report_banner(_report_page_warnings(run)),
        _report_headline(run),
        _report_model_section("" if viewer is None else viewer.text, linked),
        _report_films(run),
        _report_held_out_section(run),
        _report_worst_regions(run),
        _report_curves(run),
        _report_view_table(run),
        _report_settings_section(run),
        _report_facts(run),
        _report_commands_section(run, conditions),
        _report_config(run),
    )
    policy = "" if viewer is None else f"; script-src 'nonce-{viewer.nonce}'; worker-src blob:"
    return page.render_page(" / ".join(names) or run.run_dir.name, sections, policy=policy)


# ---------------------------------------------------------------- head


def _report_head(run: ReportedRun) -> str:
    """Return task and scene, and a badge unless the data is real."""
    source, drawn = run.field("data_source"), run.field("rendered_from")
    mark = ""
    if source is None:
        mark = page.badge("data source not recorded", "real, generated or simulated is not known")
    elif source != "real":
        name, text = _SOURCES.get(str(source), (str(source), "not photographs or captures"))
        mark = page.badge(name, text if drawn is None else f"rendered from {drawn}, not photographs")
    return page.masthead(run.name_of("task") or "", run.name_of("scene") or "", mark)


def _report_page_warnings(run: ReportedRun) -> list[str]:
    """Return notes, HTML: no final metrics, unreadable log lines, views worse than nothing."""
    notes = []
    if not run.metrics:
        last, train = run.last("step"), run.config.get("train")
        total = as_reported_number(train.get("iterations")) if isinstance(train, Mapping) else None
        of = "" if total is None else f" of {format_report_count(total)}"
        where = f"The last logged step is {format_report_count(last[1])}{of}." if last else "No step was logged."
        notes.append(f"<strong>This run has not finished.</strong> There is no metrics.json yet. {where}")
    if run.unreadable_lines:
        lines = "1 line" if run.unreadable_lines == 1 else f"{run.unreadable_lines} lines"
        notes.append(f"{lines} of metrics.jsonl could not be read and left out of the curves.")
    bad = run.field("worse_than_black_image")
    if isinstance(bad, list) and bad:
        views = "1 view is" if len(bad) == 1 else f"{format_report_count(len(bad))} views are"
        names = escape(", ".join(map(str, bad)))
        notes.append(f"<strong>{views} worse than a black image</strong>, which the mean hides: {names}.")
    return notes


def _report_headline(run: ReportedRun) -> str:
    """Return final numbers in large type, or the last logged ones of an unfinished run; and the orbit."""
    html = page.report_tiles(
        _report_interim_tiles(run) if run.metrics is None else _report_final_tiles(run, run.metrics)
    )
    if run.metrics is not None:
        kept = run.field("checkpoint")
        which = "the last checkpoint, not the best" if kept in (None, "last") else f"checkpoint “{escape(kept)}”"
        html += f'<p class="rule">Metrics of {which}.</p>'
    if run.orbit is not None:
        caption = "camera orbit" + (f"; shown: {escape(run.shown)}" if run.shown else "")
        orbit = figure(run.orbit, caption, "camera orbit around the scene")
        html = f'<div class="with-orbit"><div>{html}</div><div class="orbit">{orbit}</div></div>'
    return html


def _report_final_tiles(run: ReportedRun, metrics: Mapping[str, object]) -> list[Tile]:
    mean, worst, ssim = (metric_from_json(metrics, key) for key in ("psnr", "psnr_worst", "ssim"))
    views, split = len(read_reported_view_numbers(run)), escape(metrics.get("split") or "held-out")
    shown = f"{format_report_count(views)} {split} view{'s' if views != 1 else ''}" if views else ""
    empty, worst_name = metrics.get("views_empty"), _worst_view_name(run)
    displayed = metric_from_json(metrics, "ssim_3dgs")
    rule = "" if displayed is None else f"; as displayed, by 3DGS’s rule: {format_decimal(displayed, 4)}"
    each, steps = metrics.get("parameters_per_primitive"), metrics.get("iterations")
    per_primitive = "" if each is None else f"{format_report_count(each)} per primitive"
    iterations = "" if steps is None else f"{format_report_count(steps)} iterations"
    fps, backend = as_reported_number(metrics.get("render_fps")), metrics.get("backend")
    speed, unit = format_decimal(fps, 1 if fps is None or fps < 100 else 0), "" if fps is None else "fps"
    return [
        _decibel_tile("PSNR, mean", mean, shown),
        _decibel_tile("PSNR, worst view", worst, escape(worst_name) if worst_name else ""),
        *([("Empty views", format_report_count(empty), "", "the model is not in them")] if empty else []),
        ("SSIM", format_decimal(ssim, 4), "", "" if ssim is None else f"mean over views{rule}"),
        *_report_lpips_tile(metrics),
        *_report_mask_tile(metrics),
        *_report_volume_tiles(metrics),
        ("Primitives", format_report_count(metrics.get("primitives")), "", ""),
        ("Parameters", format_report_count(metrics.get("parameters")), "", per_primitive),
        ("Model size", *page.format_report_bytes(metrics.get("model_bytes")), ""),
        ("Training", format_report_duration(metrics.get("train_seconds")), "", iterations),
        ("Rendering", speed, unit, escape(backend) if backend else ""),
    ]


def _decibel_tile(label: str, value: float | None, text: str) -> Tile:
    return label, format_decimal(value, 2), "" if value is None else "dB", text


def _report_lpips_tile(metrics: Mapping[str, object]) -> list[Tile]:
    value, reasons = metric_from_json(metrics, "lpips"), metrics.get("not_measured")
    if value is None:
        reason = reasons.get("lpips") if isinstance(reasons, Mapping) else None
        return [] if reason is None else [("LPIPS", MISSING, "", f"not measured: {escape(reason)}")]
    rule = metric_from_json(metrics, "lpips_3dgs")
    more = "" if rule is None else f"; by 3DGS’s rule: {format_decimal(rule, 4)}"
    return [("LPIPS", format_decimal(value, 4), "", f"{escape(metrics.get('lpips_network'))}, mean over views{more}")]


def _report_mask_tile(metrics: Mapping[str, object]) -> list[Tile]:
    inside, black = metric_from_json(metrics, "psnr_mask"), metric_from_json(metrics, "psnr_black_image_mask")
    if inside is None:
        return []
    compared = "" if black is None else f"; a black image: {format_decimal(black, 1)} dB"
    return [_decibel_tile("PSNR inside the mask", inside, f"where anything ever is{compared}")]


def _report_volume_tiles(metrics: Mapping[str, object]) -> list[Tile]:
    """Return the largest error of each known volume over the compared frames."""
    tiles: list[Tile] = []
    for key, frames in metrics.items():
        if not key.endswith("_frames") or not isinstance(frames, list):
            continue
        found = [metric_from_json(frame, "max_error") for frame in frames if isinstance(frame, Mapping)]
        errors = [value for value in found if value is not None]
        if errors:
            what = "extinction" if key == "sigma_frames" else escape(key.removesuffix("_frames"))
            text = "of the frame’s largest value, on the files’ voxels"
            tiles.append((f"Largest error of {what}", format_decimal(100 * max(errors), 0), "%", text))
    return tiles


def _report_interim_tiles(run: ReportedRun) -> list[Tile]:
    tiles: list[Tile] = []
    for label, key, digits, unit in (
        ("PSNR, held-out", "eval_psnr", 2, "dB"),
        ("PSNR, training view", "psnr", 2, "dB"),
        ("Loss", "loss", 4, ""),
        ("Primitives", "primitives", 0, ""),
        ("Training", "seconds", 1, "s"),
    ):
        last = run.last(key)
        if last is None:
            tiles.append((label, MISSING, "", "not logged yet"))
        else:
            tiles.append((label, format_decimal(last[1], digits), unit, f"at step {format_report_count(last[0])}"))
    return tiles


def _worst_view_name(run: ReportedRun) -> str | None:
    known = [
        (value, entry.get("name"))
        for entry in read_reported_view_numbers(run)
        if (value := metric_from_json(entry, "psnr")) is not None
    ]
    name = min(known, key=lambda pair: pair[0])[1] if known else None
    return None if name is None else str(name)


def _report_model_section(viewer: str, linked: str) -> str:
    """Return the model to turn by hand: a page in this page, or a link to one."""
    if viewer:
        frame = f'<iframe title="the model, drawn by this browser" loading="lazy" srcdoc="{escape(viewer)}"></iframe>'
        use = "Drag to turn, wheel to zoom, Shift and drag to move."
        return section("The model", f'\n{frame}<p class="rule">{use}</p>')
    if linked:
        link = f'<a href="{escape(linked)}">{escape(linked)}</a>'
        return section("The model", f"<p>{link} draws it, to be turned by hand.</p>")
    return ""


# ---------------------------------------------------------------- pictures


def _report_films(run: ReportedRun) -> str:
    figures = ""
    for path in run.clips:
        name = escape(path.stem.removeprefix("clip_"))
        figures += figure(path, f"{name}: ground truth, render", f"film of {name}, ground truth beside render")
    return (
        section("Held-out films", f'{_report_shown_channels(run)}<div class="films">{figures}</div>') if figures else ""
    )


def _report_shown_channels(run: ReportedRun) -> str:
    """Return a line on what pictures show of the channels, where that is not plain colour."""
    return report_note(f"Shown: {escape(run.shown)}.") if run.shown else ""


def _report_held_out_section(run: ReportedRun) -> str:
    """Return each view: render, truth and error map with its numbers; the colour bar once."""
    if not run.views:
        return ""
    rows, compressed = "", False
    for view in run.views:
        row, large = _report_view_row(run, view)
        rows, compressed = rows + row, compressed or large
    exact = "Large pictures are compressed on this page (WebP, quality 90); the PNG files in renders/ are exact."
    ticks = "".join(f"<span>{'≥ ' if i == 4 else ''}{ERROR_SCALE * i / 4:g}</span>" for i in range(5))
    bar = (
        f'<div class="scale"><p>Error: mean absolute difference over {"all " if run.shown else ""}channels</p>'
        f'<div class="bar" style="background: {color_bar()}"></div><div class="ticks">{ticks}</div></div>'
    )
    return section(
        "Held-out views", f"{_report_shown_channels(run)}{bar}{rows}{report_note(exact) if compressed else ''}"
    )


def _report_view_row(run: ReportedRun, view: ViewFiles) -> tuple[str, bool]:
    """Return a view's pictures and numbers, and whether a picture was compressed."""
    entry = run.view_numbers(view)
    name = escape(entry.get("name") or view.stem or view.index)
    figures, compressed = "", False
    for path, caption in ((view.render, "render"), (view.truth, "ground truth"), (view.error, "error")):
        shown = None if path is None else inline_picture(path)
        figures += page.picture(shown, caption, f"{caption} of view {name}", path is not None)
        compressed = compressed or (shown is not None and shown.compressed)
    numbers = [
        (format_decimal(metric_from_json(entry, "psnr"), 2), "dB PSNR"),
        (format_decimal(metric_from_json(entry, "ssim"), 4), "SSIM"),
    ]
    if (seconds := as_reported_number(entry.get("seconds"))) is not None:
        numbers.append((format_decimal(seconds, 3), "s to render"))
    line = "".join(f"<span><b>{value}</b> {what}</span>" for value, what in numbers)
    return f'<article class="view"><header><h3>{name}</h3><p>{line}</p></header>{figures}</article>', compressed


def _report_worst_regions(run: ReportedRun) -> str:
    """Return the square of every held-out view with the largest error, worst first, folded after the first dozen."""
    figures = []
    for region in run.regions:
        name = escape(region.name)
        caption = f"<b>{format_decimal(region.psnr, 1)}</b> dB in {escape(region.place)} of {name}"
        figures.append(figure(region.path, caption, f"worst region of view {name}: ground truth, render, error"))
    if not figures:
        return ""
    text = (
        "Of every view the square of a quarter of its shorter side with the largest error: ground truth, render, error."
    )
    first, rest = figures[:_WORST_SHOWN], figures[_WORST_SHOWN:]
    body = f'{report_note(text)}<div class="regions">{"".join(first)}</div>'
    if rest:
        body += report_folded(f"{format_report_count(len(rest))} more", f'<div class="regions">{"".join(rest)}</div>')
    return section("Worst regions", body)


# ---------------------------------------------------------------- curves


def _report_curves(run: ReportedRun) -> str:
    views = [metric_from_json(entry, "psnr") for entry in read_reported_view_numbers(run)]
    mean, frames = metric_from_json(run.metrics or {}, "psnr"), run.field("per_frame")
    known = [
        (i, value)
        for i, entry in enumerate(frames if isinstance(frames, list) else [])
        if isinstance(entry, Mapping) and (value := metric_from_json(entry, "psnr")) is not None
    ]
    film = ChartPoints([i for i, _ in known], [value for _, value in known], HELD_OUT)
    lines = [
        _report_curve_chart(run, x, key, title)
        for x, key, title in (
            ("seconds", "psnr", "PSNR over time"),
            ("seconds", "loss", "Loss over time"),
            ("seconds", "primitives", "Primitives over time"),
            ("step", "psnr", "PSNR over steps"),
            ("step", "loss", "Loss over steps"),
        )
    ]
    charts = [(f"{chart.title}, dB" if "PSNR" in chart.title else chart.title, chart) for chart in lines]
    hung = view_chart("PSNR per view", views, mean, _worst_view_name(run))
    charts.append(("PSNR per view, dB <small>dashed: mean</small>", hung))
    charts.append(("PSNR over the frames of a film, dB", curve_chart("PSNR over frames", "frame", [film])))
    body = page.chart_panels(charts)
    key = '<p class="key"><span class="training">training views</span><span class="held-out">held-out views</span></p>'
    return section("Curves", key + body) if body else ""


def _report_curve_chart(run: ReportedRun, x: str, key: str, title: str) -> Chart:
    lines = [ChartPoints(*run.series(x, key), band=True)]
    if key == "psnr":
        lines.append(ChartPoints(*run.series(x, "eval_psnr"), HELD_OUT))
    return curve_chart(title, "steps" if x == "step" else x, lines, log=key == "loss")


# ---------------------------------------------------------------- tables


def _report_view_table(run: ReportedRun) -> str:
    entries = read_reported_view_numbers(run)
    if not entries:
        return ""
    rows = []
    for entry in entries:
        psnr, ssim = (
            format_decimal(metric_from_json(entry, "psnr"), 3),
            format_decimal(metric_from_json(entry, "ssim"), 5),
        )
        seconds = format_decimal(as_reported_number(entry.get("seconds")), 3)
        rows.append(page.table_row(escape(entry.get("name")), (psnr, ssim, seconds)))
    table = page.number_table(("view", "PSNR, dB", "SSIM", "render, s"), rows)
    return report_folded(f"All {format_report_count(len(entries))} held-out views", table)


def _report_settings_section(run: ReportedRun) -> str:
    changed = run.field("non_default")
    if not isinstance(changed, Mapping):
        body = report_note(f"{MISSING} not recorded")
    elif not changed:
        body = report_note("All settings are at their defaults.")
    else:
        rows = []
        for key, pair in changed.items():
            default, value = pair if isinstance(pair, list | tuple) and len(pair) == 2 else (None, pair)
            first, second = (f"<code>{escape(page.format_report_setting(v))}</code>" for v in (default, value))
            rows.append(page.table_row(escape(key), (f'<td class="default">{first}</td>', second)))
        body = page.number_table(("setting", "default", "this run"), rows, "")
    return section("Settings changed from their defaults", body)


def _report_facts(run: ReportedRun) -> str:
    keys = ("split", "data_source", "color_space", "channels", "downsampling", "background", "seed", "iterations")
    pairs = [(key.replace("_", " "), run.field(key)) for key in (*keys, "checkpoint", "backend", "device")]
    pairs = [
        (key, ", ".join(map(str, value)) if key == "channels" and isinstance(value, list) else value)
        for key, value in pairs
    ]
    versions, made_by = run.field("versions"), run.field("made_by")
    pairs += versions.items() if isinstance(versions, Mapping) else [("versions", None)]
    if isinstance(made_by, Mapping):
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


def _report_config(run: ReportedRun) -> str:
    if run.config_text is None:
        return report_note("There is no config.yaml in this run directory.")
    return report_folded("Full configuration", f"<pre><code>{escape(run.config_text)}</code></pre>")

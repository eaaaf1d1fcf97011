"""The parts of the page, each from a run's record to HTML. A part without content is empty and leaves no gap."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from neuprim.core.conditions import flag
from neuprim.core.metrics import from_json
from neuprim.core.model.fields import ConditionSpec
from neuprim.report.curves import curve, dots, series
from neuprim.report.pictures import ERROR_SCALE, Inlined, color_bar, inline
from neuprim.report.record import RunRecord, ViewFiles, number, per_view
from neuprim.report.text import MISSING, byte_size, count, decimal, duration, escape, setting

__all__ = [
    "banner",
    "charts",
    "commands",
    "config",
    "facts",
    "films",
    "headline",
    "heading",
    "held_out",
    "regions",
    "settings",
    "view_table",
    "viewer",
]

MAX_VIEWS = 24
"""Held-out views shown as pictures; of more, evenly spaced ones."""

WORST_SHOWN = 12
"""Worst regions that are shown unfolded."""

PIXELATED_BELOW = 256
"""Pictures narrower than this many pixels are enlarged with hard pixel edges."""

SOURCES = {
    "real": None,
    "generated": ("generated data", "ray-cast scenes of our own, not photographs"),
    "simulated": ("simulated data", "a stand-in for data that was not given"),
}


def heading(run: RunRecord) -> str:
    """Task and scene, and a badge unless the data is real."""
    task, scene = run.name_of("task"), run.name_of("scene")
    html = f'<p class="eyebrow">{escape(task)}</p>\n<h1>{escape(scene)}</h1>'
    source = run.field("data_source")
    note: tuple[str, str] | None
    if source is None:
        note = ("data source not recorded", "real, generated or simulated is not known")
    else:
        note = SOURCES.get(str(source), (str(source), "not photographs or captures"))
        drawn = run.field("rendered_from")
        if note is not None and drawn is not None:
            note = note[0], f"rendered from {drawn}, not photographs"
    if note is not None:
        html += f'\n<p class="badge"><strong>{escape(note[0])}</strong> <span>{escape(note[1])}</span></p>'
    return html


def banner(run: RunRecord) -> str:
    """What is not as it should be: no final metrics, unreadable log lines, views worse than nothing."""
    notes = []
    if not run.finished:
        last = run.last("step")
        where = (
            "No step was logged." if last is None else f"The last logged step is {count(last[1])}{_of_iterations(run)}."
        )
        notes.append(
            f"<strong>This run has not finished.</strong> There is no metrics.json yet: it is still going, or it was interrupted. {where}"
        )
    if run.unreadable_lines:
        lines = "1 line" if run.unreadable_lines == 1 else f"{run.unreadable_lines} lines"
        notes.append(
            f"{lines} of metrics.jsonl could not be read and {'is' if run.unreadable_lines == 1 else 'are'} left out of the curves."
        )
    bad = run.field("worse_than_black_image")
    if isinstance(bad, list) and bad:
        views = "1 view is" if len(bad) == 1 else f"{count(len(bad))} views are"
        notes.append(
            f"<strong>{views} worse than a black image</strong>, which the mean hides: {escape(', '.join(map(str, bad)))}."
        )
    return "".join(f'<p class="banner" role="status">{note}</p>' for note in notes)


def headline(run: RunRecord) -> str:
    """The numbers in large type (final, or the last logged ones of an unfinished run), beside the orbit if it was
    rendered."""
    tiles = _final_tiles(run) if run.finished else _interim_tiles(run)
    cells = (
        f'<div class="tile{" lead" if i == 0 else ""}"><dt>{label}</dt><dd>{value}{f"<small>{unit}</small>" if unit else ""}</dd>'
        f'<dd class="note">{note}</dd></div>'
        for i, (label, value, unit, note) in enumerate(tiles)
    )
    html = f'<dl class="tiles">{"".join(cells)}</dl>'
    if run.finished:
        kept = run.field("checkpoint")
        rule = (
            "Metrics of the last checkpoint, not the best."
            if kept in (None, "last")
            else f"Metrics of checkpoint “{escape(kept)}”."
        )
        html += f'<p class="rule">{rule}</p>'
    if run.orbit is not None:
        caption = "camera orbit" + (f"; shown: {escape(run.shown)}" if run.shown else "")
        picture = _figure(inline(run.orbit), caption, "camera orbit around the scene", exists=True)
        html = f'<div class="with-orbit"><div>{html}</div><div class="orbit">{picture}</div></div>'
    return html


def viewer(page: str, linked: str) -> str:
    """The model to turn: a page in this page, or a link to one."""
    if page:
        what = "Drag to turn, wheel to zoom, Shift and drag to move."
        return f"""<section><h2>The model</h2>
<iframe title="the model, drawn by this browser" loading="lazy" srcdoc="{escape(page)}"></iframe><p class="rule">{what}</p></section>"""
    if linked:
        return f'<section><h2>The model</h2><p><a href="{escape(linked)}">{escape(linked)}</a> draws it, to be turned by hand.</p></section>'
    return ""


Tile = tuple[str, str, str, str]


def _final_tiles(run: RunRecord) -> list[Tile]:
    metrics = run.metrics or {}
    mean, worst, similarity = (from_json(metrics, key) for key in ("psnr", "psnr_worst", "ssim"))
    size, size_unit = byte_size(metrics.get("model_bytes"))
    each, iterations, backend = (metrics.get(key) for key in ("parameters_per_primitive", "iterations", "backend"))
    views, name = len(per_view(run)), _worst_name(run)
    split = escape(metrics.get("split") or "held-out")
    fps = number(metrics.get("render_fps"))
    return [
        (
            "PSNR, mean",
            decimal(mean, 2),
            _unit("dB", mean),
            f"{count(views)} {split} view{'s' if views != 1 else ''}" if views else "",
        ),
        ("PSNR, worst view", decimal(worst, 2), _unit("dB", worst), escape(name) if name else ""),
        *(
            [("Empty views", count(metrics["views_empty"]), "", "the model is not in them")]
            if metrics.get("views_empty")
            else []
        ),
        ("SSIM", decimal(similarity, 4), "", "" if similarity is None else "mean over views" + _padded(metrics)),
        *_lpips_tile(metrics),
        *_masked_tile(metrics),
        *_volume_tiles(metrics),
        ("Primitives", count(metrics.get("primitives")), "", ""),
        ("Parameters", count(metrics.get("parameters")), "", "" if each is None else f"{count(each)} per primitive"),
        ("Model size", size, size_unit, ""),
        (
            "Training",
            duration(metrics.get("train_seconds")),
            "",
            "" if iterations is None else f"{count(iterations)} iterations",
        ),
        (
            "Rendering",
            decimal(fps, 1 if fps is None or fps < 100 else 0),
            _unit("fps", fps),
            escape(backend) if backend else "",
        ),
    ]


def _padded(metrics: Mapping[str, object]) -> str:
    """SSIM as other tools count it, for a note."""
    value = from_json(metrics, "ssim_3dgs")
    return "" if value is None else f"; as displayed, by 3DGS’s rule: {decimal(value, 4)}"


def _lpips_tile(metrics: Mapping[str, object]) -> list[Tile]:
    value, why = from_json(metrics, "lpips"), metrics.get("not_measured")
    if value is not None:
        rule = from_json(metrics, "lpips_3dgs")
        more = "" if rule is None else f"; by 3DGS’s rule: {decimal(rule, 4)}"
        return [("LPIPS", decimal(value, 4), "", f"{escape(metrics.get('lpips_network'))}, mean over views{more}")]
    reason = why.get("lpips") if isinstance(why, Mapping) else None
    return [] if reason is None else [("LPIPS", MISSING, "", f"not measured: {escape(reason)}")]


def _masked_tile(metrics: Mapping[str, object]) -> list[Tile]:
    inside, black = from_json(metrics, "psnr_mask"), from_json(metrics, "psnr_black_image_mask")
    if inside is None:
        return []
    note = (
        "where anything ever is" if black is None else f"where anything ever is; a black image: {decimal(black, 1)} dB"
    )
    return [("PSNR inside the mask", decimal(inside, 2), _unit("dB", inside), note)]


def _volume_tiles(metrics: Mapping[str, object]) -> list[Tile]:
    """The largest error of extinctions that are known, over the compared frames."""
    tiles: list[Tile] = []
    for key, frames in metrics.items():
        known = (
            isinstance(frames, list) and key.endswith("_frames") and all(isinstance(frame, Mapping) for frame in frames)
        )
        errors = [value for frame in frames if (value := from_json(frame, "max_error")) is not None] if known else []  # type: ignore[attr-defined]
        if errors:
            what = "extinction" if key == "sigma_frames" else escape(key.removesuffix("_frames"))
            tiles.append(
                (
                    f"Largest error of {what}",
                    decimal(100 * max(errors), 0),
                    "%",
                    "of the frame’s largest value, on the files’ voxels",
                )
            )
    return tiles


def _unit(unit: str, value: float | None) -> str:
    return "" if value is None else unit


def _interim_tiles(run: RunRecord) -> list[Tile]:
    def tile(label: str, key: str, digits: int | None, unit: str = "") -> Tile:
        last = run.last(key)
        if last is None:
            return label, MISSING, "", "not logged yet"
        value = count(last[1]) if digits is None else decimal(last[1], digits)
        return label, value, unit, f"at step {count(last[0])}"

    seconds = run.last("seconds")
    return [
        tile("PSNR, held-out", "eval_psnr", 2, "dB"),
        tile("PSNR, training view", "psnr", 2, "dB"),
        tile("Loss", "loss", 4),
        tile("Primitives", "primitives", None),
        ("Training", duration(seconds[1] if seconds else None), "", "so far" if seconds else "not logged yet"),
    ]


def _of_iterations(run: RunRecord) -> str:
    train = run.config.get("train")
    total = number(train.get("iterations")) if isinstance(train, Mapping) else None
    return "" if total is None else f" of {count(total)}"


def _worst_name(run: RunRecord) -> str | None:
    known = [(value, entry.get("name")) for entry in per_view(run) if (value := from_json(entry, "psnr")) is not None]
    name = min(known, key=lambda pair: pair[0])[1] if known else None
    return None if name is None else str(name)


def films(run: RunRecord) -> str:
    """Held-out cameras over time, ground truth on the left and render on the right."""
    figures = []
    for path in run.clips:
        name = escape(path.stem.removeprefix("clip_"))
        figures.append(
            _figure(
                inline(path),
                f"{name}: ground truth, render",
                f"film of {name}, ground truth beside render",
                exists=True,
            )
        )
    return _section("Held-out films", f'{_shown(run)}<div class="films">{"".join(figures)}</div>') if figures else ""


def _shown(run: RunRecord) -> str:
    """A line that says what pictures show of the channels, where these are more than a picture is made of anyway."""
    return f'<p class="note">Shown: {escape(run.shown)}.</p>' if run.shown else ""


def held_out(run: RunRecord) -> str:
    """Each shown view: render, truth and error map with its numbers; the colour bar once."""
    if not run.views:
        return ""
    shown = run.views
    if len(shown) > MAX_VIEWS:
        shown = [shown[round(i * (len(shown) - 1) / (MAX_VIEWS - 1))] for i in range(MAX_VIEWS)]
    pictures = [(view, [_picture(view, kind) for kind in ("render", "truth", "error")]) for view in shown]
    notes = []
    if len(shown) < len(run.views):
        notes.append(f"{len(shown)} of {len(run.views)} views, evenly spaced.")
    if any(p is not None and p.compressed for _, row in pictures for p in row):
        notes.append(
            "Large pictures are compressed on this page (WebP, quality 90); the PNG files in renders/ are exact."
        )
    ticks = "".join(f"<span>{'≥ ' if i == 4 else ''}{ERROR_SCALE * i / 4:g}</span>" for i in range(5))
    bar = (
        f'<div class="scale"><p>Error: mean absolute difference over {"all " if run.shown else ""}channels</p><div class="bar" style="background: {color_bar()}"></div>'
        f'<div class="ticks">{ticks}</div></div>'
    )
    rows = "".join(_view_row(run, view, row) for view, row in pictures)
    note = f'<p class="note">{" ".join(notes)}</p>' if notes else ""
    return _section("Held-out views", f"{_shown(run)}{bar}{rows}{note}")


def regions(run: RunRecord) -> str:
    """Of every held-out view the square that came out worst, the worst first, folded after the first dozen."""
    figures = []
    for one in run.regions:
        caption = f"<b>{decimal(one.psnr, 1)}</b> dB in {escape(one.place)} of {escape(one.name)}"
        figures.append(
            _figure(
                inline(one.path),
                caption,
                f"worst region of view {escape(one.name)}: ground truth, render, error",
                exists=True,
            )
        )
    if not figures:
        return ""
    note = '<p class="note">Of every view the square of a quarter of its shorter side with the largest error: ground truth, render, error.</p>'
    first, rest = figures[:WORST_SHOWN], figures[WORST_SHOWN:]
    body = f'{note}<div class="regions">{"".join(first)}</div>'
    if rest:
        body += (
            f'<details><summary>{count(len(rest))} more</summary><div class="regions">{"".join(rest)}</div></details>'
        )
    return _section("Worst regions", body)


def _picture(view: ViewFiles, kind: str) -> Inlined | None:
    path = {"render": view.render, "truth": view.truth, "error": view.error}[kind]
    return None if path is None else inline(path)


def _view_row(run: RunRecord, view: ViewFiles, row: list[Inlined | None]) -> str:
    entry = run.view_numbers(view)
    name = escape(entry.get("name") or view.stem or view.index)
    files = (view.render, view.truth, view.error)
    captions = ("render", "ground truth", "error")
    figures = "".join(
        _figure(picture, caption, f"{caption} of view {name}", file is not None)
        for picture, caption, file in zip(row, captions, files, strict=True)
    )
    numbers = f"<span><b>{decimal(from_json(entry, 'psnr'), 2)}</b> dB PSNR</span><span><b>{decimal(from_json(entry, 'ssim'), 4)}</b> SSIM</span>"
    if number(entry.get("seconds")) is not None:
        numbers += f"<span><b>{decimal(number(entry['seconds']), 3)}</b> s to render</span>"
    return f'<article class="view"><header><h3>{name}</h3><p>{numbers}</p></header>{figures}</article>'


def _figure(picture: Inlined | None, caption: str, alternative: str, exists: bool) -> str:
    """A captioned picture; ``alternative`` is HTML already."""
    if picture is None:
        return f'<figure><div class="absent">{"file damaged" if exists else "no picture"}</div><figcaption>{caption}</figcaption></figure>'
    pixelated = ' class="pixelated"' if picture.width < PIXELATED_BELOW else ""
    return (
        f'<figure><img src="{picture.url}" width="{picture.width}" height="{picture.height}" alt="{alternative}"{pixelated}>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def charts(run: RunRecord) -> str:
    """PSNR and loss over time and steps, primitives over time, PSNR per view."""
    seconds, steps = "seconds", "step"
    table: Iterable[tuple[str, str | None]] = (
        (
            "PSNR over time, dB",
            curve(series(run, seconds, "psnr"), series(run, seconds, "eval_psnr"), seconds, "PSNR over time"),
        ),
        ("Loss over time", curve(series(run, seconds, "loss"), None, seconds, "Loss over time", log=True)),
        ("Primitives over time", curve(series(run, seconds, "primitives"), None, seconds, "Primitives over time")),
        (
            "PSNR over steps, dB",
            curve(series(run, steps, "psnr"), series(run, steps, "eval_psnr"), steps, "PSNR over steps"),
        ),
        ("Loss over steps", curve(series(run, steps, "loss"), None, steps, "Loss over steps", log=True)),
        ("PSNR per view, dB <small>dashed: mean</small>", _view_dots(run)),
        ("PSNR over the frames of a film, dB", _frames(run)),
    )
    panels = "".join(
        f'<figure class="panel"><figcaption>{title}</figcaption>{svg}</figure>' for title, svg in table if svg
    )
    if not panels:
        return ""
    key = '<p class="key"><span class="training">training views</span><span class="held-out">held-out views</span></p>'
    return _section("Curves", f'{key}<div class="panels">{panels}</div>')


def _view_dots(run: RunRecord) -> str | None:
    values = [from_json(entry, "psnr") for entry in per_view(run)]
    return dots(values, from_json(run.metrics or {}, "psnr"), _worst_name(run), "PSNR per view")


def _frames(run: RunRecord) -> str | None:
    entries = run.field("per_frame")
    if not isinstance(entries, list):
        return None
    values = [from_json(e, "psnr") if isinstance(e, Mapping) else None for e in entries]
    pairs = [(float(i), v) for i, v in enumerate(values) if v is not None and math.isfinite(v)]
    table = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    empty = np.zeros(0)
    return curve((empty, empty), (table[:, 0], table[:, 1]), "frame", "PSNR over frames")


def view_table(run: RunRecord) -> str:
    """Every held-out view's numbers, folded."""
    entries = per_view(run)
    if not entries:
        return ""
    rows = "".join(
        f"<tr><td>{count(i)}</td><th scope=row>{escape(e.get('name'))}</th><td>{decimal(from_json(e, 'psnr'), 3)}</td>"
        f"<td>{decimal(from_json(e, 'ssim'), 5)}</td><td>{decimal(number(e.get('seconds')), 3)}</td></tr>"
        for i, e in enumerate(entries)
    )
    head = "<tr><th>#</th><th>view</th><th>PSNR, dB</th><th>SSIM</th><th>render, s</th></tr>"
    table = f'<div class="scroll"><table class="numbers"><thead>{head}</thead><tbody>{rows}</tbody></table></div>'
    return f"<details><summary>All {count(len(entries))} held-out views</summary>{table}</details>"


def settings(run: RunRecord) -> str:
    """Every setting that is not at its default."""
    changed = run.field("non_default")
    if not isinstance(changed, Mapping):
        body = f'<p class="note">{MISSING} not recorded</p>'
    elif not changed:
        body = '<p class="note">All settings are at their defaults.</p>'
    else:
        rows = "".join(f"<tr><th scope=row>{escape(key)}</th>{_change(pair)}</tr>" for key, pair in changed.items())
        body = f'<div class="scroll"><table><thead><tr><th>setting</th><th>default</th><th>this run</th></tr></thead><tbody>{rows}</tbody></table></div>'
    return _section("Settings that differ from their defaults", body)


def _change(pair: object) -> str:
    default, value = pair if isinstance(pair, list | tuple) and len(pair) == 2 else (None, pair)
    cells = (escape(setting(v)) for v in (default, value))
    return '<td class="default"><code>{}</code></td><td><code>{}</code></td>'.format(*cells)


def facts(run: RunRecord) -> str:
    """Where the numbers come from: split, data, machine, versions."""
    keys = (
        "split",
        "data_source",
        "color_space",
        "downsampling",
        "background",
        "seed",
        "iterations",
        "checkpoint",
        "backend",
        "device",
    )
    pairs = [(key.replace("_", " ").replace("color", "colour"), escape(run.field(key))) for key in keys]
    channels = run.field("channels")
    pairs.insert(3, ("channels", escape(", ".join(map(str, channels)) if isinstance(channels, list) else channels)))
    versions = run.field("versions")
    if isinstance(versions, Mapping):
        pairs += [(escape(name), escape(value)) for name, value in versions.items()]
    else:
        pairs.append(("versions", MISSING))
    made_by = run.field("made_by")
    if isinstance(made_by, Mapping):
        pairs += [
            (f"{escape(kind)} made by", escape(made_by[kind])) for kind in ("task", "scene", "loss") if kind in made_by
        ]
    return _section(
        "Run", '<dl class="facts">' + "".join(f"<div><dt>{k}</dt><dd>{v}</dd></div>" for k, v in pairs) + "</dl>"
    )


def commands(run: RunRecord, conditions: Sequence[ConditionSpec]) -> str:
    """The commands that go on from here: what every run can do, and an animation of each of the task's conditions that
    has one."""
    folder = shlex.quote(str(run.run_dir))
    lines = [
        (f"neuprim eval {folder}", "measure again"),
        (f"neuprim render {folder} --camera orbit", "fly around the scene"),
    ]
    for spec in conditions:
        if spec.sweep:
            changing = f"fly around it while the {escape(spec.name.replace('_', ' '))} changes"
            lines.append(
                (f"neuprim render {folder} --camera orbit {flag(spec.name)} {shlex.quote(spec.sweep)}", changing)
            )
    items = "".join(f"<li><code>{escape(line)}</code><span>{what}</span></li>" for line, what in lines)
    return _section("Go on", f'<ul class="commands">{items}</ul>')


def config(run: RunRecord) -> str:
    """The resolved configuration, folded."""
    if run.config_text is None:
        return '<p class="note">There is no config.yaml in this run directory.</p>'
    return f"<details><summary>Full configuration</summary><pre><code>{escape(run.config_text)}</code></pre></details>"


def _section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>\n"

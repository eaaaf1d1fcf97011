"""The one template of all report pages, the elements they are made of, and values as text.

Every page stands alone: pictures and charts are part of the file, and its content policy forbids loading anything.
Every function that takes a text from a file or a user escapes it, unless it says that it takes HTML.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

from torch import Tensor

from neuprim.report.charts import Chart, draw_svg
from neuprim.report.pictures import inline_picture
from neuprim.report.run_record import as_reported_number

MISSING = "–"

Tile = tuple[str, str, str]  # label, value and note of a number in large type, as HTML


def render_page(title: str, sections: Iterable[str], kind: str = "", policy: str = "", script: str = "") -> str:
    """Return a whole page.

    Args:
        title: title of the browser's tab.
        sections: HTML, in their order; empty ones leave no gap.
        kind: class of the page's body; ``compared`` for pages that compare runs.
        policy: appended to the content policy.
        script: HTML of a script, which ``policy`` must allow.
    """
    template = Template(files("neuprim.report").joinpath("page.html").read_text(encoding="utf-8"))
    body = "\n".join(filter(None, sections))
    return template.substitute(title=escape(title), body=body, kind=kind, policy=policy, script=script)


def inline_script(name: str) -> tuple[str, str]:
    """Return a script of this package as HTML, and the source that the content policy must list to allow it."""
    text = files("neuprim.report").joinpath(name).read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return f"<script>{text}</script>", f"'sha256-{digest}'"


# ---------------------------------------------------------------- elements


def section(title: str, body: str) -> str:
    """Return HTML under a heading; "" where there is none."""
    return f"<section><h2>{title}</h2>{body}</section>\n" if body else ""


def report_note(text: str) -> str:
    """Return a paragraph of explanation; takes HTML."""
    return f'<p class="note">{text}</p>'


def report_folded(title: str, body: str) -> str:
    """Return HTML that opens with a click."""
    return f"<details><summary>{title}</summary>{body}</details>"


def masthead(eyebrow: str, title: str, badge: str = "", more: str = "") -> str:
    """Return the head of a page: a small line, its heading, a marked note ("" for none), and more HTML."""
    head = f'<p class="eyebrow">{escape(eyebrow)}</p>\n<h1>{escape(title)}</h1>'
    mark = f'\n<p class="badge">{escape(badge)}</p>' if badge else ""
    return f'<header class="masthead"><div>{head}{mark}{more}</div></header>'


def report_banner(notes: Iterable[str]) -> str:
    """Return a banner with warnings; takes HTML."""
    return "".join(f'<p class="banner" role="status">{text}</p>' for text in notes)


def report_tiles(items: Iterable[Tile]) -> str:
    """Return numbers in large type."""
    cells = "".join(
        f'<div class="tile"><dt>{label}</dt><dd>{value}</dd><dd class="note" title="{text}">{text}</dd></div>'
        for label, value, text in items
    )
    return f'<dl class="tiles">{cells}</dl>'


def figure(source: Path | Tensor, caption: str, alternative: str, attributes: str = "") -> str:
    """Return a picture with its caption; a box with a note where its file is missing or damaged.

    Args:
        source: a file, or an (H, W, 3) image.
        caption, alternative, attributes: HTML.
    """
    under = f"<figcaption>{caption}</figcaption>" if caption else ""
    shown = inline_picture(source) if isinstance(source, Tensor) or source.is_file() else None
    if shown is None:
        return f'<figure{attributes}><div class="absent">no picture</div>{under}</figure>'
    size = f'width="{shown.width}" height="{shown.height}"'
    return f'<figure{attributes}><img src="{shown.url}" {size} alt="{alternative}">{under}</figure>'


def chart_panels(charts: Iterable[tuple[str, Chart]], kind: str = "panels") -> str:
    """Return charts with their captions, HTML; those without points are left out."""
    panels = [
        f'<figure class="panel"><figcaption>{caption}</figcaption>{drawn}</figure>'
        for caption, chart in charts
        if (drawn := draw_svg(chart)) is not None
    ]
    return f'<div class="{kind}">{"".join(panels)}</div>' if panels else ""


def number_table(head: Iterable[str], rows: Iterable[str], kind: str = "numbers") -> str:
    """Return a table of HTML rows under titles, as HTML."""
    titles = "".join(title if title.startswith("<th") else f"<th>{title}</th>" for title in head)
    table = f'<table class="{kind}"><thead><tr>{titles}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
    return f'<div class="scroll">{table}</div>'


def table_row(name: str, cells: Iterable[str], attributes: str = "") -> str:
    """Return a row of a table: its heading and its cells, as HTML."""
    body = "".join(cell if cell.startswith("<td") else f"<td>{cell}</td>" for cell in cells)
    return f"<tr{attributes}><th scope=row>{name}</th>{body}</tr>"


def command_line(text: str, purpose: str = "") -> str:
    """Return a command with a copy button, which appears where scripts run, and what the command is for."""
    button = '<button type="button" class="copy" hidden>Copy</button>'
    return f"<code>{escape(text)}</code>{button}" + (f"<span>{escape(purpose)}</span>" if purpose else "")


def fact_list(pairs: Iterable[tuple[str, object]]) -> str:
    """Return names and values, both as text."""
    cells = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="facts">{cells}</dl>'


# ---------------------------------------------------------------- values as text


def escape(value: object) -> str:
    """Return ``value`` as HTML text that is also safe inside a quoted attribute."""
    return MISSING if value is None or value == "" else html.escape(format_report_setting(value), quote=True)


def format_report_setting(value: object) -> str:
    """Write a setting as users type it: ``true``, ``null``, ``0.001``, ``[1, 2]``; strings bare. Not escaped."""
    if isinstance(value, str):
        return value
    if value is None or isinstance(value, bool | int | float | Sequence | Mapping):
        return json.dumps(value, ensure_ascii=False, default=str)
    return str(value)


def format_decimal(value: float | None, digits: int, unit: str = "") -> str:
    """Write a fixed number of decimals and a unit; the infinity sign for infinite values."""
    if value is None:
        return MISSING
    text = f"{value:,.{digits}f}" if math.isfinite(value) else ("∞" if value > 0 else "−∞")
    return f"{text} {unit}" if unit else text


def format_report_count(value: object) -> str:
    """Write a whole number with thousands separated; other numbers with up to two decimals."""
    found = as_reported_number(value)
    if found is None:
        return MISSING
    return f"{round(found):,}" if found == round(found) else f"{found:,.2f}"


def format_report_bytes(value: object) -> str:
    """Write a size in bytes, in powers of 1000."""
    found = as_reported_number(value)
    if found is None:
        return MISSING
    for unit in ("B", "kB", "MB"):
        if abs(found) < 1000:
            return f"{found:.3g} {unit}"
        found /= 1000
    return f"{found:,.2f} GB"


def format_report_duration(seconds: object) -> str:
    """Write ``8.3 s``, ``4 min 07 s`` or ``2 h 05 min``."""
    found = as_reported_number(seconds)
    if found is None:
        return MISSING
    if found < 59.95:
        return f"{found:.1f} s"
    minutes, rest = divmod(round(found), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"

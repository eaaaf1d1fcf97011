"""The template of all report pages, the HTML elements in them, and functions that format values.

Every page is one file: it embeds its pictures and charts, and its content security policy forbids loading other files.
Every function escapes its text arguments, unless its docstring says that these arguments are HTML.
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

from neuprim.core.io.json_reader import finite_json_number
from neuprim.report.charts import Chart, draw_svg
from neuprim.report.pictures import inline_picture

MISSING = "–"

Tile = tuple[str, str, str]  # label, value and note of a number in large type, as HTML


def render_page(title: str, sections: Iterable[str], kind: str = "", policy: str = "", script: str = "") -> str:
    """Return the HTML text of a complete report page.

    Args:
        title: title of the browser's tab.
        sections: HTML of the sections, in order; empty sections leave no gap.
        kind: CSS class of the page's body; ``compared`` for pages that compare runs.
        policy: text to append to the page's content security policy.
        script: HTML of a script, which ``policy`` must allow.
    """
    template = Template(files("neuprim.report").joinpath("page.html").read_text(encoding="utf-8"))
    body = "\n".join(filter(None, sections))
    return template.substitute(title=escape(title), body=body, kind=kind, policy=policy, script=script)


def inline_script(name: str) -> tuple[str, str]:
    """Return a script of this package as HTML, and the source that the content policy must list to allow the script."""
    text = files("neuprim.report").joinpath(name).read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return f"<script>{text}</script>", f"'sha256-{digest}'"


# ---------------------------------------------------------------- elements


def section(title: str, body: str) -> str:
    """Return a section under a heading; "" if ``body`` is empty. Both arguments are HTML."""
    return f"<section><h2>{title}</h2>{body}</section>\n" if body else ""


def report_note(text: str) -> str:
    """Return a paragraph of explanation as HTML; ``text`` is HTML."""
    return f'<p class="note">{text}</p>'


def report_folded(title: str, body: str) -> str:
    """Return a collapsed section, which opens with a click. Both arguments are HTML."""
    return f"<details><summary>{title}</summary>{body}</details>"


def masthead(eyebrow: str, title: str, badge: str = "", more: str = "") -> str:
    """Return the head of a page: a small line above the title, a badge ("" for none), and ``more``, which is HTML."""
    head = f'<p class="eyebrow">{escape(eyebrow)}</p>\n<h1>{escape(title)}</h1>'
    mark = f'\n<p class="badge">{escape(badge)}</p>' if badge else ""
    return f'<header class="masthead"><div>{head}{mark}{more}</div></header>'


def report_banner(notes: Iterable[str]) -> str:
    """Return a banner with the warnings ``notes``, as HTML. The warnings are HTML, too."""
    return "".join(f'<p class="banner" role="status">{text}</p>' for text in notes)


def report_tiles(items: Iterable[Tile]) -> str:
    """Return tiles with key numbers in large type, as HTML. An item is (label, number, note)."""
    cells = "".join(
        f'<div class="tile"><dt>{label}</dt><dd>{value}</dd><dd class="note" title="{text}">{text}</dd></div>'
        for label, value, text in items
    )
    return f'<dl class="tiles">{cells}</dl>'


def figure(source: Path | Tensor, caption: str, alternative: str, attributes: str = "") -> str:
    """Return a picture with its caption as HTML; a box with a message if the file is missing or damaged.

    Args:
        source: a picture file, or an (H, W, 3) image.
        caption, alternative: the text below the picture, and the ``alt`` text of the picture, both as HTML.
        attributes: HTML attributes of the ``<figure>`` element.
    """
    under = f"<figcaption>{caption}</figcaption>" if caption else ""
    shown = inline_picture(source) if isinstance(source, Tensor) or source.is_file() else None
    if shown is None:
        return f'<figure{attributes}><div class="absent">no picture</div>{under}</figure>'
    size = f'width="{shown.width}" height="{shown.height}"'
    return f'<figure{attributes}><img src="{shown.url}" {size} alt="{alternative}">{under}</figure>'


def chart_panels(charts: Iterable[tuple[str, Chart]], kind: str = "panels") -> str:
    """Return HTML of CSS class ``kind`` with (caption, chart) pairs. Captions are HTML; empty charts are left out."""
    panels = [
        f'<figure class="panel"><figcaption>{caption}</figcaption>{drawn}</figure>'
        for caption, chart in charts
        if (drawn := draw_svg(chart)) is not None
    ]
    return f'<div class="{kind}">{"".join(panels)}</div>' if panels else ""


def number_table(head: Iterable[str], rows: Iterable[str], kind: str = "numbers") -> str:
    """Return a table of CSS class ``kind`` as HTML. Column titles (``head``) and rows (:func:`table_row`) are HTML."""
    titles = "".join(title if title.startswith("<th") else f"<th>{title}</th>" for title in head)
    table = f'<table class="{kind}"><thead><tr>{titles}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
    return f'<div class="scroll">{table}</div>'


def table_row(name: str, cells: Iterable[str], attributes: str = "") -> str:
    """Return a table row as HTML. Its heading ``name``, its cells and the attributes of its element are HTML."""
    body = "".join(cell if cell.startswith("<td") else f"<td>{cell}</td>" for cell in cells)
    return f"<tr{attributes}><th scope=row>{name}</th>{body}</tr>"


def command_line(text: str, purpose: str = "") -> str:
    """Return a command line as HTML, with the purpose of the command, and a copy button if scripts run."""
    button = '<button type="button" class="copy" hidden>Copy</button>'
    return f"<code>{escape(text)}</code>{button}" + (f"<span>{escape(purpose)}</span>" if purpose else "")


def fact_list(pairs: Iterable[tuple[str, object]]) -> str:
    """Return a list of names and values as HTML; both are text."""
    cells = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="facts">{cells}</dl>'


# ---------------------------------------------------------------- values as text


def escape(value: object) -> str:
    """Return ``value`` as HTML text that is also safe inside a quoted attribute; a dash for None or an empty text."""
    return MISSING if value is None or value == "" else html.escape(format_report_setting(value), quote=True)


def format_report_setting(value: object) -> str:
    """Format a setting as users type it: ``true``, ``null``, ``0.001``, ``[1, 2]``, text. HTML is not escaped."""
    if isinstance(value, str):
        return value
    if value is None or isinstance(value, bool | int | float | Sequence | Mapping):
        return json.dumps(value, ensure_ascii=False, default=str)
    return str(value)


def format_decimal(value: float | None, digits: int, unit: str = "") -> str:
    """Format a number with ``digits`` decimals and a unit; infinite values as the infinity sign."""
    if value is None:
        return MISSING
    text = f"{value:,.{digits}f}" if math.isfinite(value) else ("∞" if value > 0 else "−∞")
    return f"{text} {unit}" if unit else text


def format_report_count(value: object) -> str:
    """Format a whole number with thousands separators; other numbers with up to two decimals."""
    found = finite_json_number(value)
    if found is None:
        return MISSING
    return f"{round(found):,}" if found == round(found) else f"{found:,.2f}"


def format_report_bytes(value: object) -> str:
    """Format a size in bytes with a unit, in powers of 1000."""
    found = finite_json_number(value)
    if found is None:
        return MISSING
    for unit in ("B", "kB", "MB"):
        if abs(found) < 1000:
            return f"{found:.3g} {unit}"
        found /= 1000
    return f"{found:,.2f} GB"


def format_report_duration(seconds: object) -> str:
    """Format a duration as ``8.3 s``, ``4 min 07 s`` or ``2 h 05 min``."""
    found = finite_json_number(seconds)
    if found is None:
        return MISSING
    if found < 59.95:
        return f"{found:.1f} s"
    minutes, rest = divmod(round(found), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"

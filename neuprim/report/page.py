"""The page: sections put into the template, written so that a reader never sees half of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template

from neuprim.core.io.files import write_text
from neuprim.core.model.fields import ConditionSpec
from neuprim.report import sections
from neuprim.report.record import RunRecord, read_run
from neuprim.report.text import escape

__all__ = ["LIMIT", "Viewer", "render_page", "style", "write_report"]

LIMIT = 4_000_000
"""Bytes of a report with a viewer in it; of a larger one the viewer is a page beside it."""

_BESIDE = "viewer.html"


@dataclass(frozen=True)
class Viewer:
    """A page that draws the model, and the nonce of its scripts, which this page's own policy must let through."""

    text: str
    nonce: str


def write_report(run_dir: Path, conditions: Sequence[ConditionSpec] = (), viewer: Viewer | None = None) -> Path:
    """Write ``report.html`` into a run directory, finished or not, and return its path.

    ``conditions`` are those of the run's task; the commands that the page offers animate them. ``viewer`` becomes a
    part of the page, or where both would have more than :data:`LIMIT` bytes, ``viewer.html`` beside it.

    The page needs nothing else: pictures and charts are part of the file, and its content policy forbids loading
    anything. An earlier report is replaced only once the new one is complete.

    Raises:
        DataError: the directory is no run, or its ``config.yaml`` or ``metrics.json`` is damaged.
    """
    run_dir = Path(run_dir)
    run, beside, target = read_run(run_dir), run_dir / _BESIDE, run_dir / "report.html"
    page = render_page(run, conditions, viewer)
    if viewer is not None and len(page.encode()) > LIMIT:
        write_text(beside, viewer.text)
        page = render_page(run, conditions, linked=_BESIDE)
    else:
        beside.unlink(missing_ok=True)  # of an earlier report
    write_text(target, page)
    return target


def render_page(
    run: RunRecord, conditions: Sequence[ConditionSpec] = (), viewer: Viewer | None = None, linked: str = ""
) -> str:
    """The report as HTML text, with a viewer in it or a link to one."""
    template = Template(files("neuprim.report").joinpath("template.html").read_text(encoding="utf-8"))
    names = [name for name in (run.name_of("task"), run.name_of("scene")) if name]
    return template.substitute(
        title=escape(" / ".join(names) or run.run_dir.name),
        scripts="" if viewer is None else f"; script-src 'nonce-{viewer.nonce}'; worker-src blob:",
        heading=sections.heading(run),
        banner=sections.banner(run),
        headline=sections.headline(run),
        viewer=sections.viewer("" if viewer is None else viewer.text, linked),
        films=sections.films(run),
        held_out=sections.held_out(run),
        regions=sections.regions(run),
        charts=sections.charts(run),
        view_table=sections.view_table(run),
        settings=sections.settings(run),
        facts=sections.facts(run),
        commands=sections.commands(run, conditions),
        config=sections.config(run),
    )


def style() -> str:
    """The style sheet of a run's report, for other pages."""
    text = files("neuprim.report").joinpath("template.html").read_text(encoding="utf-8")
    return text.partition("<style>")[2].partition("</style>")[0]

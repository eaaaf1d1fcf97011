"""The page: sections put into the template, written so that a reader never sees half of it."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

from neuprim.core.io.files import write_text
from neuprim.core.model.fields import ConditionSpec
from neuprim.report import sections
from neuprim.report.record import RunRecord, read_run
from neuprim.report.text import escape

__all__ = ["render_page", "write_report"]


def write_report(run_dir: Path, conditions: Sequence[ConditionSpec] = ()) -> Path:
    """Write ``report.html`` into a run directory, finished or not, and return its path.

    ``conditions`` are those of the run's task; the commands that the page offers animate them.

    The page needs nothing beside it: pictures and charts are part of the file, and its content policy forbids loading anything. An
    earlier report is replaced only once the new one is complete.

    Raises:
        DataError: the directory is no run, or its ``config.yaml`` or ``metrics.json`` is damaged.
    """
    run_dir = Path(run_dir)
    page = render_page(read_run(run_dir), conditions)
    target = run_dir / "report.html"
    write_text(target, page)
    return target


def render_page(run: RunRecord, conditions: Sequence[ConditionSpec] = ()) -> str:
    """The report as HTML text."""
    template = Template(files("neuprim.report").joinpath("template.html").read_text(encoding="utf-8"))
    names = [name for name in (run.name_of("task"), run.name_of("scene")) if name]
    return template.substitute(
        title=escape(" / ".join(names) or run.run_dir.name),
        heading=sections.heading(run),
        banner=sections.banner(run),
        headline=sections.headline(run),
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

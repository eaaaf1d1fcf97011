"""Pictures of the front's points, of one view."""

from __future__ import annotations

from neuprim.report.tradeoff import Picture
from neuprim.runs.render_config import parse_render_config
from neuprim.search.tradeoff.measure import Models
from neuprim.search.tradeoff.record import Record
from neuprim.search.tradeoff.subject import Subject
from neuprim.search.truths import masked

__all__ = ["pictures"]


def pictures(subject: Subject, record: Record, models: Models) -> dict[int, Picture]:
    """Number of a point -> what it shows of the view that has most to show, and of the truth under -1; both as
    displayed."""
    truth = max(subject.truths, key=lambda one: float(subject.channels.display(one.image).var()))
    wanted = subject.channels.display(truth.image).clamp(0.0, 1.0)
    found = {-1: Picture(wanted, None)}
    base = None
    for number in dict.fromkeys((0, *record.speed, *record.size)):
        point = parse_render_config(record.points[number].words, subject.config.renderer, subject.model)
        image = masked(point.render_view(models.of(point), truth.view, subject.background), truth)
        shown = subject.channels.display(image).clamp(0.0, 1.0)
        base = shown if base is None else base
        found[number] = Picture(shown, None if number == 0 else base)
    return found

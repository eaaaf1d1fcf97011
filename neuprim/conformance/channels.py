"""Checks of colours on data that are not RGB."""

from __future__ import annotations

from neuprim.conformance.subject import Subject
from neuprim.core.errors import FormError, NeuprimError
from neuprim.core.render import render

__all__ = ["check_channels"]

_COUNTS = (1, 5)


def check_channels(t: Subject) -> None:
    """A colour made for grey images has one channel and for five bands five, or ``build`` refuses them: data need not
    be RGB."""
    if t.task.example is not None or t.task.channels:
        # the first alone knows what data of other channels would look like, the others are the only ones there are
        return
    subjects, declared = {}, {}
    for count in _COUNTS:
        other = t.with_channels(count)
        try:
            declared[count] = other.fields()[1].channels
        except (NeuprimError, ValueError):  # refused
            continue
        subjects[count] = other
    if len(declared) == len(_COUNTS) and len(set(declared.values())) == 1:
        return  # a fixed number, which the renderer holds against every background
    for count, other in subjects.items():
        data = f"with data of {count} channel{'s' * (count > 1)}"
        t.require(declared[count] == count, f"colour.channels {data}", declared[count], str(count))
        model, view = other.model(), other.views()[0]
        try:
            render(model, view.camera, view.conditions, other.settings.renderer)
        except FormError as error:
            raise FormError(f"{data}: {error}") from error
        trainer = other.trainer(2)
        for _ in trainer.run():
            pass

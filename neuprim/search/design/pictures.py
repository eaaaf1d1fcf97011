"""Pictures of the models on the fronts, of one view."""

from __future__ import annotations

from collections.abc import Sequence

from neuprim.core.channels import Channels
from neuprim.report.tradeoff import Picture
from neuprim.search.design.record import Model
from neuprim.search.design.side_by_side import SideBySide
from neuprim.search.truths import masked

__all__ = ["pictures"]


def pictures(measured: SideBySide, models: Sequence[Model], numbers: Sequence[int]) -> dict[int, Picture]:
    """Number of a model -> what it shows of the view that has most to show, with the truth that it is compared with;
    and the truth under -1; all as displayed."""
    channels: Channels = measured.subject(measured.folder / models[0].run_dir)[0].channels
    truth = max(measured.truths, key=lambda one: float(channels.display(one.image).var()))
    wanted = channels.display(truth.image).clamp(0.0, 1.0)
    found = {-1: Picture(wanted, None)}
    for number in dict.fromkeys((0, *numbers)):
        image = masked(measured.ready(models[number])(truth.view), truth)
        found[number] = Picture(channels.display(image).clamp(0.0, 1.0), wanted)
    return found

"""The check of a task's layers."""

from __future__ import annotations

import torch

from neuprim.conformance.subject import ConformanceError, Subject
from neuprim.core.layers import LayerFrame
from neuprim.plugins.judging import TaskFault, layer_of

__all__ = ["check_layers"]


def check_layers(t: Subject) -> None:
    """Every layer that the task names is drawn of its example: finite floats of the declared channels, the same each
    time, the model left as it is."""
    model, settings = t.model(torch.float32), t.settings.renderer
    before = {name: value.clone() for name, value in model.params.items()}
    for spec in t.task.layers:
        for view in t.views():
            try:
                one, two = (
                    layer_of(
                        spec,
                        LayerFrame(model, view.camera, view.conditions, settings, t.dataset.color_space),
                        t.dataset.channels,
                    )
                    for _ in range(2)
                )
            except TaskFault as error:  # it says what was found and what was expected
                raise ConformanceError(f"task {t.task.name!r}: {t.check}: view {view.name}: {error}") from error
            same = one is None if two is None else one is not None and torch.equal(one, two)
            t.require(same, f"layer {spec.name!r} of view {view.name}", "other values the second time", "the same")
    changed = [name for name, value in model.params.items() if not torch.equal(value, before[name])]
    t.require(not changed, "layers", f"parameters {', '.join(changed)} changed", "the model as it was")

"""Record frames as CUDA graphs, and replay a graph when a model is rendered again by a camera with the same intrinsics.

The arrays of a recorded frame have fixed sizes. If a frame does not fit, or has numbers that are not finite, the
renderer renders the frame again without the recording. This second rendering enlarges the arrays, or raises an error
that names the cause.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.graphs import GraphRecorder
from neuprim.core.model.fields import Conditions, Constant
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.cuda.backend import frame_counts, render
from neuprim.core.render.cuda.binning import FrameCapacity
from neuprim.core.render.output import RenderOutput
from neuprim.core.settings import RenderSettings

_MOST_PROGRAMS = 4


@dataclass
class _Program:
    """A recorded frame: the tensors of its inputs, its result, and the function that replays the frame."""

    viewmat: Tensor
    background: Tensor | None
    conditions: dict[str, Tensor]
    run: Callable[[], None] = lambda: None
    output: RenderOutput | None = None


class FrameRecorder:
    """Recorder of one model's frames as CUDA graphs.

    If a parameter moves to other memory, the recorder discards its recordings.

    Attributes:
        replayed: number of frames that were replayed.
    """

    def __init__(self, where: torch.device) -> None:
        self.replayed = 0
        self._refused = torch.zeros(1, dtype=torch.int32, device=where)
        self._capacity: FrameCapacity | None = None
        self._graphs = GraphRecorder(where, "frames")
        self._programs: dict[Any, _Program | None] = {}  # None: seen once
        self._memory: tuple[Any, ...] = ()
        self._turn = threading.Lock()

    def render(
        self, model: Primitives, camera: Camera, conditions: Conditions, settings: RenderSettings,
        background: Tensor | None,
    ) -> RenderOutput | None:  # fmt: skip
        """Return a replayed frame; if the result is None, the caller must render the frame and call :meth:`observe`.

        A frame is recorded when its intrinsics, settings and shapes repeat and :meth:`observe` has set the array sizes.
        """
        with self._turn:
            memory = tuple((value.data_ptr(), value.shape) for value in model.params.values())
            if memory != self._memory:
                self._discard_programs()
                self._memory = memory
            lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
            stages = (model.density.stage, model.colour.stage)
            given = {"view": camera.viewmat, "background": background, **conditions}
            shapes = tuple((name, None if x is None else (x.dtype, x.shape)) for name, x in given.items())
            key = (lens, stages, shapes, settings)
            program = self._programs.get(key)
            if program is None and key in self._programs and self._capacity is not None:
                if len(self._programs) > _MOST_PROGRAMS:
                    self._discard_programs()
                program = self._programs[key] = self._make_program(model, camera, conditions, settings, background)
            if program is None or self._graphs.failed:
                self._programs.setdefault(key, None)
                return None
            program.viewmat.copy_(camera.viewmat, non_blocking=True)
            if program.background is not None and background is not None:
                program.background.copy_(background, non_blocking=True)
            for name, value in program.conditions.items():
                value.copy_(conditions[name], non_blocking=True)
            program.run()
            if self._graphs.failed or program.output is None:
                return None
            if int(self._refused):
                self._refused.zero_()
                return None
            self.replayed += 1
            made = program.output
            depth = None if made.depth is None else made.depth.clone()
            return replace(made, rgb=made.rgb.clone(), alpha=made.alpha.clone(), depth=depth)

    def observe(self, output: RenderOutput) -> None:
        """Read the counts of a frame that was not replayed; enlarge the arrays if a count exceeds their capacity."""
        with self._turn:
            counts = frame_counts(output.stats)
            if self._capacity is not None and self._capacity.fits(counts):
                return
            self._capacity = FrameCapacity.around(counts, self._refused, zeros=True, least=self._capacity)
            self._discard_programs()

    def _discard_programs(self) -> None:
        self._programs.clear()
        self._graphs.clear()

    def _make_program(
        self, model: Primitives, camera: Camera, conditions: Conditions, settings: RenderSettings,
        background: Tensor | None,
    ) -> _Program:  # fmt: skip
        where = self._refused.device
        viewmat = torch.empty(4, 4, dtype=camera.viewmat.dtype, device=where)
        behind = None if background is None else torch.empty_like(background, device=where)
        held = {name: torch.empty_like(value, device=where) for name, value in conditions.items()}
        program, capacity = _Program(viewmat, behind, held), self._capacity
        own = replace(camera, viewmat=viewmat)
        reference = weakref.ref(model)  # the recorder lives as long as its model

        def draw() -> None:
            drawn = reference()
            assert drawn is not None
            with torch.no_grad():
                lowered = drawn.lower(own, held, settings)
                assert isinstance(lowered.colour, Constant) and lowered.shade is None, "a field without stage"
                program.output = render(lowered, own, behind, settings, capacity)

        program.run = self._graphs.record(draw)
        return program


_recorders: weakref.WeakKeyDictionary[Primitives, FrameRecorder] = weakref.WeakKeyDictionary()


def frame_recorder(model: Primitives) -> FrameRecorder:
    """Return the recorder of a model's frames; the first call creates it."""
    if model not in _recorders:
        _recorders[model] = FrameRecorder(model.device)
    return _recorders[model]


def can_record_frame(model: Primitives, camera: Any, settings: RenderSettings) -> bool:
    """Return whether frames of a model on a GPU can be recorded with this camera and these settings."""
    fields = model.density.stage is not None and model.colour.stage is not None
    plain = settings.sort == "center" and settings.samples == 1 and settings.near != "auto"
    return fields and plain and isinstance(camera, Camera) and not torch.is_grad_enabled() and model.count > 0

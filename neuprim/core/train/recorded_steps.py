"""Training steps as CUDA graphs: the launches of a step are recorded once and replayed, and the host does not wait.

The arrays of a recorded step have fixed sizes (:class:`~neuprim.core.render.cuda.binning.FrameCapacity`). A step that
does not fit, or whose numbers are not finite, sets a flag on the device; then it and all recorded steps after it change
nothing. The host reads the flags a few steps later, and repeats such steps one by one, with larger arrays afterwards.
So results are the bits of steps that are not recorded.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.graphs import GraphRecorder
from neuprim.core.data import Pixels, PointSamples, View
from neuprim.core.model.fields import Constant
from neuprim.core.render import backends
from neuprim.core.render.output import Contributions, RenderOutput, RenderStats

from neuprim.core.train.step_results import StepReport, ViewTask, summarize_numbers

if TYPE_CHECKING:
    from neuprim.core.render.cuda.binning import FrameCapacity
    from neuprim.core.train.trainer import Trainer

_IN_FLIGHT = 16
"""Most recorded steps that the device has not finished when the host prepares another one."""

_MARGIN, _SPARE = 1.5, 256
"""Factor and addend from the largest counts seen to the sizes of the arrays."""

_MOST_PROGRAMS = 16
"""Most recordings kept; a recording is for one size of image and one set of intrinsics."""


def recording_fault(trainer: Trainer) -> str | None:
    """Return why steps of a training cannot be recorded; None if they can."""
    model, settings, renderer = trainer.current_model, trainer.settings, trainer.renderer
    if trainer.device.type != device.CUDA:
        return "the model is not on a GPU"
    if [b.name for b in backends.candidate_backends(renderer, trainer.device.type)][:1] != ["cuda"]:
        return "the renderer is not the cuda backend"
    if renderer.sort != "center" or renderer.samples != 1:
        return "renderer.sort and renderer.samples are not center and 1"
    if settings.views_per_step != 1 or trainer.exposures is not None or trainer.corrections is not None:
        return "a step has several views, exposures or corrections"
    if model.density.stage is None or model.colour.stage is None or not getattr(trainer.loss, "recordable", False):
        return "a field or the loss may compute something else in every step"
    return None


class _Key(NamedTuple):
    """What a recording depends on besides the numbers in its inputs."""

    intrinsics: tuple[float, ...]
    size: tuple[int, int]
    shapes: tuple[Any, ...]  # of pixels, conditions and points
    stages: tuple[Any, ...]


@dataclass
class _Inputs:
    """The inputs of a step on the device: those of a recording are always in the same memory."""

    view: View
    pixels: Pixels
    samples: PointSamples | None
    numbers: Tensor  # float64: view matrix, background, learning rates, scales of the points

    def tensors(self) -> list[Tensor]:
        """Return all tensors but ``numbers``."""
        found = [self.pixels.rgb, self.pixels.alpha, self.pixels.mask, *self.view.conditions.values()]
        if self.samples is not None:
            found += [*self.samples.conditions.values(), self.samples.points, self.samples.sigma, self.samples.source]
            found += [value for value, _ in self.samples.components.values()]
        return [x for x in found if x is not None]


@dataclass
class _Program:
    """A recorded step: its inputs, its results and the function that runs it."""

    inputs: _Inputs
    run: Callable[[], None] = lambda: None
    numbers: Tensor | None = None  # float64: refused, then those of RenderedView.numbers
    parts: tuple[str, ...] = ()


class _Flight(NamedTuple):
    """A recorded step whose results the host has not read yet."""

    step: int
    progress: float
    task: ViewTask
    samples: PointSamples | None
    report: StepReport
    parts: tuple[str, ...]
    memory: tuple[Tensor, Tensor]  # of the host: numbers given, numbers found
    event: Any


class StepRecorder:
    """Records and replays the steps of one trainer; on the CPU, for tests, it runs the same steps again.

    Attributes:
        capacity: sizes of the arrays; None until a step that was not recorded gave the counts.
        replayed: number of steps that were replayed.
        repeated: number of replayed steps that were refused, or came after one, and were taken again.
    """

    def __init__(self, trainer: Trainer) -> None:
        self.trainer, self.replayed, self.repeated = trainer, 0, 0
        self.capacity: FrameCapacity | None = None
        self._on_gpu = trainer.device.type == device.CUDA
        self._refused = torch.zeros(1, dtype=torch.int32, device=trainer.device)
        self._counts = (0, 0, 0, 0)
        self._programs: dict[_Key, _Program] = {}
        self._seen: Counter[_Key] = Counter()
        self._sums: tuple[Tensor | None, ...] = ()
        self._flights: deque[_Flight] = deque()
        self._memory: list[tuple[Tensor, Tensor]] = []
        self._graphs = GraphRecorder(trainer.device, "training steps")

    # ------------------------------------------------------------ what the trainer calls

    def reset(self) -> None:
        """Forget all recordings, because tensors were replaced; there must be no unread results."""
        assert not self._flights, "settle() comes first"
        self._programs.clear()
        self._seen.clear()

    def observe_counts(self, stats: RenderStats) -> None:
        """Note the counts of a frame that was not recorded, and enlarge the arrays if it would not have fitted."""
        from neuprim.core.render.cuda.backend import frame_counts
        from neuprim.core.render.cuda.binning import FrameCapacity

        counts = frame_counts(stats)
        if self.capacity is not None and self.capacity.fits(counts):
            return
        self._counts = tuple(max(pair) for pair in zip(counts, self._counts, strict=True))  # type: ignore[assignment]
        sizes = [int(_MARGIN * count) + _SPARE for count in self._counts]
        self.capacity = FrameCapacity(*sizes, self._refused)
        self.reset()

    def take(self, tasks: list[ViewTask], samples: PointSamples | None, progress: float) -> StepReport | None:
        """Replay one step; None if it must be taken by the trainer itself, because nothing is recorded for it yet."""
        trainer, sums = self.trainer, self.trainer.population.sums()
        if self._graphs.failed or self.capacity is None or trainer.fake_quantize is not None or trainer.zero_masks:
            return None
        if not tasks or any(x is None for x in sums):
            return None
        if any(x is not y for x, y in zip_longest(sums, self._sums)):
            trainer.settle()
            self.reset()
            self._sums = sums
        trainer.settle(_IN_FLIGHT - 1)
        (task,) = tasks
        view, pixels = trainer.load_view(task)
        program = self._find_program(view, pixels, samples)
        if program is None:
            return None
        given, found = memory = self._memory.pop() if self._memory else self._allocate()
        scales = [] if samples is None else [samples.sigma_scale, samples.source_scale]
        scales += [] if samples is None else [scale for _, scale in samples.components.values()]
        rates = trainer.rates(progress).values()
        values = [*view.camera.viewmat.double().reshape(-1).tolist(), *task.background.tolist(), *rates, *scales]
        given.numpy()[: len(values)] = values
        program.inputs.numbers.copy_(given[: len(values)], non_blocking=True)
        for own, new in zip(program.inputs.tensors(), _Inputs(view, pixels, samples, given).tensors(), strict=True):
            own.copy_(new.pin_memory() if self._on_gpu and new.is_cpu else new, non_blocking=True)
        program.run()
        if self._graphs.failed or program.numbers is None:
            self._memory.append(memory)
            return None
        found[: len(program.numbers)].copy_(program.numbers, non_blocking=True)
        event = torch.cuda.current_stream(trainer.device).record_event() if self._on_gpu else None
        report = trainer.pending_report(view.name)
        self._flights.append(_Flight(trainer.step, progress, task, samples, report, program.parts, memory, event))
        self.replayed += 1
        return report

    def settle(self, keep: int = 0) -> list[_Flight]:
        """Read the results of replayed steps but the last ``keep``; return those that must be taken again, in order."""
        while len(self._flights) > keep:
            first = self._flights[0]
            if first.event is not None:
                first.event.synchronize()
            _, found = first.memory
            refused, *numbers = found.tolist()
            if refused:
                self._refused.zero_()
                again = list(self._flights)
                self._flights.clear()
                self._memory += [flight.memory for flight in again]
                self.repeated += len(again)
                return again
            self._flights.popleft()
            self._memory.append(first.memory)
            first.report.resolve(*summarize_numbers(numbers, first.parts))
        return []

    def _allocate(self) -> tuple[Tensor, Tensor]:
        size = 64 + len(self.trainer.current_model.specs) + self.trainer.dataset.channels
        given, found = (torch.zeros(size, dtype=torch.float64, pin_memory=self._on_gpu) for _ in range(2))
        return given, found

    # ------------------------------------------------------------ recording

    def _find_program(self, view: View, pixels: Pixels, samples: PointSamples | None) -> _Program | None:
        model, camera, trainer = self.trainer.current_model, view.camera, self.trainer
        shapes = [pixels.alpha is not None, pixels.mask is not None, *view.conditions]
        if samples is not None:
            shapes += [samples.points.shape, samples.source is not None, *samples.conditions, *samples.components]
        key = _Key(
            (camera.fx, camera.fy, camera.cx, camera.cy),
            (camera.width, camera.height),
            tuple(shapes),
            (model.density.stage, model.colour.stage, trainer.has_anisotropy_loss, trainer.limits_size),
        )
        program = self._programs.get(key)
        if program is None:
            self._seen[key] += 1
            if self._seen[key] < 2:  # a recording takes as long as a step
                return None
            if len(self._programs) >= _MOST_PROGRAMS:
                self._programs.pop(next(iter(self._programs)))
            program = self._programs[key] = self._make_program(view, pixels, samples)
        return program

    def _make_program(self, view: View, pixels: Pixels, samples: PointSamples | None) -> _Program:
        """Return a program with tensors of its own for the inputs of such a step."""
        where, count = self.trainer.device, len(self.trainer.current_model.specs)
        channels = self.trainer.dataset.channels

        def like(value: Tensor | None) -> Tensor | None:
            return None if value is None else torch.empty_like(value, device=where)

        def like_all(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: torch.empty_like(value, device=where) for name, value in values.items()}

        numbers = torch.empty(64 + count + channels, dtype=torch.float64, device=where)
        scales = numbers[16 + channels + count :]
        own_samples = None
        if samples is not None:
            components = {
                name: (torch.empty_like(value, device=where), scales[2 + at])
                for at, (name, (value, _)) in enumerate(samples.components.items())
            }
            own_samples = replace(
                samples, conditions=like_all(samples.conditions), points=like(samples.points),
                sigma=like(samples.sigma), source=like(samples.source), sigma_scale=scales[0],
                source_scale=scales[1], components=components,
            )  # fmt: skip
            numbers = numbers[: 18 + channels + count + len(components)]
        else:
            numbers = numbers[: 16 + channels + count]
        camera = replace(view.camera, viewmat=numbers[:16].view(4, 4))
        own_pixels = Pixels(torch.empty_like(pixels.rgb, device=where), like(pixels.alpha), like(pixels.mask))
        inputs = _Inputs(View(view.name, camera, like_all(view.conditions)), own_pixels, own_samples, numbers)
        program = _Program(inputs)

        def take_step() -> None:
            program.numbers, program.parts = self._take_step(inputs)

        program.run = self._graphs.record(take_step)
        return program

    def _take_step(self, inputs: _Inputs) -> tuple[Tensor, tuple[str, ...]]:
        """Take a step on the device; return (refused, numbers...) and the names of the loss's parts."""
        trainer, model, params = self.trainer, self.trainer.current_model, self.trainer.current_model.params
        background, rates, _ = inputs.numbers[16:].float().tensor_split(
            [trainer.dataset.channels, trainer.dataset.channels + len(model.specs)]
        )
        # leaves of their own, as those of earlier steps may belong to another stream
        model.params = {name: value.detach().requires_grad_() for name, value in params.items()}
        try:
            rendered = trainer.compare_view(inputs.view, inputs.pixels, background, 0.0, self._draw)
            points = None if inputs.samples is None else trainer.compare_points(inputs.samples)
            loss = trainer.total_loss(rendered.loss / 1, points)
            torch.maximum(self._refused, (~loss.detach().isfinite()).int().reshape(1), out=self._refused)
            wanted = [value for value in model.params.values() if value.numel()]
            for value, grad in zip(wanted, torch.autograd.grad(loss, wanted, allow_unused=True), strict=True):
                value.grad = grad
            accepted = self._refused == 0
            weight, error = (torch.where(accepted, x, 0.0) for x in rendered.contributions.of_all(model.count))
            trainer.population.observe(model, Contributions(weight, error))
            trainer.optimizer.step_recorded(model.params, rates, self._refused)
            trainer.limit_model(trainer.limits_size, self._refused == 0)
        finally:
            model.params = params
        more = {} if points is None else points.parts
        numbers = rendered.numbers(loss, more.values())
        return torch.cat([self._refused.double(), numbers]), (*rendered.parts, *more)

    def _draw(self, view: View, background: Tensor) -> RenderOutput:
        from neuprim.core.render.cuda.backend import render

        lowered = self.trainer.current_model.lower(view.camera, view.conditions, self.trainer.renderer)
        assert isinstance(lowered.colour, Constant) and lowered.shade is None, "a field without stage"
        return render(lowered, view.camera, background, self.trainer.renderer, self.capacity)

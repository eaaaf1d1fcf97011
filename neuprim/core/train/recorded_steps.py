"""Training steps as CUDA graphs: a step's kernel launches are recorded once and replayed; the host does not wait.

The arrays of a recorded step have fixed sizes (:class:`~neuprim.core.render.cuda.binning.FrameCapacity`). A step that
does not fit into these arrays, or whose numbers are not finite, sets the flag "refused" on the GPU. Then this step and
all replayed steps after it change no parameter. The host reads the flag a few steps later. The host then takes these
steps again without recordings, and uses larger arrays afterwards. So the results have the same bits as without
recordings.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.graphs import GraphRecorder
from neuprim.core.data import Dataset, Pixels, PointSamples, View
from neuprim.core.model.fields import Constant
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, backends
from neuprim.core.render.output import Contributions, RenderOutput, RenderStats, sum_contributions
from neuprim.core.task import Loss
from neuprim.core.train.losses import PointLossResult
from neuprim.core.train.optimizer import RowAdam
from neuprim.core.train.population import Population
from neuprim.core.train.settings import TrainSettings
from neuprim.core.train.step_results import (
    StepReport,
    ViewResult,
    ViewTask,
    compare_view,
    name_views,
    summarize_numbers,
    summarize_views,
)
from neuprim.core.train.training_views import Exposures, ViewCorrections

if TYPE_CHECKING:
    from neuprim.core.render.cuda.binning import FrameCapacity

_IN_FLIGHT = 16
"""Largest number of replayed steps whose results the host has not read yet."""

_NUMBERS = 64
"""Space in the host tensors for the numbers that a step sends to the GPU or receives from it. Each view has this space
plus one number per channel; the points of a step have this space together."""

_MOST_PROGRAMS = 16
"""Largest number of recordings that are kept. Each image size and each set of intrinsics needs its own recording."""

_IDLE_STEPS = 128
"""Number of steps without use after which a new recording may replace an old one. With a smaller number, data with many
image sizes would record almost every step and replay none."""


class RecordableTrainer(Protocol):
    """The members of :class:`~neuprim.core.train.trainer.Trainer` that the recording of steps uses."""

    current_model: Primitives
    dataset: Dataset
    loss: Loss
    settings: TrainSettings
    renderer: RenderSettings
    device: torch.device
    population: Population
    optimizer: RowAdam
    exposures: Exposures | None
    corrections: ViewCorrections | None
    fake_quantize: Any
    zero_masks: dict[str, Tensor]
    step: int

    @property
    def limits_size(self) -> bool: ...
    @property
    def has_anisotropy_loss(self) -> bool: ...
    def rates(self, progress: float | None = None) -> dict[str, float]: ...
    def settle(self, keep: int = 0) -> None: ...
    def load_view(self, task: ViewTask) -> tuple[View, Pixels]: ...
    def compare_points(self, samples: PointSamples) -> PointLossResult: ...
    def total_loss(self, loss: Tensor | None, points: PointLossResult | None = None) -> Tensor: ...
    def limit_model(self, sizes: bool, when: Tensor | None = None) -> None: ...


def recording_fault(trainer: RecordableTrainer) -> str | None:
    """Return why the steps of a training cannot be recorded as CUDA graphs; None if they can."""
    model, renderer = trainer.current_model, trainer.renderer
    if trainer.device.type != device.CUDA:
        return "the model is not on a GPU"
    if [b.name for b in backends.candidate_backends(renderer, trainer.device.type)][:1] != ["cuda"]:
        return "the renderer is not the cuda backend"
    if renderer.sort != "center" or renderer.samples != 1:
        return "renderer.sort and renderer.samples are not center and 1"
    if trainer.exposures is not None or trainer.corrections is not None:
        return "the views have exposures or corrections"
    if model.density.stage is None or model.colour.stage is None or not getattr(trainer.loss, "recordable", False):
        return "a field or the loss may compute something else in every step"
    return None


@dataclass
class _Inputs:
    """The views and points that a step uses. In a recorded step, these tensors stay in the same memory."""

    views: list[tuple[View, Pixels]]
    samples: PointSamples | None

    def tensors(self) -> list[Tensor]:
        """Return all tensors of views and points, except the view matrices of cameras."""
        found: list[Tensor | None] = []
        for view, pixels in self.views:
            found += [pixels.rgb, pixels.alpha, pixels.mask, *view.conditions.values()]
        if self.samples is not None:
            found += [*self.samples.conditions.values(), self.samples.points, self.samples.sigma]
            found += [self.samples.source, self.samples.scattered]
            found += [value for value, _ in self.samples.components.values()]
        return [x for x in found if x is not None]

    def shapes(self) -> tuple[Any, ...]:
        """Return a key for the recordings: the cameras' intrinsics, the shapes, and which optional tensors exist."""
        found: list[Any] = [tuple(x.shape for x in self.tensors())]
        for view, pixels in self.views:
            camera = view.camera
            found += [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, *view.conditions]
            found += [pixels.alpha is not None, pixels.mask is not None]
        if self.samples is not None:
            found += [self.samples.source is not None, self.samples.scattered is not None]
            found += [*self.samples.conditions, *self.samples.components]
        return tuple(found)


@dataclass
class _Program:
    """A recorded step: its inputs, its results and the function that replays it."""

    inputs: _Inputs
    given: Tensor  # float64: for each view its matrix and background; learning rates; scales of the points
    run: Callable[[], None] = lambda: None
    used: int = 0  # last step that used the recording
    found: Tensor | None = None  # float64: the flag "refused", then RenderedView.numbers of each view
    parts: tuple[tuple[str, ...], ...] = ()  # names of the loss parts of each view


class _Flight(NamedTuple):
    """A replayed step whose results the host has not read yet."""

    step: int
    progress: float
    tasks: list[ViewTask]
    samples: PointSamples | None
    report: StepReport
    parts: tuple[tuple[str, ...], ...]
    memory: tuple[Tensor, Tensor]  # host tensors: numbers sent to the GPU, results
    event: Any


class StepRecorder:
    """Records and replays the steps of one trainer. On the CPU, for tests, a replay just runs the step again.

    Attributes:
        capacity: sizes of a recorded step's arrays; None until a step without recording showed which sizes are needed.
        replayed: number of steps that were replayed.
        repeated: number of replayed steps that were taken again, because the step or an earlier one was refused.
    """

    def __init__(self, trainer: RecordableTrainer) -> None:
        self.trainer, self.replayed, self.repeated = trainer, 0, 0
        self.capacity: FrameCapacity | None = None
        self._on_gpu = trainer.device.type == device.CUDA
        self._refused = torch.zeros(1, dtype=torch.int32, device=trainer.device)
        self._programs: dict[Any, _Program] = {}
        self._seen: Counter[Any] = Counter()
        self._sums: tuple[Tensor | None, ...] = ()
        self._flights: deque[_Flight] = deque()
        self._memory: list[tuple[Tensor, Tensor]] = []
        self._graphs = GraphRecorder(trainer.device, "training steps")

    # ------------------------------------------------------------ what the trainer calls

    def reset(self) -> None:
        """Discard all recordings, because tensors that they use were replaced.

        The results of all replayed steps must have been read before (:meth:`settle`).
        """
        assert not self._flights, "settle() comes first"
        self._seen.clear()
        self._discard_programs()

    def _discard_programs(self) -> None:
        self._programs.clear()
        self._graphs.clear()

    def observe_counts(self, stats: RenderStats) -> None:
        """Read the array sizes that an unrecorded frame needed.

        If a size exceeds :attr:`capacity`, enlarge the capacity and discard all recordings.
        """
        from neuprim.core.render.cuda.backend import frame_counts
        from neuprim.core.render.cuda.binning import FrameCapacity

        counts = frame_counts(stats)
        if self.capacity is not None and self.capacity.fits(counts):
            return
        self.capacity = FrameCapacity.around(counts, self._refused, zeros=False, least=self.capacity)
        self.reset()

    def take(self, tasks: list[ViewTask], samples: PointSamples | None, progress: float) -> StepReport | None:
        """Replay a step and return its report; return None if the trainer must take the step without a recording.

        ``samples`` are points with known extinction, or None. ``progress`` is the used fraction of the training budget.
        """
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
        inputs = _Inputs([trainer.load_view(task) for task in tasks], samples)
        program = self._find_program(inputs)
        if program is None:
            return None
        values = []
        for (view, _), task in zip(inputs.views, tasks, strict=True):
            values += [*view.camera.viewmat.double().reshape(-1).tolist(), *task.background.tolist()]
        values += trainer.rates(progress).values()
        if samples is not None:
            values += [samples.sigma_scale, samples.source_scale, samples.scattered_scale]
            values += [scale for _, scale in samples.components.values()]
        given, found = memory = self._memory.pop() if self._memory else self._allocate()
        given.numpy()[: len(values)] = values
        program.given.copy_(given[: len(values)], non_blocking=True)
        for own, new in zip(program.inputs.tensors(), inputs.tensors(), strict=True):
            own.copy_(new.pin_memory() if self._on_gpu and new.is_cpu else new, non_blocking=True)
        program.run()
        if self._graphs.failed or program.found is None:
            self._memory.append(memory)
            return None
        found[: len(program.found)].copy_(program.found, non_blocking=True)
        event = torch.cuda.current_stream(trainer.device).record_event() if self._on_gpu else None
        report = StepReport.pending(trainer.settle, view=name_views([view.name for view, _ in inputs.views]))
        self._flights.append(_Flight(trainer.step, progress, tasks, samples, report, program.parts, memory, event))
        self.replayed += 1
        return report

    def settle(self, keep: int = 0) -> list[_Flight]:
        """Read the results of all replayed steps except the last ``keep``, and write them into the steps' reports.

        If a step was refused, return this step and all later steps, which the trainer must repeat. Otherwise return [].
        """
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
            results = []
            for task, parts in zip(first.tasks, first.parts, strict=True):
                cost, named, psnr = summarize_numbers(numbers, parts)
                results.append(ViewResult(task.view, "", cost, psnr, named, None, None))
                numbers = numbers[3 + len(parts) :]
            first.report.resolve(*summarize_views(results))
        return []

    def _allocate(self) -> tuple[Tensor, Tensor]:
        """Return two host tensors: one for the numbers that a step sends to the GPU, one for the step's results."""
        views, channels = self.trainer.settings.views_per_step, self.trainer.dataset.channels
        size = views * (_NUMBERS + channels) + len(self.trainer.current_model.specs) + _NUMBERS
        given, found = (torch.zeros(size, dtype=torch.float64, pin_memory=self._on_gpu) for _ in range(2))
        return given, found

    # ------------------------------------------------------------ recording

    def _find_program(self, inputs: _Inputs) -> _Program | None:
        """Return the recording for inputs of these shapes.

        Return None if the shapes occur for the first time, or if there are too many recordings in use.
        """
        model, trainer, programs = self.trainer.current_model, self.trainer, self._programs
        stages = (model.density.stage, model.colour.stage, trainer.has_anisotropy_loss, trainer.limits_size)
        key = (stages, inputs.shapes())
        program = programs.get(key)
        if program is None:
            self._seen[key] += 1
            if self._seen[key] < 2:  # a recording takes as long as a step
                return None
            if len(programs) >= _MOST_PROGRAMS:
                oldest = min(programs, key=lambda key: programs[key].used)
                if trainer.step - programs[oldest].used < _IDLE_STEPS:
                    return None
                trainer.settle()
                self._discard_programs()
            program = programs[key] = self._make_program(inputs)
        program.used = trainer.step
        return program

    def _make_program(self, inputs: _Inputs) -> _Program:
        """Return a program (recorded step) with input tensors of its own, in the shapes of ``inputs``."""
        where, each = self.trainer.device, 16 + self.trainer.dataset.channels
        rates = each * len(inputs.views)
        scales = rates + len(self.trainer.current_model.specs)
        samples, size = inputs.samples, scales
        if samples is not None:
            size += 3 + len(samples.components)
        given = torch.empty(size, dtype=torch.float64, device=where)

        def like(value: Any) -> Any:
            return None if value is None else torch.empty_like(value, device=where)

        def like_all(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: like(value) for name, value in values.items()}

        views = []
        for at, (view, pixels) in enumerate(inputs.views):
            camera = replace(view.camera, viewmat=given[at * each :][:16].view(4, 4))
            own = Pixels(like(pixels.rgb), like(pixels.alpha), like(pixels.mask))
            views.append((View(view.name, camera, like_all(view.conditions)), own))
        if samples is not None:
            values = like_all({name: value for name, (value, _) in samples.components.items()})
            # numbers on the device take the place of floats
            names = ("sigma_scale", "source_scale", "scattered_scale")
            own_scales: dict[str, Any] = {name: given[scales + k] for k, name in enumerate(names)}
            own_scales["components"] = {
                name: (value, given[scales + 3 + k]) for k, (name, value) in enumerate(values.items())
            }
            samples = replace(
                samples, conditions=like_all(samples.conditions), points=like(samples.points),
                sigma=like(samples.sigma), source=like(samples.source), scattered=like(samples.scattered), **own_scales,
            )  # fmt: skip
        program = _Program(_Inputs(views, samples), given)

        def take_step() -> None:
            backgrounds = [given[at * each + 16 :][: each - 16].float() for at in range(len(views))]
            program.found, program.parts = self._take_step(program.inputs, backgrounds, given[rates:scales].float())

        program.run = self._graphs.record(take_step)
        return program

    def _take_step(
        self, inputs: _Inputs, backgrounds: list[Tensor], rates: Tensor
    ) -> tuple[Tensor, tuple[tuple[str, ...], ...]]:
        """Take a step on the device; return one tensor of results, and the names of the loss parts of each view.

        The tensor has the flag "refused" and then :meth:`RenderedView.numbers` of each view.
        """
        trainer, model, params = self.trainer, self.trainer.current_model, self.trainer.current_model.params
        # leaves of their own, as those of earlier steps may belong to another stream
        model.params = {name: value.detach().requires_grad_() for name, value in params.items()}
        wanted = [value for value in model.params.values() if value.numel()]
        numbers, parts, each = list[Tensor](), list[tuple[str, ...]](), list[Contributions]()
        try:
            for (view, pixels), background in zip(inputs.views, backgrounds, strict=True):
                rendered = compare_view(self._draw(view, background), trainer.loss, view, pixels, background)
                loss, points = rendered.loss / len(backgrounds), None
                if len(each) + 1 == len(backgrounds):
                    points = None if inputs.samples is None else trainer.compare_points(inputs.samples)
                    loss = trainer.total_loss(loss, points)
                torch.maximum(self._refused, (~loss.detach().isfinite()).int().reshape(1), out=self._refused)
                for value, grad in zip(wanted, torch.autograd.grad(loss, wanted, allow_unused=True), strict=True):
                    value.grad = grad if value.grad is None or grad is None else value.grad + grad
                more = {} if points is None else points.parts
                numbers.append(rendered.numbers(loss, more.values()))
                parts.append((*rendered.parts, *more))
                each.append(rendered.contributions)
            contributions = each[0] if len(each) == 1 else sum_contributions(each, model.count)
            accepted = self._refused == 0
            weight, error = (torch.where(accepted, x, 0.0) for x in contributions.of_all(model.count))
            trainer.population.observe(model, Contributions(weight, error))
            trainer.optimizer.step_recorded(model.params, rates, self._refused)
            trainer.limit_model(trainer.limits_size, self._refused == 0)
        finally:
            model.params = params
        return torch.cat([self._refused.double(), *numbers]), tuple(parts)

    def _draw(self, view: View, background: Tensor) -> RenderOutput:
        """Render a view into arrays of the fixed sizes ``capacity``."""
        from neuprim.core.render.cuda.backend import render

        lowered = self.trainer.current_model.lower(view.camera, view.conditions, self.trainer.renderer)
        assert isinstance(lowered.colour, Constant) and lowered.shade is None, "a field without stage"
        return render(lowered, view.camera, background, self.trainer.renderer, self.capacity)

"""Training steps as CUDA graphs: the launches of a step are recorded once and replayed, and the host does not wait.

The arrays of a recorded step have fixed sizes (:class:`~neuprim.core.render.cuda.binning.FrameCapacity`). A step that
does not fit, or whose numbers are not finite, sets a flag on the device; then it and all recorded steps after it change
nothing. The host reads the flags a few steps later, and repeats such steps one by one, with larger arrays afterwards.
So results are the bits of steps that are not recorded.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.data import Pixels, View
from neuprim.core.errors import warn_once
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
    alpha: bool
    mask: bool
    conditions: tuple[str, ...]
    stages: tuple[Any, ...]


@dataclass
class _Program:
    """A recorded step: its inputs, its results and the function that runs it."""

    packed: Tensor  # (16 + C + P,) float64: view matrix, background, learning rates
    pixels: Pixels
    conditions: dict[str, Tensor]
    run: Callable[[], None]
    numbers: Tensor | None = None  # float64: refused, then those of RenderedView.numbers
    parts: tuple[str, ...] = ()


class _Flight(NamedTuple):
    """A recorded step whose results the host has not read yet."""

    step: int
    progress: float
    task: ViewTask
    report: StepReport
    parts: tuple[str, ...]
    host: Tensor
    event: Any


class StepRecorder:
    """Records and replays the steps of one trainer; on the CPU, for tests, it runs the same steps again.

    Attributes:
        capacity: sizes of the arrays; None until a step that was not recorded gave the counts.
        replayed: number of steps that were replayed.
        repeated: number of replayed steps that were refused, or came after one, and were taken again.
    """

    def __init__(self, trainer: Trainer) -> None:
        self.trainer, self.capacity, self.replayed, self.repeated = trainer, None, 0, 0
        self.capacity: FrameCapacity | None
        self._on_gpu = trainer.device.type == device.CUDA
        self._refused = torch.zeros(1, dtype=torch.int32, device=trainer.device)
        self._counts = (0, 0, 0, 0)
        self._programs: dict[_Key, _Program] = {}
        self._seen: Counter[_Key] = Counter()
        self._flights: deque[_Flight] = deque()
        self._hosts: list[Tensor] = []
        self._tried = self._failed = False
        self._stream = torch.cuda.Stream(trainer.device) if self._on_gpu else None
        self._pool = torch.cuda.graph_pool_handle() if self._on_gpu else None

    # ------------------------------------------------------------ what the trainer calls

    def reset(self) -> None:
        """Forget all recordings, because the tensors of the model were replaced; there must be no unread results."""
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

    def take(self, task: ViewTask, progress: float) -> StepReport | None:
        """Replay one step; None if it must be taken by the trainer itself, because nothing is recorded for it yet."""
        trainer = self.trainer
        if self._failed or self.capacity is None or trainer.fake_quantize is not None or trainer.zero_masks:
            return None
        if trainer.max_screen_size is not None and trainer.step % trainer.max_screen_size.every == 0:
            return None
        if len(self._flights) >= _IN_FLIGHT:
            first = self._flights[0]
            if first.event is not None:
                first.event.synchronize()
            if first.host[0] != 0:
                trainer.settle()
            else:
                self._read(self._flights.popleft())
        view, pixels = trainer.load_view(task)
        program = self._program(view, pixels)
        if program is None:
            return None
        values = [*view.camera.viewmat.double().reshape(-1).tolist(), *task.background.tolist()]
        packed = torch.tensor([*values, *trainer.rates(progress).values()], dtype=torch.float64)
        program.packed.copy_(packed.pin_memory() if self._on_gpu else packed, non_blocking=True)
        for own, given in zip(_tensors(program.pixels), _tensors(pixels), strict=True):
            own.copy_(given)
        for name, value in program.conditions.items():
            given = view.conditions[name]
            value.copy_(given.pin_memory() if self._on_gpu and given.is_cpu else given, non_blocking=True)
        program.run()
        if self._failed or program.numbers is None:
            return None
        host = self._hosts.pop() if self._hosts else torch.empty(16, dtype=torch.float64, pin_memory=self._on_gpu)
        host[: len(program.numbers)].copy_(program.numbers, non_blocking=True)
        event = torch.cuda.current_stream(trainer.device).record_event() if self._on_gpu else None
        report = trainer.pending_report(view.name)
        self._flights.append(_Flight(trainer.step, progress, task, report, program.parts, host, event))
        self.replayed += 1
        return report

    def settle(self) -> list[_Flight]:
        """Read the results of all replayed steps; return those that must be taken again, in order."""
        while self._flights:
            first = self._flights[0]
            if first.event is not None:
                first.event.synchronize()
            if first.host[0] != 0:
                self._refused.zero_()
                again = list(self._flights)
                self._flights.clear()
                self._hosts += [flight.host for flight in again]
                self.repeated += len(again)
                return again
            self._read(self._flights.popleft())
        return []

    def _read(self, flight: _Flight) -> None:
        numbers = flight.host[1:].tolist()
        self._hosts.append(flight.host)
        flight.report.resolve(*summarize_numbers(numbers, flight.parts))

    # ------------------------------------------------------------ recording

    def _program(self, view: View, pixels: Pixels) -> _Program | None:
        model, camera = self.trainer.current_model, view.camera
        key = _Key(
            (camera.fx, camera.fy, camera.cx, camera.cy),
            (camera.width, camera.height),
            pixels.alpha is not None,
            pixels.mask is not None,
            tuple(view.conditions),
            (model.density.stage, model.colour.stage, self.trainer.loss_stage),
        )
        program = self._programs.get(key)
        if program is None:
            self._seen[key] += 1
            if self._seen[key] < 2:  # a recording takes as long as a step
                return None
            if len(self._programs) >= _MOST_PROGRAMS:
                self._programs.pop(next(iter(self._programs)))
            program = self._programs[key] = self._record(view, pixels)
        return program

    def _record(self, view: View, pixels: Pixels) -> _Program:
        """Return a program whose first run takes a step directly (once per training) or records it, and replays it."""
        trainer = self.trainer
        where, channels = trainer.device, trainer.dataset.channels
        numbers = 16 + channels + len(trainer.current_model.specs)
        own = Pixels(*(None if x is None else torch.empty_like(x, device=where) for x in _fields(pixels)))  # type: ignore[arg-type]
        conditions = {name: torch.empty_like(value, device=where) for name, value in view.conditions.items()}
        packed = torch.empty(numbers, dtype=torch.float64, device=where)
        program = _Program(packed, own, conditions, lambda: None)
        camera = replace(view.camera, viewmat=packed[:16].view(4, 4))
        static = View(view.name, camera, conditions)

        def take_step() -> None:
            program.numbers, program.parts = self._take_step(static, own, packed[16:])

        def record() -> None:
            assert self._stream is not None
            if not self._tried:  # loads kernels, and finds operations that wait
                self._tried = True
                if not self._take_directly(take_step):
                    return
            else:
                graph = torch.cuda.CUDAGraph()
                self._stream.wait_stream(torch.cuda.current_stream(where))
                # "thread_local": another thread may be loading the next view
                with torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode="thread_local"):
                    take_step()
                program.run = graph.replay
                graph.replay()

        program.run = record if self._on_gpu else take_step
        return program

    def _take_directly(self, take_step: Callable[[], None]) -> bool:
        """Take a step without recording it; return whether no operation in it waits for the device."""
        stream, current = self._stream, torch.cuda.current_stream(self.trainer.device)
        assert stream is not None
        stream.wait_stream(current)
        mode = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("error")
        try:
            with torch.cuda.stream(stream):
                take_step()
        except RuntimeError as error:
            if "synchronizing" not in str(error):
                raise
            self._failed = True
            warn_once(f"training steps are not recorded as CUDA graphs, as one waits for the GPU: {error}")
        finally:
            torch.cuda.set_sync_debug_mode(mode)
            current.wait_stream(stream)
        return not self._failed

    def _take_step(self, view: View, pixels: Pixels, rest: Tensor) -> tuple[Tensor, tuple[str, ...]]:
        """Take a step on the device; return (refused, numbers...) and the names of the loss's parts."""
        trainer, model, params = self.trainer, self.trainer.current_model, self.trainer.current_model.params
        background, rates = rest[: trainer.dataset.channels].float(), rest[trainer.dataset.channels :].float()
        # leaves of their own, as those of earlier steps may belong to another stream
        model.params = {name: value.detach().requires_grad_() for name, value in params.items()}
        try:
            rendered = trainer.compare_view(view, pixels, background, 0.0, self._draw)
            loss = trainer.total_loss(rendered.loss / 1)
            torch.maximum(self._refused, (~loss.detach().isfinite()).int().reshape(1), out=self._refused)
            wanted = [value for value in model.params.values() if value.numel()]
            for value, grad in zip(wanted, torch.autograd.grad(loss, wanted, allow_unused=True), strict=True):
                value.grad = grad
            accepted = self._refused == 0
            weight, error = (torch.where(accepted, x, 0.0) for x in rendered.contributions.of_all(model.count))
            trainer.population.observe(model, Contributions(weight, error))
            trainer.optimizer.step_recorded(model.params, rates, self._refused)
            trainer.limit_model(self._refused == 0)
        finally:
            model.params = params
        return torch.cat([self._refused.double(), rendered.numbers(loss)]), tuple(rendered.parts)

    def _draw(self, view: View, background: Tensor) -> RenderOutput:
        from neuprim.core.render.cuda.backend import render

        lowered = self.trainer.current_model.lower(view.camera, view.conditions, self.trainer.renderer)
        assert isinstance(lowered.colour, Constant) and lowered.shade is None, "a field without stage"
        return render(lowered, view.camera, background, self.trainer.renderer, self.capacity)


def _fields(pixels: Pixels) -> tuple[Tensor | None, ...]:
    return pixels.rgb, pixels.alpha, pixels.mask


def _tensors(pixels: Pixels) -> list[Tensor]:
    return [x for x in _fields(pixels) if x is not None]

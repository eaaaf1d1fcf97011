"""The training loop of every task.

A step draws a training view, renders the view, compares the result with the view's image, runs the backward pass,
updates the parameters and applies population control. ``train.supervision`` can add points of known extinction to the
view, or use points alone. :meth:`Trainer.state` returns everything that affects the next step, so a resumed run gives
the same bits as an uninterrupted run.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.threads import limit_threads
from neuprim.core.data import Dataset, Pixels, PointSamples, View
from neuprim.core.data.dataset_check import check_point_samples
from neuprim.core.errors import DeviceMemoryError, NonFiniteError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.backends import best_render_backend_device
from neuprim.core.render.near_plane import near_plane_extent, resolve_near, typical_pixel_size
from neuprim.core.render.output import Contributions, sum_contributions
from neuprim.core.task import Loss
from neuprim.core.train.losses import MaxScreenSize, PointLossResult, point_loss, scale_anisotropy
from neuprim.core.train.optimizer import RowAdam
from neuprim.core.train.population import PopulationChange, make_population
from neuprim.core.train.recorded_steps import StepRecorder, recording_fault
from neuprim.core.train.settings import TrainSettings
from neuprim.core.train.step_results import (
    RenderedView,
    StepReport,
    ViewResult,
    ViewTask,
    compare_view,
    name_views,
    summarize_numbers,
    summarize_views,
)
from neuprim.core.train.trainer_state import check_state, check_training_settings, select_state_tensors
from neuprim.core.train.training_views import (
    GPU_LAUNCHES,
    Exposures,
    PixelLoader,
    PixelStride,
    ViewCorrections,
    choose_stride,
    count_covered_pixels,
    draw_stride,
    hash_training_views,
)

__all__ = ["StepReport", "Trainer"]


class Trainer:
    """Trains a model on the training views of a data set.

    The model's tensors move to the device that the render settings choose. Random numbers are drawn on the CPU, so they
    are the same on all devices.

    Attributes:
        extent: extent of the scene, in scene units; unit of "extent" learning rates and of size limits.
        pixel: size of a pixel at the median depth of the scene, in scene units; unit of "pixel" learning rates.
        step: number of finished steps.
        elapsed: seconds of training, without held-out evaluations and file writes.
        fake_quantize: differentiable function that rounds parameters as a file would store them; None: no rounding.
        zero_masks: parameter -> (N, ...) bool, True for values that training keeps at zero.
        rank: rank of this process among all processes that train the model.
        ranks: number of processes that train the model.
        stop_requested: function called after every step; True ends the training, see :attr:`stopping`.
        recorder: replays steps as CUDA graphs, see :meth:`settle`; None if steps cannot be recorded.
    """

    rank, ranks = 0, 1

    def __init__(
        self,
        model: Primitives,
        dataset: Dataset,
        loss: Loss,
        settings: TrainSettings,
        renderer: RenderSettings,
        seed: int,
    ) -> None:
        train = dataset.train
        settings = check_training_settings(settings, model, dataset)
        cameras = [train.view(i).camera for i in range(len(train))]
        self.current_model, self.dataset, self.loss, self.settings = model, dataset, loss, settings
        self.renderer = replace(resolve_near(renderer, model.params["means"], cameras), depth=False)
        self.extent = near_plane_extent(dataset.extent, model.params["means"], cameras)
        self.pixel = typical_pixel_size(model.params["means"], cameras, self.extent)
        self.device = best_render_backend_device(model, self.renderer, cameras[0], train.view(0).conditions)
        model.params = model.to(self.device).params
        self.loader = PixelLoader(dataset, self.device)
        self.population = make_population(settings.population)
        size, rate = settings.angular_size, settings.exposure_rate
        self.max_screen_size = None if size is None else MaxScreenSize(train, size)
        self.exposures = Exposures(len(train), dataset.channels, rate, self.device) if rate > 0 else None
        refine = dataset.refine
        self.corrections: ViewCorrections | None = None
        if refine:
            poses = torch.stack([camera.viewmat for camera in cameras])
            self.corrections = ViewCorrections(poses, refine, dataset.extent, self.device)
        self.covered_pixels = count_covered_pixels(train) if settings.stride == "auto" else 0.0
        self.generator = torch.Generator().manual_seed(seed + 1)
        self.order, self.step, self.elapsed = torch.empty(0, dtype=torch.int64), 0, 0.0
        self.fake_quantize: Callable[[dict[str, Tensor]], dict[str, Tensor]] | None = None
        self.zero_masks: dict[str, Tensor] = {}
        self.stop_requested: Callable[[], bool] = lambda: False
        self.optimizer = RowAdam(model.specs, model.params, settings.adam_beta2)
        self._shown_progress = 0.0
        self._turn = threading.RLock()  # the viewer of a training asks for the model on its own thread
        self.recorder: StepRecorder | None = None
        if recording_fault(self) is None:
            self.recorder = StepRecorder(self)
        self._require_grad()

    @property
    def model(self) -> Primitives:
        """The model after the last step. Reading this property waits for all steps that a GPU has not finished."""
        self.settle()
        return self.current_model

    @property
    def progress(self) -> float:
        """Used fraction of the budget, 0 to 1, of steps or seconds: the larger one. Schedules depend on this value."""
        steps = self.settings.iterations
        done = 0.0 if steps is None else self.step / steps if steps else 1.0
        if self.settings.max_seconds is not None:
            done = max(done, self.elapsed / self.settings.max_seconds)
        return min(done, 1.0)

    @property
    def finished(self) -> bool:
        return self.progress >= 1.0

    @property
    def stopping(self) -> bool:
        """Whether training should stop after the last step, because a stop was requested."""
        return self.stop_requested()

    def rates(self, progress: float | None = None) -> dict[str, float]:
        """Return the learning rates by parameter name at ``progress`` (None: the current progress)."""
        s, model = self.settings, self.current_model
        factor = s.rate_factor(self.step, self.progress if progress is None else progress)
        unit = {"absolute": 1.0, "extent": self.extent, "pixel": self.pixel}
        units = {spec.name: unit[s.rate_units.get(spec.name, spec.lr_unit)] for spec in model.specs}
        return {spec.name: s.rates.get(spec.name, spec.lr) * units[spec.name] * factor for spec in model.specs}

    # ------------------------------------------------------------ the loop

    def run(self) -> Iterator[StepReport]:
        """Run steps until the budget is used. Yield the result of each step; the caller may then save or stop."""
        while not self.finished:
            yield self.train_step()

    def train_step(self) -> StepReport:
        """Take one training step and return its result.

        Raises:
            NonFiniteError: a loss, gradient or parameter is NaN or infinite; the step changes no parameter.
            DeviceMemoryError: the GPU has too little memory for a step; saved checkpoints are intact.
        """
        with self._limit_resources(), self._turn:
            start, progress = time.perf_counter(), self.progress
            self._set_progress(progress)
            tasks, samples = self._draw_views(), self._draw_points()
            report = None
            if self.recorder is not None:
                report = self.recorder.take(tasks, samples, progress)
            if report is None:
                self.settle()
                report = StepReport.pending(self.settle)
                self._take_step(report, tasks, samples, progress, start)
            self.step += 1

            # Apply population control.
            change = None
            if self.population.due(self.step, progress):
                change = self.population.intervene(self.model, self.extent)
                if change is not None:
                    self._apply_change(change)
            self.elapsed = self._stop_clock(start)
            if self.finished:
                self.settle()
                self.elapsed = self._stop_clock(start)
            known = {"step": self.step, "seconds": self.elapsed, "primitives": self.current_model.count}
            report.__dict__.update(known, change=None if change is None else change.text)
            return report

    def _set_progress(self, progress: float) -> None:
        self._shown_progress = progress
        self.current_model.density.set_progress(progress)
        self.current_model.colour.set_progress(progress)

    def _take_step(
        self, report: StepReport, tasks: list[ViewTask], samples: PointSamples | None, progress: float, start: float
    ) -> None:
        """Take one step on the views ``tasks`` and the points ``samples``, without CUDA graph or population control."""
        model = self.current_model
        for value in model.params.values():
            value.grad = None

        # Add up losses and gradients, view by view. Points and regularisers join the last view.
        points: PointLossResult | None = None
        results, each = list[ViewResult](), list[Contributions]()
        for number, task in enumerate(tasks, start=1):
            view = self._render_view(task, progress)
            loss = view.loss / (self.settings.views_per_step * self.ranks)
            if number == len(tasks) and self.rank == self.ranks - 1:
                points = None if samples is None else self.compare_points(samples)
                loss = self.total_loss(loss, points)
            cost, parts, psnr = self._backward(loss, view, points)
            gain = None if self.exposures is None else self.exposures.gradient(task.view)
            moved = None if self.corrections is None else self.corrections.gradient(task.view)
            results.append(ViewResult(task.view, view.name, cost, psnr, parts, gain, moved))
            each.append(self._exchange_gradients(view.contributions))
            del view, loss  # free what autograd saved before the next view is rendered
        if tasks:
            results, contributions = self._combine_views(results, each, start)
            cost, parts, psnr = summarize_views(results)
            name = name_views([result.name for result in results])
        else:
            assert samples is not None, "a step without views has points"
            points = self.compare_points(samples)
            cost, parts, psnr = self._backward(self.total_loss(None, points), None, points)
            contributions, name = points.contributions(), samples.name

        # Update the parameters, and the numbers of the views.
        self.population.observe(model, contributions)
        self.optimizer.step(model.params, self.rates(progress))
        self.limit_model(self.limits_size)
        for parameter, mask in self.zero_masks.items():
            model.params[parameter].detach()[mask] = 0
        if self.exposures is not None:
            self.exposures.step({result.view: result.gain for result in results})
        if self.corrections is not None:
            self.corrections.step_at(progress, {result.view: result.correction for result in results})
        report.__dict__["view"] = name
        report.resolve(cost, parts, psnr)

    def settle(self, keep: int = 0) -> None:
        """Wait for all replayed steps except the last ``keep``, and repeat the steps that the GPU refused.

        The GPU refuses steps that need larger arrays or are not finite. Raises the errors of :meth:`train_step`.
        """
        if self.recorder is None:
            return
        with self._turn:
            again, step, progress = self.recorder.settle(keep), self.step, self._shown_progress
            for flight in again:
                self.step = flight.step
                self._set_progress(flight.progress)
                self._take_step(flight.report, flight.tasks, flight.samples, flight.progress, 0.0)
            if again:
                self.step = step
                self._set_progress(progress)

    @contextmanager
    def _limit_resources(self) -> Iterator[None]:
        try:
            with limit_threads(self.renderer.threads):
                yield
        except torch.OutOfMemoryError as error:
            camera, count = self.dataset.train.view(0).camera, self.current_model.count
            raise DeviceMemoryError(
                f"{self.device}: out of memory at step {self.step} with {count} primitives, images of "
                f"{camera.width} x {camera.height} pixels and train.views_per_step={self.settings.views_per_step}; "
                "lower one of them. The last checkpoint is intact"
            ) from error

    # ------------------------------------------------------------ methods that DistributedTrainer overrides

    def _draw_views(self) -> list[ViewTask]:
        """Draw the training views of a step with their backgrounds; return [] for ``train.supervision=voxels``."""
        if self.settings.supervision == "voxels":
            return []
        drawn = [self._draw_view() for _ in range(self.settings.views_per_step)]
        upcoming = [*(index for index, *_ in drawn[1:]), int(self.order[0]) if len(self.order) else None]
        return [ViewTask(*view, then) for view, then in zip(drawn, upcoming, strict=True)]

    def _exchange_gradients(self, contributions: Contributions) -> Contributions:
        """Return ``contributions`` after a view's backward pass, unchanged: ``.grad`` already sums over views."""
        return contributions

    def _combine_views(
        self, results: list[ViewResult], each: list[Contributions], start: float
    ) -> tuple[list[ViewResult], Contributions]:
        """Return the results of all views of the step, in order, and the sum of the views' contributions ``each``.

        ``start`` is the time at the start of the step.
        """
        return results, each[0] if len(each) == 1 else sum_contributions(each, self.current_model.count)

    def _stop_clock(self, start: float) -> float:
        return self.elapsed + time.perf_counter() - start

    # ------------------------------------------------------------ parts of a step

    def _draw_view(self) -> tuple[int, Tensor, PixelStride]:
        """Draw the next training view (random order, without replacement), its background and its selected pixels."""
        train, settings = self.dataset.train, self.settings
        if len(self.order) == 0:
            self.order = torch.randperm(len(train), generator=self.generator)
        index, self.order = int(self.order[0]), self.order[1:]
        background = self._draw_background()
        primitives = self.current_model.count + (GPU_LAUNCHES if self.device.type == device.CUDA else 0)
        stride = choose_stride(settings.stride, self.covered_pixels, primitives, self.progress)
        return index, background, draw_stride(stride, train.view(index), self.generator)

    def _draw_background(self) -> Tensor:
        choice, channels = self.settings.background, self.dataset.channels
        if choice == "random" or (choice == "auto" and self.dataset.random_background):
            return torch.rand(channels, generator=self.generator)
        if choice == "auto":
            return self.dataset.background.float()
        return torch.full((channels,), 1.0 if choice == "white" else 0.0)

    def _draw_points(self) -> PointSamples | None:
        """Draw the points with known extinction for this step; return None if the step uses no points.

        With ``train.supervision=both``, steps whose number (from 1) is a multiple of ``voxels_every`` use points.
        """
        source = self.settings.supervision
        if source == "images" or (source == "both" and (self.step + 1) % self.settings.voxels_every):
            return None
        assert self.dataset.points is not None, "the constructor refuses data without points"
        samples = self.dataset.points.draw(self.settings.voxels_per_step, self.generator)
        check_point_samples(samples, self.dataset)
        return samples

    def _quantized_model(self) -> Primitives:
        """Return the model to render, with quantized parameters if :attr:`fake_quantize` is set."""
        model = self.current_model
        if self.fake_quantize is None:
            return model
        return Primitives(model.density, model.colour, self.fake_quantize(model.params))

    def load_view(self, task: ViewTask) -> tuple[View, Pixels]:
        """Return a training view and its pixels, on the device of the model."""
        pixels = self.loader.take(task.view, task.upcoming)
        return task.stride.take(self.dataset.train.view(task.view), pixels)

    def _render_view(self, task: ViewTask, progress: float) -> RenderedView:
        """Render a view and compare it with its image."""
        view, pixels = self.load_view(task)
        if self.corrections is not None:
            view = self.corrections.apply(task.view, view)

        background = task.background.to(self.device, non_blocking=True)
        output = render(self._quantized_model(), view.camera, view.conditions, self.renderer, background)
        if self.recorder is not None:
            self.recorder.observe_counts(output.stats)
        if self.exposures is not None:
            output = replace(output, rgb=self.exposures.apply(task.view, output.rgb))
        return compare_view(output, self.loss, view, pixels, background, progress)

    def compare_points(self, samples: PointSamples) -> PointLossResult:
        """Return the loss between the model and known values (extinction and source radiance) at points."""
        return point_loss(self._quantized_model(), samples, self.settings, self.renderer.threads)

    @property
    def has_anisotropy_loss(self) -> bool:
        """Whether this step's loss has the anisotropy regulariser, which begins at ``train.anisotropy_from``."""
        return self.settings.anisotropy_weight > 0 and self.step >= self.settings.anisotropy_from

    @property
    def limits_size(self) -> bool:
        """Whether this step limits the sizes of primitives as seen from the nearest camera (``train.angular_size``)."""
        return self.max_screen_size is not None and self.max_screen_size.due(self.step)

    def total_loss(self, loss: Tensor | None, points: PointLossResult | None = None) -> Tensor:
        """Return the sum of a view's ``loss``, the loss of ``points`` (unless None) and the regularisers."""
        if points is not None:
            loss = points.loss if loss is None else loss + self.settings.voxel_weight * points.loss
        assert loss is not None
        log_scales = self.current_model.params["log_scales"]
        if self.settings.size_weight > 0:
            loss = loss + self.settings.size_weight * log_scales.exp().mean() / self.extent
        if self.has_anisotropy_loss:
            loss = loss + self.settings.anisotropy_weight * scale_anisotropy(log_scales)
        return loss

    def limit_model(self, sizes: bool, when: Tensor | None = None) -> None:
        """Limit the extinction to the largest extinction of the data and, if ``sizes``, the sizes of primitives.

        The limit of a size depends on the nearest camera (``train.angular_size``). ``when`` is (1,) bool on the device;
        if ``when`` is False, the model does not change.
        """
        model = self.current_model
        if self.dataset.largest is not None:
            model.limit(self.dataset.largest, when)
        if sizes and self.max_screen_size is not None:
            self.max_screen_size.apply(model.params["means"], model.params["log_scales"], when)

    def _backward(
        self, loss: Tensor, view: RenderedView | None, points: PointLossResult | None
    ) -> tuple[float, dict[str, float], float]:
        """Run the backward pass, which adds to the parameters' ``.grad``; return (loss, parts by name, PSNR).

        The PSNR is that of ``view``, or of the extinction at ``points`` if ``view`` is None.

        Raises:
            NonFiniteError: the loss is NaN or infinite; the message names the view or points.
        """
        more = {} if points is None else points.parts
        if view is None:
            assert points is not None, "a step without views has points"
            cost, parts, psnr = loss.item(), {name: float(part) for name, part in more.items()}, points.psnr()
        else:
            numbers = view.numbers(loss, more.values()).tolist()
            cost, parts, psnr = summarize_numbers(numbers, (*view.parts, *more))
        if not math.isfinite(cost):
            self.current_model.check_finite()
            where = f"points of {points.samples.name}" if view is None and points is not None else ""
            if view is not None:
                bad_pixels = not bool(torch.isfinite(view.truth).all())
                where = f"view {view.name}{', whose pixels are NaN or infinite somewhere' if bad_pixels else ''}"
            raise NonFiniteError(f"loss is {cost} at step {self.step} on {where}; check the data or lower train.rates")
        loss.backward()
        return cost, parts, psnr

    def _apply_change(self, change: PopulationChange) -> None:
        model = self.current_model
        self.zero_masks = {name: mask[change.origin] for name, mask in self.zero_masks.items()}
        self.optimizer.select(change.origin, change.fresh)
        if len(change.origin) == model.count:  # in the same memory, which recorded steps know
            for name, value in model.params.items():
                value.detach().copy_(change.params[name])
            return
        model.params = {spec.name: change.params[spec.name] for spec in model.specs}
        self._require_grad()

    def _require_grad(self) -> None:
        for name, value in self.current_model.params.items():
            self.current_model.params[name] = value.detach().contiguous().requires_grad_()
        if self.recorder is not None:
            self.recorder.reset()

    # ------------------------------------------------------------ exact state

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the training state as CPU tensors and JSON values; :meth:`load_state` continues exactly from it."""
        tensors = {f"params.{k}": v.detach() for k, v in self.model.params.items()}
        tensors |= {f"adam.{k}": v for k, v in self.optimizer.state().items()}
        tensors |= {f"population.{k}": v for k, v in self.population.state().items()}
        for name, numbers in (("exposure", self.exposures), ("correction", self.corrections)):
            tensors |= {f"{name}.{k}": v for k, v in (numbers.state() if numbers else {}).items()}
        tensors |= {f"zeros.{k}": v for k, v in self.zero_masks.items()}
        tensors |= {"generator": self.generator.get_state(), "order": self.order}
        tensors = {name: value.cpu() for name, value in tensors.items()}
        train = self.dataset.train
        header = {"step": self.step, "elapsed": self.elapsed, "views": len(train), "names": hash_training_views(train)}
        return tensors, header

    def load_state(self, tensors: dict[str, Tensor], header: dict[str, Any], where: str) -> None:
        """Restore the result of :meth:`state`, on any device.

        Raises:
            CheckpointError: the state belongs to other settings or data. The trainer is unchanged.
        """
        check_state(tensors, header, where, *self.state())
        moved = {name: value.to(self.device, copy=True) for name, value in tensors.items()}
        self.model.params = {spec.name: moved[f"params.{spec.name}"] for spec in self.model.specs}
        self.optimizer.load_state(select_state_tensors(moved, "adam."))
        self.population.load_state(select_state_tensors(moved, "population."))
        for name, numbers in (("exposure.", self.exposures), ("correction.", self.corrections)):
            if numbers is not None:
                numbers.load_state(select_state_tensors(moved, name))
        self.zero_masks = select_state_tensors(moved, "zeros.")
        self.order = tensors["order"].clone()
        self.generator.set_state(tensors["generator"])
        self.step, self.elapsed = header["step"], float(header["elapsed"])
        self._require_grad()

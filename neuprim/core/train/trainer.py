"""The training loop, for every task, in one sitting.

A step: draw a view, render it, compare, go back, move the parameters, let the population react; ``train.supervision``
may put points of known extinction in a view's place or beside it. Everything that shapes
the next step is in :meth:`Trainer.state`, so that 2N steps equal N steps, a kill, a resume and N more, bit for bit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.threads import limit_threads
from neuprim.core.data import Dataset, Pixels, PointSamples
from neuprim.core.data.dataset_check import check_pixels
from neuprim.core.errors import ConfigError, DataError, DeviceMemoryError, NonFiniteError, RankError, nearest
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.backends import device_of
from neuprim.core.render.near_plane import resolve_near, scene_extent
from neuprim.core.task import Loss, Supervision
from neuprim.core.train.ahead import Ahead
from neuprim.core.train.angle import AngularSize
from neuprim.core.train.coarse import reduced, reduction
from neuprim.core.train.distributed import ALONE, Alone, Look, Seen
from neuprim.core.train.distributed.refusals import refuse_parts
from neuprim.core.train.exposure import Exposures
from neuprim.core.train.losses import scale_anisotropy
from neuprim.core.train.optimizer import RowAdam
from neuprim.core.train.points import PointStep, point_step
from neuprim.core.train.population import Change, make_population
from neuprim.core.train.restoring import by_row, names_of, part, restored
from neuprim.core.train.settings import TrainSettings
from neuprim.core.train.step import ImageStep, StepReport, of_views

__all__ = ["COLD", "StepReport", "Trainer"]

COLD = 0.02
"""What a cool-down leaves of a rate."""


class Trainer:
    """Fits a model to the training views of a data set.

    The model's tensors move to the device that the renderer's settings choose, and so does all that belongs to them;
    random numbers are drawn on the processor, so that they are the same on every device.

    Attributes:
        device: where the training's tensors are.
        extent: the unit of position rates and size limits, see :func:`~neuprim.core.render.near_plane.scene_extent`.
        step, elapsed: steps done and seconds of training they took (held-out evaluations and file writes not counted).
        stored: parameters -> what will be kept of them, with the gradients of the parameters: images are drawn of that.
        None: of themselves. zeros: parameter -> (N, ...) bool of the numbers that stay zero; empty for none.
        ranks: the processes that share a step's views; see :meth:`join`.
    """

    def __init__(
        self,
        model: Primitives,
        dataset: Dataset,
        loss: Loss,
        settings: TrainSettings,
        renderer: RenderSettings,
        seed: int,
    ) -> None:
        if len(dataset.train) == 0:
            raise DataError(f"{dataset.name}: the training split is empty")
        names = [spec.name for spec in model.specs]
        for group, given in (("rates", settings.rates), ("rate_units", settings.rate_units)):
            for key in given:
                if key not in names:
                    raise ConfigError(f"train.{group}.{key}: no such parameter{nearest(key, names)}")
        if settings.supervision == "auto":
            settings = replace(settings, supervision="images" if dataset.points is None else "both")
        if settings.supervision != "images" and dataset.points is None:
            raise ConfigError(
                f"train.supervision={settings.supervision}: {dataset.name} has no voxels to learn from; expected images"
            )
        self.model, self.dataset, self.loss = model, dataset, loss
        cameras = [dataset.train.view(i).camera for i in range(len(dataset.train))]
        self.settings, self.renderer = (
            settings,
            replace(resolve_near(renderer, model.params["means"], cameras), depth=False),
        )
        self.extent = scene_extent(dataset.extent, model.params["means"], cameras)
        first = dataset.train.view(0)
        self.device = device_of(model, self.renderer, first.camera, first.conditions)
        model.params = model.to(self.device).params
        self._ahead = (
            Ahead(self._pixels, device.free_cuda_memory(self.device) // 4) if self.device.type == device.CUDA else None
        )
        self.population = make_population(settings.population)
        self.angles = None if settings.angular_size is None else AngularSize(dataset.train, settings.angular_size)
        self.exposures = None
        if settings.exposure_rate > 0:
            if dataset.train.pixels(0).alpha is not None:
                raise ConfigError(
                    f"train.exposure_rate={settings.exposure_rate:g}: images of {dataset.name} have alpha; expected opaque photographs, "
                    "as a gain would change the background that is put behind them"
                )
            self.exposures = Exposures(len(dataset.train), dataset.channels, settings.exposure_rate, self.device)
        self.generator = torch.Generator().manual_seed(seed + 1)
        self.order = torch.empty(0, dtype=torch.int64)
        self.step = 0
        self.elapsed = 0.0
        self.stored: Callable[[dict[str, Tensor]], dict[str, Tensor]] | None = None
        self.zeros: dict[str, Tensor] = {}
        self.ranks: Alone = ALONE
        self._watch()

    def join(self, ranks: Alone) -> None:
        """Train with others from here on: a step looks at ``train.views_per_step`` views of every rank. Where each has
        a part of the primitives, this one keeps its own.

        Raises:
            ConfigError: there are no views to share, or what is trained cannot be in parts.
        """
        if ranks.size > 1 and self.settings.supervision == "voxels":
            raise ConfigError(
                f"train.supervision=voxels: there are no views that {ranks.size} ranks could share; expected one process"
            )
        self.ranks = ranks
        if ranks.parts:
            refuse_parts(self.settings, ranks.size)
            if self.step:
                tensors, header = self.state()
                own = ranks.cut({name: value for name, value in tensors.items() if by_row(name, value)})
                self.load_state({**tensors, **own}, header, "the whole model")
                return
            self.model.params = ranks.cut(self.model.params)
            vars(self).pop("optimizer", None)
            self.population.count = self.count
            self._watch()

    def leave(self, params: dict[str, Tensor]) -> None:
        """Train no more: the whole model's tensors take the place of this rank's part, and its moments go."""
        self.ranks, self.population.count = ALONE, None
        self.model.params = {name: params[name].to(self.device) for name in self.model.params}
        vars(self).pop("optimizer", None)

    @cached_property
    def optimizer(self) -> RowAdam:
        """Made when it is first needed: a rank that keeps a part of the primitives never has moments of all."""
        return RowAdam(self.model.specs, self.model.params, self.settings.adam_beta2)

    # ------------------------------------------------------------ the budget

    @property
    def progress(self) -> float:
        """Used fraction of the budget: the larger of steps and seconds. Every schedule runs on it."""
        steps = self.settings.iterations
        done = 0.0 if steps is None else self.step / steps if steps else 1.0
        if self.settings.max_seconds is not None:
            done = max(done, self.elapsed / self.settings.max_seconds)
        return min(done, 1.0)

    @property
    def finished(self) -> bool:
        return self.progress >= 1.0

    def rates(self) -> dict[str, float]:
        """Learning rate of every parameter now: warm-up, exponential decay to ``final_rate`` at the end of the budget,
        cool-down."""
        s = self.settings
        factor = s.final_rate**self.progress
        if s.cooldown and self.progress > 1 - s.cooldown:
            factor *= max((1 - self.progress) / s.cooldown, COLD)
        if self.step < s.warmup_steps:
            factor *= (self.step + 1) / s.warmup_steps
        unit = {"absolute": 1.0, "extent": self.extent}
        units = {spec.name: unit[s.rate_units.get(spec.name, spec.lr_unit)] for spec in self.model.specs}
        return {spec.name: s.rates.get(spec.name, spec.lr) * units[spec.name] * factor for spec in self.model.specs}

    # ------------------------------------------------------------ the loop

    def run(self) -> Iterator[StepReport]:
        """Step until the budget is used. Between two steps the state may be saved or the loop left."""
        while not self.finished:
            yield self.train_step()

    def train_step(self) -> StepReport:
        """One view, some points or both, one update; on as many threads as the renderer has.

        Raises:
            NonFiniteError: a loss, gradient or parameter is NaN or infinite; nothing was updated by this step.
            DeviceMemoryError: the card has no room for a step; what was saved is intact.
            RankError: another rank is gone; the state is that before the step.
        """
        drawn = self.order, self.generator.get_state() if self.ranks.size > 1 else None
        try:
            with limit_threads(self.renderer.threads):
                return self._train_step()
        except (
            RankError
        ) as error:  # the step is not done: what it drew is drawn again, by whoever goes on from this state
            self.order = drawn[0]
            if drawn[1] is not None:
                self.generator.set_state(drawn[1])
            raise error if error.told else RankError(f"{error}, in step {self.step + 1}") from error
        except torch.OutOfMemoryError as error:
            camera = self.dataset.train.view(0).camera
            size = f"{camera.width} x {camera.height} pixels"
            raise DeviceMemoryError(
                f"{self.device}: out of memory at step {self.step} with {self.model.count} primitives, images of {size} and "
                f"train.views_per_step={self.settings.views_per_step}; lower one of them. The last checkpoint is intact"
            ) from error

    def _train_step(self) -> StepReport:
        start = time.perf_counter()
        model, progress = self.model, self.progress
        model.density.set_progress(progress)
        model.colour.set_progress(progress)
        for value in model.params.values():
            value.grad = None

        views = 0 if self.settings.supervision == "voxels" else self.settings.views_per_step
        looks = views * self.ranks.size
        step = self.ranks.step(model, views, self.elapsed, start)
        known: PointStep | None = None
        for place, index, background, following, peers in self._deal(looks):
            samples = self._draw_points() if place >= looks - self.ranks.size and self._points_due() else None
            shown = step.drawn(lambda peers=peers, samples=samples: self._looks(peers, samples))  # type: ignore[misc]
            seen = self._look(progress, index, background, following, shown)
            loss = seen.loss / looks if looks > 1 else seen.loss
            last = place == looks - 1
            if last:  # points and regularisers go with the last view, whoever looks at it
                known = None if samples is None else self._look_inside(samples, shown)
                loss = self._beside(loss, known)
            cost = self._go_back(loss, loss if last else seen.loss, seen, known)
            gain = None if self.exposures is None else self.exposures.gradient(index)
            more = {} if known is None else known.parts
            step.add(Seen(index, seen.name, cost, seen.psnr, seen.parts, more, gain), seen.tally)
            del seen, loss, shown  # and what the frame kept, before the next one is drawn
        if looks:
            tally = step.close()
        else:
            known = self._look_inside(self._draw_points(), model)
            loss = self._beside(None, known)
            cost = self._go_back(loss, loss, None, known)
            tally = known.tally()

        self.population.observe(model, tally)
        self.optimizer.step(model.params, self.rates())
        if self.dataset.largest is not None:
            self.model.limit(self.dataset.largest)
        for name, zero in self.zeros.items():
            model.params[name].detach()[zero] = 0
        if self.exposures is not None:
            self.exposures.step({view.index: view.gain for view in step.seen})
        if self.angles is not None:
            self.angles.step(self.step, model.params["means"], model.params["log_scales"])
        self.step += 1
        change = None
        if self.population.due(self.step, progress):
            change = self.ranks.intervene(self.population, model, self.optimizer, self.extent)
            if change is not None:
                self._apply(change)
        self.elapsed = self.ranks.spent(self.elapsed, start)
        if known is not None and not looks:
            parts, psnr, name = known.parts, known.psnr, known.name
        else:
            cost, parts, psnr, name = of_views(step.seen)
        return StepReport(self.step, self.elapsed, cost, parts, psnr, self.count, name, change.text if change else None)

    @property
    def count(self) -> int:
        """Primitives of the whole model."""
        return self.ranks.count(self.model)

    def _deal(self, looks: int) -> list[tuple[int, int, Tensor, int | None, list[int]]]:
        """Draw the views of a step; of this rank's, by turns: place in the step, view, background, the view that this
        rank looks at next, and those that all ranks look at now.

        All ranks draw all of them, so that their random numbers stay the same.
        """
        drawn = [(self._next_view(), self._background()) for _ in range(looks)]
        mine = range(self.ranks.rank, looks, self.ranks.size)
        later = int(self.order[self.ranks.rank]) if len(self.order) > self.ranks.rank else None
        following = [*(drawn[place][0] for place in mine[1:]), later]
        peers = [[index for index, _ in drawn[place - self.ranks.rank :][: self.ranks.size]] for place in mine]
        return (
            [(place, *drawn[place], then, now) for place, then, now in zip(mine, following, peers, strict=True)]
            if looks
            else []
        )

    def _looks(self, peers: list[int], samples: PointSamples | None) -> list[Look]:
        """What all ranks look at now; points go with the last one's."""
        looks = [Look(self.dataset.train.view(index)) for index in peers]
        return looks if samples is None else [*looks[:-1], replace(looks[-1], beside=samples.conditions)]

    def _beside(self, loss: Tensor | None, known: PointStep | None) -> Tensor:
        """The loss of a step's views, or None, with those of points and regularisers."""
        if known is not None:
            loss = known.loss if loss is None else loss + self.settings.voxel_weight * known.loss
        assert loss is not None
        if self.settings.anisotropy_weight > 0 and self.step >= self.settings.anisotropy_from:
            loss = loss + self.settings.anisotropy_weight * scale_anisotropy(self.model.params["log_scales"])
        return loss

    def _go_back(self, loss: Tensor, judged: Tensor, seen: ImageStep | None, known: PointStep | None) -> float:
        """Add a loss to the gradients; returns the value of ``judged``, what it is made of.

        Raises:
            NonFiniteError: it is none.
        """
        cost = judged.item()
        if not math.isfinite(cost):
            self._refuse(cost, seen, known)
        loss.backward()
        return cost

    def _look(
        self, progress: float, index: int, background: Tensor, following: int | None, shown: Primitives
    ) -> ImageStep:
        """Draw a view and compare."""
        pixels = self._pixels(index) if self._ahead is None else self._ahead.take(index, following)
        factor = reduction(progress, self.settings.coarse, self.settings.coarse_until)
        view, pixels = reduced(self.dataset.train.view(index), pixels, factor)
        background = background.to(self.device, non_blocking=True)
        truth = pixels.over(background)
        output = render(self._drawn(shown), view.camera, view.conditions, self.renderer, background)
        rgb = output.rgb if self.exposures is None else self.exposures.apply(index, output.rgb)
        if pixels.mask is not None:
            rgb = torch.where(pixels.mask[..., None], rgb, truth)
        loss, parts = self.loss(rgb, truth, Supervision(view, pixels.mask, pixels.alpha, progress))
        with torch.no_grad():
            difference = rgb - truth
            channels = difference.shape[-1]
            tally = output.request_contributions(
                difference.abs() @ torch.full((channels,), 1.0 / channels, device=self.device)
            )
            flat = difference.reshape(-1)
            counted = flat.numel() if pixels.mask is None else int(pixels.mask.sum()) * channels
            mse = torch.dot(flat, flat).item() / counted
        psnr = -10 * math.log10(max(mse, 1e-20)) if math.isfinite(mse) else math.nan
        return ImageStep(loss, parts, psnr, view.name, truth, tally)

    def _drawn(self, model: Primitives) -> Primitives:
        """What images are drawn of."""
        return model if self.stored is None else Primitives(model.density, model.colour, self.stored(model.params))

    def _pixels(self, index: int) -> Pixels:
        """Those of a training view, where the training is."""
        pixels = self.dataset.train.pixels(index)
        check_pixels("train", self.dataset.train.view(index), pixels, self.dataset.channels)
        return pixels.to(self.device)

    def _points_due(self) -> bool:
        """Whether this step looks at points, too; the last one before each multiple of ``voxels_every`` does, which is
        what logs show."""
        source = self.settings.supervision
        return source == "voxels" or (source == "both" and (self.step + 1) % self.settings.voxels_every == 0)

    def _look_inside(self, samples: PointSamples, shown: Primitives) -> PointStep:
        """Compare at points of known extinction."""
        return point_step(self._drawn(shown), self.dataset, samples, self.settings, self.renderer.threads)

    def _draw_points(self) -> PointSamples:
        points = self.dataset.points
        assert points is not None, "refused at the start"
        return points.draw(self.settings.voxels_per_step, self.generator)

    def _refuse(self, value: float, seen: ImageStep | None, known: PointStep | None) -> None:
        """Say why a loss is not finite.

        Raises:
            NonFiniteError: always.
        """
        self.model.check_finite()
        where = f"view {seen.name}" if seen is not None else f"points of {known.name}" if known is not None else ""
        spoiled = seen is not None and not bool(torch.isfinite(seen.truth).all())
        more = ", whose pixels are NaN or infinite somewhere" if spoiled else ""
        raise NonFiniteError(f"loss is {value} at step {self.step} on {where}{more}")

    def _next_view(self) -> int:
        """Random order without replacement."""
        if len(self.order) == 0:
            self.order = torch.randperm(len(self.dataset.train), generator=self.generator)
        index, self.order = int(self.order[0]), self.order[1:]
        return index

    def _background(self) -> Tensor:
        choice, channels = self.settings.background, self.dataset.channels
        if choice == "random" or (choice == "auto" and self.dataset.random_background):
            return torch.rand(channels, generator=self.generator)
        if choice == "auto":
            return self.dataset.background.float()
        return torch.full((channels,), 1.0 if choice == "white" else 0.0)

    def _apply(self, change: Change) -> None:
        self.model.params = {spec.name: change.params[spec.name].contiguous() for spec in self.model.specs}
        self.optimizer.select(change.origin, change.fresh)
        self.zeros = {name: zero[change.origin] for name, zero in self.zeros.items()}
        self._watch()

    def _watch(self) -> None:
        for name, value in self.model.params.items():
            self.model.params[name] = value.detach().requires_grad_()

    # ------------------------------------------------------------ exact state

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and JSON-able numbers from which :meth:`load_state` goes on exactly, on any device; all of them on
        the processor."""
        tensors = {f"params.{k}": v.detach() for k, v in self.model.params.items()}
        tensors |= {f"adam.{k}": v for k, v in self.optimizer.state().items()}
        tensors |= {f"population.{k}": v for k, v in self.population.state().items()}
        tensors |= {f"exposure.{k}": v for k, v in (self.exposures.state() if self.exposures else {}).items()}
        tensors |= {f"zeros.{k}": v for k, v in self.zeros.items()}
        tensors |= {"generator": self.generator.get_state(), "order": self.order}
        tensors = {name: value.cpu() for name, value in tensors.items()}
        header = {
            "step": self.step,
            "elapsed": self.elapsed,
            "views": len(self.dataset.train),
            "names": names_of(self.dataset.train),
        }
        return tensors, header

    def load_state(self, tensors: dict[str, Tensor], header: dict[str, Any], where: str) -> None:
        """Continue from :meth:`state`; of a rank with a part of the primitives, from its rows.

        Raises:
            CheckpointError: the state belongs to other settings or data; names what differs. The trainer is unchanged.
        """
        found = restored(
            tensors, header, where, self.model, self.settings.adam_beta2, self.dataset.train, self.exposures
        )
        model, self.optimizer = found.model, found.optimizer
        self.model.params = model.to(self.device).params
        if self.device != model.device:
            self.optimizer = RowAdam(self.model.specs, self.model.params, self.settings.adam_beta2)
            self.optimizer.load_state(part(tensors, "adam."))
        self.order, self.generator = tensors["order"].clone(), found.generator
        self.population.load_state({name: value.to(self.device) for name, value in found.population.items()})
        self.zeros = {name: zero.to(self.device) for name, zero in found.zeros.items()}
        self.population.count = self.count if self.ranks.parts else None
        self.step, self.elapsed = found.step, found.elapsed
        self._watch()

"""Training views: loaded one ahead on a GPU, some of their pixels in a step, with numbers of their own: a photograph's
gain, and corrections of its camera and conditions."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.data import Dataset, Pixels, View, ViewSet
from neuprim.core.data.dataset import Correction
from neuprim.core.data.dataset_check import check_pixels
from neuprim.core.data.image_views import StoredPixels

_MIN_SIDE = 11
"""Pixels along a side that no stride goes below: the window of SSIM."""

_PIXELS_PER_PRIMITIVE = 1.5
"""Covered pixels of a view that take as long in a step on the CPU as one primitive does."""

_COUNTED_VIEWS = 16
"""Views whose covered pixels are counted, spread over the training set."""

_STRIDE_STAGES = ((0.7, 1), (0.9, 2))
"""Used fraction of the budget -> divisor of the automatic stride until then; from the last one on views are whole."""

_BETA1, _BETA2, _EPS = 0.9, 0.99, 1e-8

_CORRECTION_RATES: dict[Correction, list[float]] = {"pose": [3e-4] * 6, "offset": [3e-3] * 3, "factor": [3e-3]}
"""Of the numbers of each kind, at the start: of a pose in radians and units of length, the view's step of Adam each."""


class PixelLoader:
    """Loads the pixels of training views; for a GPU those of the next view in a thread, which does not change which
    views are used, and keeps those that fit, as loading a large view again takes longer than a step."""

    def __init__(self, dataset: Dataset, where: torch.device) -> None:
        self._dataset, self._device = dataset, where
        self._capacity = device.free_cuda_memory(where) // 4 if where.type == device.CUDA else 0
        self._cache: dict[int, Pixels] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._pending: tuple[int, Future[Pixels]] | None = None

    def _load(self, index: int) -> Pixels:
        pixels = self._dataset.train.pixels(index)
        if not isinstance(pixels, StoredPixels):  # they have the size of their view, and no floats yet
            check_pixels("train", self._dataset.train.view(index), pixels, self._dataset.channels)
        return pixels if self._device.type == device.CPU else pixels.to(self._device)

    def take(self, index: int, upcoming: int | None) -> Pixels:
        """Return a view's pixels, and start loading those of ``upcoming``, if it is known. Raises what loading did."""
        if self._device.type == device.CPU:
            return self._load(index)
        pending, self._pending = self._pending, None
        if index in self._cache:
            pixels = self._cache[index]
        else:
            pixels = pending[1].result() if pending is not None and pending[0] == index else self._load(index)
            size = sum(x.nbytes for x in (pixels.rgb, pixels.alpha, pixels.mask) if x is not None)
            if size <= self._capacity:
                self._cache[index], self._capacity = pixels, self._capacity - size
        if upcoming is not None and upcoming not in self._cache:
            self._pool = self._pool or ThreadPoolExecutor(1, thread_name_prefix="neuprim-views")
            self._pending = upcoming, self._pool.submit(copy_context().run, self._load, upcoming)
        return pixels


class PixelStride(NamedTuple):
    """Every ``step``-th pixel of a view in x and y, the first at (``column``, ``row``)."""

    step: int = 1
    column: int = 0
    row: int = 0

    def take(self, view: View, pixels: Pixels) -> tuple[View, Pixels]:
        """The view that has these pixels alone: its rays and colours are theirs, nothing is averaged."""
        if self.step == 1:
            return view, pixels
        return replace(view, camera=view.camera.strided(*self)), pixels.strided(*self)


def count_covered_pixels(views: ViewSet) -> float:
    """Mean number of pixels of a training view that show something: with alpha above 0, and not masked."""
    chosen = range(0, len(views), -(-len(views) // _COUNTED_VIEWS))
    total = 0
    for index in chosen:
        camera, pixels = views.view(index).camera, views.pixels(index)
        alpha = pixels.alpha  # stored images are not converted for colours
        covered = torch.ones(camera.height, camera.width, dtype=torch.bool) if alpha is None else alpha > 0
        total += int((covered if pixels.mask is None else covered & pixels.mask).sum())
    return total / len(chosen)


def choose_stride(stride: int | Literal["auto"], covered: float, primitives: int, progress: float) -> int:
    """The step between pixels at this used fraction of the budget.

    ``auto`` balances the work per pixel, which falls with the square of the stride, and that per primitive, which does
    not: on either side of the balance a step costs more than it teaches. It depends on sizes alone.
    """
    if stride != "auto":
        return stride
    divisor = next((divisor for until, divisor in _STRIDE_STAGES if progress < until), None)
    balance = round(math.sqrt(covered / (_PIXELS_PER_PRIMITIVE * primitives)))
    return 1 if divisor is None else max(-(-balance // divisor), 1)


def draw_stride(stride: int, view: View, generator: torch.Generator) -> PixelStride:
    """Draw the first pixel. A stride that leaves a view fewer than 11 pixels a side is lowered; 1 draws nothing."""
    stride = max(min(stride, min(view.camera.width, view.camera.height) // _MIN_SIDE), 1)
    if stride == 1:
        return PixelStride()
    column, row = torch.randint(stride, (2,), generator=generator).tolist()
    return PixelStride(stride, column, row)


def hash_training_views(views: ViewSet) -> str:
    """Hash the names of views: other frames or images of the same number are other data."""
    text = "\n".join(views.view(i).name for i in range(len(views)))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class _NumbersOfViews:
    """Some numbers per training view that a run learns beside the model, by Adam, in the steps that use the view."""

    def __init__(self, views: int, rates: list[float], device: torch.device) -> None:
        self.rates = torch.tensor(rates, device=device)
        self.numbers = torch.zeros(views, len(rates), device=device)
        self.m, self.v = torch.zeros_like(self.numbers), torch.zeros_like(self.numbers)
        self.seen = torch.zeros(views, dtype=torch.int64)
        self._rows: dict[int, Tensor] = {}

    def row(self, index: int) -> Tensor:
        """The numbers of view ``index``, for :meth:`gradient` to find what its backward pass leaves there."""
        self._rows[index] = row = self.numbers[index].clone().requires_grad_()
        return row

    def gradient(self, index: int) -> list[float] | None:
        """Gradient of a view's numbers, after its backward pass; None without one."""
        grad = self._rows.pop(index).grad
        return None if grad is None else [float(x) for x in grad.tolist()]

    def step(self, gradients: Mapping[int, list[float] | None], factor: float = 1.0) -> None:
        """Move the numbers of a step's views by their gradients, at ``factor`` of the rates."""
        for index, numbers in gradients.items():
            if numbers is None:
                continue
            grad = torch.tensor(numbers, device=self.numbers.device)
            self.seen[index] += 1
            n = int(self.seen[index])
            self.m[index] += (1 - _BETA1) * (grad - self.m[index])
            self.v[index] += (1 - _BETA2) * (grad.square() - self.v[index])
            scale = factor * math.sqrt(1 - _BETA2**n) / (1 - _BETA1**n)
            self.numbers[index] -= self.rates * scale * self.m[index] / (self.v[index].sqrt() + _EPS)

    def state(self) -> dict[str, Tensor]:
        """Tensors from which :meth:`load_state` goes on."""
        return {"numbers": self.numbers, "m": self.m, "v": self.v, "seen": self.seen}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continue from a checked state."""
        self.numbers, self.m, self.v = state["numbers"], state["m"], state["v"]
        self.seen = state["seen"].cpu()


class Exposures(_NumbersOfViews):
    """A factor per training view and channel, by which a rendered image is multiplied before it is compared.

    Their logarithms are learned. The geometric mean over the views stays 1, so that the model keeps the photographs'
    mean exposure, with which held-out views are rendered.
    """

    def __init__(self, views: int, channels: int, rate: float, device: torch.device) -> None:
        super().__init__(views, [rate] * channels, device)

    def apply(self, index: int, rgb: Tensor) -> Tensor:
        """(H, W, C) as the camera of view ``index`` would have exposed it."""
        return rgb * self.row(index).exp()

    def step(self, gradients: Mapping[int, list[float] | None], factor: float = 1.0) -> None:
        super().step(gradients, factor)
        if gradients:
            self.numbers -= self.numbers.mean(0)


class ViewCorrections(_NumbersOfViews):
    """Corrections of what a data set knows of its training views only roughly (``Dataset.refine``).

    Args:
        kinds: "camera" or a condition -> "pose", "offset" or "factor". A pose has a rotation vector and a shift on the
            camera's axes, an offset is added to a position, and of a factor the logarithm is learned.
        unit: of shifts and offsets, in scene units.
    """

    def __init__(self, views: int, kinds: Mapping[str, Correction], unit: float, device: torch.device) -> None:
        rates = [rate for kind in kinds.values() for rate in _CORRECTION_RATES[kind]]
        super().__init__(views, rates, device)
        self.kinds, self.unit = kinds, unit

    def apply(self, index: int, view: View) -> View:
        """The view as it is taken to be now."""
        row, conditions, camera = self.row(index).double(), dict(view.conditions), view.camera
        for name, part in zip(self.kinds, row.split(self._sizes()), strict=True):
            if name in conditions:
                value = conditions[name]
                part = part.to(value)
                conditions[name] = value * part.exp() if self.kinds[name] == "factor" else value + self.unit * part
            else:
                camera = replace(camera, viewmat=self._motion(part.cpu()) @ camera.viewmat.double())
        return replace(view, camera=camera, conditions=conditions)

    def _sizes(self) -> list[int]:
        return [len(_CORRECTION_RATES[kind]) for kind in self.kinds.values()]

    def _motion(self, part: Tensor) -> Tensor:
        """(4, 4) of a rotation vector and a shift."""
        (x, y, z), shift = part[:3], self.unit * part[3:]
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
        top = torch.cat([torch.linalg.matrix_exp(cross), shift[:, None]], 1)
        return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])

    def summary(self) -> str:
        """How far the corrections went: root mean squares over the views."""
        found = []
        for name, part in zip(self.kinds, self.numbers.split(self._sizes(), 1), strict=True):
            kind, sizes = self.kinds[name], part.square().unflatten(1, (-1, 3 if part.shape[1] > 1 else 1)).sum(-1)
            first, *shift = sizes.mean(0).sqrt().tolist()
            if kind == "pose":
                found.append(f"{name} {math.degrees(first):.2g} degrees and {self.unit * shift[0]:.2g}")
            else:
                found.append(f"{name} {first:.1%}" if kind == "factor" else f"{name} {self.unit * first:.2g}")
        return f"corrections of training views, root mean squares, scene units: {', '.join(found)}"

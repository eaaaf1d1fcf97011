"""Training views (cameras with images): loading in advance, strides that select pixels, and learned numbers of a view.

A view's learned numbers are its exposure, and corrections of its camera and of its conditions, such as a light
position.
"""

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
"""Smallest width and height in pixels of a view after a stride selected its pixels: the size of the SSIM window."""

_PIXELS_PER_PRIMITIVE = 1.5
"""Number of covered pixels (alpha above 0) that a training step on the CPU computes in the time of one primitive."""

GPU_LAUNCHES = 70_000
"""Number of primitives that a GPU computes in the time that the kernel launches of one training step take. Smaller
views do not shorten the time of the launches."""

_COUNTED_VIEWS = 16
"""Largest number of training views whose covered pixels are counted. These views are spread evenly over all training
views."""

_STRIDE_STAGES = ((0.7, 1), (0.9, 2))
"""Stages of the automatic stride: (used fraction of the budget at which the stage ends, divisor of the stride). After
the last stage, whole views are rendered."""

_BETA1, _BETA2, _EPS = 0.9, 0.99, 1e-8

_CORRECTION_RATES: dict[Correction, list[float]] = {"pose": [4e-3] * 6, "offset": [5e-3] * 3, "factor": [5e-3]}
"""Kind of correction -> initial learning rates of the numbers of a correction, per step that uses the view. The six
numbers of a pose are a rotation vector in radians and a shift in the ``unit`` of :class:`ViewCorrections`."""

_CORRECTION_START, _CORRECTION_FINAL = 0.1, 0.02
"""Used fraction of the budget at which corrections of views begin, and their last learning rate as a fraction of the
first learning rate. Corrections do not begin earlier, because the model is too blurred to determine them."""


class PixelLoader:
    """Loads the pixels of training views, for a model on the device ``where``.

    For a GPU, a thread loads the next view in advance; this does not change the order of the views. Up to a quarter of
    the free GPU memory caches views, because loading a large view again takes longer than a training step. Images from
    files are cached before their conversion to floats; most have 8 bits per value.
    """

    def __init__(self, dataset: Dataset, where: torch.device) -> None:
        self._dataset, self._device = dataset, where
        self._capacity = device.free_cuda_memory(where) // 4 if where.type == device.CUDA else 0
        self._cache: dict[int, Pixels] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._pending: tuple[int, Future[Pixels]] | None = None

    def _load(self, index: int) -> Pixels:
        pixels = self._dataset.train.pixels(index)
        if not isinstance(pixels, StoredPixels):  # these have the size of their view, and are not floats yet
            check_pixels("train", self._dataset.train.view(index), pixels, self._dataset.channels)
        return pixels if self._device.type == device.CPU else pixels.to(self._device)

    def take(self, index: int, upcoming: int | None) -> Pixels:
        """Return the pixels of view ``index``; for a GPU, start loading view ``upcoming`` (None: no view) on a thread.

        Raises the errors of loading.
        """
        if self._device.type == device.CPU:
            return self._load(index)
        pending, self._pending = self._pending, None
        if index in self._cache:
            pixels = self._cache[index]
        else:
            pixels = pending[1].result() if pending is not None and pending[0] == index else self._load(index)
            stored = pixels.image if isinstance(pixels, StoredPixels) else None
            parts = [stored] if stored is not None else [pixels.rgb, pixels.alpha, pixels.mask]
            size = sum(x.nbytes for x in parts if x is not None)
            if size <= self._capacity:
                self._cache[index], self._capacity = pixels, self._capacity - size
        if upcoming is not None and upcoming not in self._cache:
            self._pool = self._pool or ThreadPoolExecutor(1, thread_name_prefix="neuprim-views")
            self._pending = upcoming, self._pool.submit(copy_context().run, self._load, upcoming)
        # a cached image must not keep its floats
        return StoredPixels(pixels.image) if isinstance(pixels, StoredPixels) and pixels.image is not None else pixels


class PixelStride(NamedTuple):
    """Selects every ``step``-th pixel of a view in x and y, the first at (``column``, ``row``)."""

    step: int = 1
    column: int = 0
    row: int = 0

    def take(self, view: View, pixels: Pixels) -> tuple[View, Pixels]:
        """Return view and pixels, reduced to the selected pixels. Rays and colours are exact, not averaged."""
        if self.step == 1:
            return view, pixels
        return replace(view, camera=view.camera.strided(*self)), pixels.strided(*self)


def count_covered_pixels(views: ViewSet) -> float:
    """Return the mean number of unmasked pixels with alpha above 0 per view, over at most 16 of the views."""
    chosen = range(0, len(views), -(-len(views) // _COUNTED_VIEWS))
    total = 0
    for index in chosen:
        camera, pixels = views.view(index).camera, views.pixels(index)
        alpha = pixels.alpha  # does not convert the colours of stored images
        covered = torch.ones(camera.height, camera.width, dtype=torch.bool) if alpha is None else alpha > 0
        total += int((covered if pixels.mask is None else covered & pixels.mask).sum())
    return total / len(chosen)


def choose_stride(stride: int | Literal["auto"], covered: float, primitives: int, progress: float) -> int:
    """Return the stride of the pixels to render at ``progress``, the used fraction of the budget.

    A ``stride`` that is a number is returned unchanged. ``auto`` makes a step spend as much time on pixels as on
    primitives, because training learns less per second with other strides. The time of the pixels falls with the square
    of the stride; the time of the primitives does not depend on the stride. The last stages of the training use smaller
    strides. The result depends only on the arguments, not on measured times.

    Args:
        covered: mean number of covered pixels (alpha above 0) per view.
        primitives: number of primitives; for a GPU, plus :data:`GPU_LAUNCHES`.
    """
    if stride != "auto":
        return stride
    divisor = next((divisor for until, divisor in _STRIDE_STAGES if progress < until), None)
    balance = round(math.sqrt(covered / (_PIXELS_PER_PRIMITIVE * primitives)))
    return 1 if divisor is None else max(-(-balance // divisor), 1)


def draw_stride(stride: int, view: View, generator: torch.Generator) -> PixelStride:
    """Select every ``stride``-th pixel from a random first pixel; lower the stride until 11 x 11 pixels remain."""
    stride = max(min(stride, min(view.camera.width, view.camera.height) // _MIN_SIDE), 1)
    if stride == 1:
        return PixelStride()
    column, row = torch.randint(stride, (2,), generator=generator).tolist()
    return PixelStride(stride, column, row)


def hash_training_views(views: ViewSet) -> str:
    """Return a hash of the names of all views, to detect other data with the same number of views."""
    text = "\n".join(views.view(i).name for i in range(len(views)))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class _NumbersOfViews:
    """Learned numbers of each training view, for example its exposure. Adam updates them in steps that use the view.

    ``rates`` are the initial learning rates of the numbers of one view.
    """

    def __init__(self, views: int, rates: list[float], device: torch.device) -> None:
        self.rates = torch.tensor(rates, device=device)
        self.numbers = torch.zeros(views, len(rates), device=device)
        self.m, self.v = torch.zeros_like(self.numbers), torch.zeros_like(self.numbers)
        self.seen = torch.zeros(views, dtype=torch.int64)
        self._rows: dict[int, Tensor] = {}

    def row(self, index: int) -> Tensor:
        """Return the learned numbers of view ``index`` as a new leaf tensor; :meth:`gradient` returns its gradient."""
        self._rows[index] = row = self.numbers[index].clone().requires_grad_()
        return row

    def gradient(self, index: int) -> list[float] | None:
        """Return the gradient of the tensor that :meth:`row` returned for view ``index`` before the backward pass.

        Returns None if the tensor got no gradient.
        """
        grad = self._rows.pop(index).grad
        return None if grad is None else [float(x) for x in grad.tolist()]

    def step(self, gradients: Mapping[int, list[float] | None], factor: float = 1.0) -> None:
        """Take an Adam step with ``gradients``, view index -> gradient or None; ``factor`` multiplies the rates."""
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
        """Return the tensors that a checkpoint needs."""
        return {"numbers": self.numbers, "m": self.m, "v": self.v, "seen": self.seen}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore the result of :meth:`state`, whose tensors must have the same shapes."""
        self.numbers, self.m, self.v = state["numbers"], state["m"], state["v"]
        self.seen = state["seen"].cpu()


class Exposures(_NumbersOfViews):
    """A learned gain per training view and channel, which multiplies the rendered image before the loss.

    Adam updates the logarithms of the gains. The geometric mean over the views stays 1, so that the model has the mean
    exposure of the photographs. Held-out views are rendered with this mean exposure.
    """

    def __init__(self, views: int, channels: int, rate: float, device: torch.device) -> None:
        super().__init__(views, [rate] * channels, device)

    def apply(self, index: int, rgb: Tensor) -> Tensor:
        """Return the rendered image (H, W, C) multiplied by the gains of view ``index``."""
        return rgb * self.row(index).exp()

    def step(self, gradients: Mapping[int, list[float] | None], factor: float = 1.0) -> None:
        super().step(gradients, factor)
        if gradients:
            self.numbers -= self.numbers.mean(0)


class ViewCorrections(_NumbersOfViews):
    """Learned corrections of training views whose given cameras or conditions are inexact (``Dataset.refine``).

    The correction of a pose is a shift, and a rotation around the point that the cameras look at. A rotation around the
    camera itself would change the image almost as a shift does, so that Adam would learn rotation and shift slowly. The
    part of the corrections that moves, rotates or scales all cameras alike is removed. Images do not determine this
    part, and with it the model would no longer fit the held-out cameras.

    Args:
        cameras: (V, 4, 4) given world-to-camera matrices of the training views.
        kinds: "camera" or the name of a condition -> its correction, "pose", "offset" or "factor". A pose is a rotation
            vector and a shift in camera axes. An offset is added to a position. For a factor, the logarithm is learned.
        unit: length of one unit of shifts and offsets, in scene units.
    """

    def __init__(self, cameras: Tensor, kinds: Mapping[str, Correction], unit: float, device: torch.device) -> None:
        rates = [rate for kind in kinds.values() for rate in _CORRECTION_RATES[kind]]
        super().__init__(len(cameras), rates, device)
        self.kinds, self.unit = kinds, unit
        rotations, shifts = cameras[:, :3, :3].double().cpu(), cameras[:, :3, 3].double().cpu()
        self._pivots = rotations @ _looked_at(rotations, shifts) + shifts
        none = torch.zeros_like(rotations)
        turned, moved = torch.cat([rotations, none], 1), torch.cat([none, rotations], 1)
        nearer = torch.cat([torch.zeros_like(shifts), self._pivots / unit], 1)[..., None]
        self._alike = torch.cat([turned, moved, nearer], 2).flatten(0, 1)  # (6 V, 7): poses that move all cameras alike
        self._alike_inverse = torch.linalg.pinv(self._alike)

    def step_at(self, progress: float, gradients: Mapping[int, list[float] | None]) -> None:
        """Take an Adam step on the corrections of some views at ``progress``, the used fraction of the budget.

        ``gradients`` maps a view's index to the gradient of the view's corrections. In the first tenth of the budget,
        no correction changes.
        """
        if progress < _CORRECTION_START:
            return
        self.step(gradients, _CORRECTION_FINAL ** ((progress - _CORRECTION_START) / (1 - _CORRECTION_START)))
        if "pose" in self.kinds.values():
            first = sum(self._sizes()[: list(self.kinds.values()).index("pose")])
            poses = self.numbers[:, first : first + 6]
            alike = self._alike @ (self._alike_inverse @ poses.flatten().double().cpu())
            poses -= alike.view(poses.shape).to(poses)

    def apply(self, index: int, view: View) -> View:
        """Return view ``index`` with its corrections applied."""
        row, conditions, camera = self.row(index).double(), dict(view.conditions), view.camera
        for name, part in zip(self.kinds, row.split(self._sizes()), strict=True):
            if name in conditions:
                value = conditions[name]
                part = part.to(value)
                conditions[name] = value * part.exp() if self.kinds[name] == "factor" else value + self.unit * part
            else:
                motion = self._motion(part.cpu(), self._pivots[index])
                camera = replace(camera, viewmat=motion @ camera.viewmat.double())
        return replace(view, camera=camera, conditions=conditions)

    def _sizes(self) -> list[int]:
        return [len(_CORRECTION_RATES[kind]) for kind in self.kinds.values()]

    def _motion(self, part: Tensor, pivot: Tensor) -> Tensor:
        """Return the (4, 4) rigid transform of a pose correction, in camera coordinates.

        ``part`` (6,) is a rotation vector in radians, around ``pivot`` (3,), and a shift in units of ``self.unit``.
        """
        (x, y, z), shift = part[:3], self.unit * part[3:]
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
        rotation = torch.linalg.matrix_exp(cross)
        top = torch.cat([rotation, (shift + pivot - rotation @ pivot)[:, None]], 1)
        return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])

    def summary(self) -> str:
        """Return a log line with the size of each correction: its root mean square over the training views."""
        found = []
        for name, part in zip(self.kinds, self.numbers.split(self._sizes(), 1), strict=True):
            kind, sizes = self.kinds[name], part.square().unflatten(1, (-1, 3 if part.shape[1] > 1 else 1)).sum(-1)
            first, *shift = sizes.mean(0).sqrt().tolist()
            if kind == "pose":
                found.append(f"{name} {math.degrees(first):.2g} degrees and {self.unit * shift[0]:.2g}")
            else:
                found.append(f"{name} {first:.1%}" if kind == "factor" else f"{name} {self.unit * first:.2g}")
        return f"corrections of training views, root mean squares, scene units: {', '.join(found)}"


def _looked_at(rotations: Tensor, shifts: Tensor) -> Tensor:
    """Return the (3,) point nearest to the optical axes of V cameras, which minimises the sum of squared distances.

    ``rotations`` (V, 3, 3) and ``shifts`` (V, 3) are the parts of the world-to-camera matrices. Axes that are parallel
    within about 3 degrees do not determine the depth of the point. The point then has the depth of the mean camera
    centre, because a rotation around a far point would move the cameras far.
    """
    sideways = rotations[:, :2].flatten(0, 1)  # (2 V, 3): a point on an axis has the camera coordinates (0, 0, z)
    middle = -(rotations.transpose(1, 2) @ shifts[..., None]).mean(0)[:, 0]
    off = -(shifts[:, :2].flatten() + sideways @ middle)
    return middle + torch.linalg.pinv(sideways, rtol=0.05) @ off

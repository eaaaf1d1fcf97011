"""Training views: loaded one ahead on a GPU, reduced early in the training, with a gain per photograph."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.core.data import Pixels, View, ViewSet
from neuprim.core.data.image_views import average_pixels, reduce_image_mask

_MIN_SIDE = 16
"""Pixels along a side that no reduction goes below."""

_BETA1, _BETA2, _EPS = 0.9, 0.99, 1e-8


class Prefetcher:
    """Loads the pixels of the next view in a thread; it does not change which views are used.

    Args:
        load: (index of a view) -> its pixels on the training's device; the same every time.
        capacity: bytes of pixels to keep: loading a large view again takes longer than a step.
    """

    def __init__(self, load: Callable[[int], Pixels], capacity: int) -> None:
        self._load, self._capacity = load, capacity
        self._cache: dict[int, Pixels] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._pending: tuple[int, Future[Pixels]] | None = None

    def take(self, index: int, upcoming: int | None) -> Pixels:
        """Return a view's pixels, and start loading those of ``upcoming``, if it is known. Raises what loading did."""
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


def resolution_factor(progress: float, coarse: int, until: float) -> int:
    """Factor by which views are reduced at this used fraction of the budget.

    It starts at ``coarse`` and is halved, rounded down, after equal shares of the time up to ``until``; from there on
    it is 1.
    """
    if coarse <= 1 or progress >= until:
        return 1
    stages = coarse.bit_length() - 1
    return coarse >> min(int(progress / until * stages), stages)


def reduce_training_view(view: View, pixels: Pixels, factor: int) -> tuple[View, Pixels]:
    """Average a view over blocks of ``factor`` x ``factor`` pixels; the remainder at the right and bottom is cut off.

    Colours are premultiplied, so the mean is what a camera with larger pixels sees. A large pixel is valid where all
    of its parts are.
    """
    camera = view.camera
    while factor > 1 and min(camera.width, camera.height) // factor < _MIN_SIDE:
        factor //= 2
    if factor == 1:
        return view, pixels
    alpha = None if pixels.alpha is None else average_pixels(pixels.alpha[..., None], factor)[..., 0]
    mask = None if pixels.mask is None else reduce_image_mask(pixels.mask, factor)
    return replace(view, camera=camera.reduced(factor)), Pixels(average_pixels(pixels.rgb, factor), alpha, mask)


def hash_training_views(views: ViewSet) -> str:
    """Hash the names of views: other frames or images of the same number are other data."""
    text = "\n".join(views.view(i).name for i in range(len(views)))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Exposures:
    """A factor per training view and channel, by which a rendered image is multiplied before it is compared.

    Adam learns the logarithms of the factors at ``rate``, each in the steps that use its view. The geometric mean over
    the views stays 1, so that the model keeps the photographs' mean exposure, with which held-out views are rendered.
    """

    def __init__(self, views: int, channels: int, rate: float, device: torch.device) -> None:
        self.rate = rate
        self.log_gain = torch.zeros(views, channels, device=device)
        self.m, self.v = torch.zeros_like(self.log_gain), torch.zeros_like(self.log_gain)
        self.seen = torch.zeros(views, dtype=torch.int64)
        self._applied: dict[int, Tensor] = {}

    def apply(self, index: int, rgb: Tensor) -> Tensor:
        """(H, W, C) as the camera of view ``index`` would have exposed it."""
        gain = self.log_gain[index].clone().requires_grad_()
        self._applied[index] = gain
        return rgb * gain.exp()

    def gradient(self, index: int) -> list[float] | None:
        """Gradient of the logarithms of a view's factors, after its backward pass; None without one."""
        grad = self._applied.pop(index).grad
        return None if grad is None else [float(x) for x in grad.tolist()]

    def step(self, gradients: Mapping[int, list[float] | None]) -> None:
        """Move the factors of a step's views by their gradients."""
        for index, numbers in gradients.items():
            if numbers is None:
                continue
            grad = torch.tensor(numbers, device=self.log_gain.device)
            self.seen[index] += 1
            n = int(self.seen[index])
            self.m[index] += (1 - _BETA1) * (grad - self.m[index])
            self.v[index] += (1 - _BETA2) * (grad.square() - self.v[index])
            scale = math.sqrt(1 - _BETA2**n) / (1 - _BETA1**n)
            self.log_gain[index] -= self.rate * scale * self.m[index] / (self.v[index].sqrt() + _EPS)
        if gradients:
            self.log_gain -= self.log_gain.mean(0)

    def state(self) -> dict[str, Tensor]:
        """Tensors from which :meth:`load_state` goes on."""
        return {"log_gain": self.log_gain, "m": self.m, "v": self.v, "seen": self.seen}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continue from a checked state."""
        self.log_gain, self.m, self.v = state["log_gain"], state["m"], state["v"]
        self.seen = state["seen"].cpu()

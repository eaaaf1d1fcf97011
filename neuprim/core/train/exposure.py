"""Learn a gain for every training image: photographs of one scene are not all exposed alike."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

_BETA1, _BETA2, _EPS = 0.9, 0.99, 1e-8


class Exposures:
    """A factor per training view and channel, by which a rendered image is multiplied before it is compared.

    Adam learns the logarithms of the factors, each in the steps that use its view. The geometric mean over the views
    stays 1, so that the model keeps the photographs' mean exposure, with which held-out views are rendered.

    Args:
        views: number of training views.
        channels: number of colour channels.
        rate: learning rate of the logarithms.
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

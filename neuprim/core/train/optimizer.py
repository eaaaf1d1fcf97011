"""Adam whose every row has its own step count.

Population control creates primitives in the middle of a run. A fresh row with zero moments but an old step count would
take a first step 3.2 times its rate (method: "splitting exactly"), so bias correction counts per row.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import NonFiniteError
from neuprim.core.render.cpu.compile import exact_kernel
from neuprim.core.render.cpu.threads import parallel_for
from neuprim.core.schema import ParameterSpec

__all__ = ["RowAdam", "adam_step_reference"]

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15


def adam_step_reference(value: Tensor, grad: Tensor, m: Tensor, v: Tensor, rate: float, age: Tensor) -> None:
    """One in-place Adam step (Kingma and Ba 2015) of an (N, ...) tensor; ``age`` (N,) counts each row's steps, this one included."""
    shape = (-1, *[1] * (value.dim() - 1))
    m.mul_(BETA1).add_(grad, alpha=1 - BETA1)
    v.mul_(BETA2).addcmul_(grad, grad, value=1 - BETA2)
    c1 = (1 - BETA1 ** age.to(value)).reshape(shape)
    c2 = (1 - BETA2 ** age.to(value)).reshape(shape)
    value.sub_(rate * (m / c1) / ((v / c2).sqrt() + EPS))


@exact_kernel
def _adam_rows(start, stop, width, value, grad, m, v, step, root):  # type: ignore[no-untyped-def]
    """The same on flat float32 arrays of ``width`` numbers per row; step = rate / c1 and root = sqrt(1 / c2) per row.

    Rows of one age stand together nearly everywhere, so they are taken in runs: long loops that vectorise.
    """
    one, b1, b2, eps = np.float32(1), np.float32(BETA1), np.float32(BETA2), np.float32(EPS)
    i = start
    while i < stop:
        j = i + 1
        while j < stop and step[j] == step[i]:
            j += 1
        a, r = step[i], root[i]
        x, g, mi, vi = value[i * width : j * width], grad[i * width : j * width], m[i * width : j * width], v[i * width : j * width]
        for k in range(x.shape[0]):
            mk = b1 * mi[k] + (one - b1) * g[k]
            vk = b2 * vi[k] + (one - b2) * g[k] * g[k]
            mi[k] = mk
            vi[k] = vk
            x[k] -= a * mk / (np.sqrt(vk) * r + eps)
        i = j


class RowAdam:
    """Adam over the parameters of a model.

    Attributes:
        m, v: first and second moments by parameter name.
        age: (N,) steps every row has taken, float32-exact integers.
    """

    def __init__(self, specs: Iterable[ParameterSpec], params: dict[str, Tensor]) -> None:
        self.specs = tuple(specs)
        self.m = {s.name: torch.zeros_like(params[s.name]) for s in self.specs}
        self.v = {s.name: torch.zeros_like(params[s.name]) for s in self.specs}
        self.age = torch.zeros(params["means"].shape[0], dtype=torch.int64)

    def step(self, params: dict[str, Tensor], rates: dict[str, float]) -> None:
        """Update ``params`` in place from their ``.grad``.

        Raises:
            NonFiniteError: a gradient is NaN or infinite; names parameter and primitive, and changes nothing.
        """
        grads = {s.name: params[s.name].grad for s in self.specs}
        for name, grad in grads.items():
            if grad is not None and not bool(torch.isfinite(grad.sum())):
                bad = ~torch.isfinite(grad.reshape(grad.shape[0], -1)).all(dim=1)
                if bool(bad.any()):
                    row = int(bad.nonzero()[0])
                    raise NonFiniteError(f"gradient of {name} of primitive {row} is not finite: {grad[row].flatten()[:8].tolist()}")
        self.age += 1
        age = self.age.numpy().astype(np.float64)
        c1, c2 = 1 - BETA1**age, 1 - BETA2**age
        root = np.sqrt(1 / c2).astype(np.float32)
        with torch.no_grad():
            for spec in self.specs:
                value, grad = params[spec.name], grads[spec.name]
                if grad is None or value.numel() == 0:
                    continue
                if value.device.type == "cpu" and value.dtype == torch.float32:
                    step = (rates[spec.name] / c1).astype(np.float32)
                    arrays = [x.detach().reshape(-1).numpy() for x in (value, grad.contiguous(), self.m[spec.name], self.v[spec.name])]
                    parallel_for(_adam_rows, value.shape[0], 1024, 0, spec.size, *arrays, step, root)
                else:
                    adam_step_reference(value, grad, self.m[spec.name], self.v[spec.name], rates[spec.name], self.age)

    def select(self, rows: Tensor, fresh: Tensor) -> None:
        """Follow a change of population: keep ``rows`` (in their new order); where ``fresh`` is set, start again from nothing."""
        for moments in (self.m, self.v):
            for name in moments:
                moments[name] = moments[name][rows]
                moments[name][fresh] = 0
        self.age = self.age[rows]
        self.age[fresh] = 0

    def state(self) -> dict[str, Tensor]:
        """Tensors a checkpoint needs."""
        return {**{f"m.{k}": t for k, t in self.m.items()}, **{f"v.{k}": t for k, t in self.v.items()}, "age": self.age}

    def load_state(self, state: dict[str, Tensor]) -> None:
        for name in self.m:
            self.m[name], self.v[name] = state[f"m.{name}"].clone(), state[f"v.{name}"].clone()
        self.age = state["age"].clone()

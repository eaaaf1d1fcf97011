"""Adam whose every row has its own step count.

Population control creates primitives in the middle of a run. A fresh row with zero moments but an old step count would
take a first step 3.2 times its rate (method: "splitting exactly"), so bias correction counts per row.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.threads import parallel_for
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.schema import ParameterSpec

__all__ = ["RowAdam", "adam_step_reference"]

BETA1, EPS = 0.9, 1e-15
_CHUNK_NUMBERS = 65_536  # numbers per unit of work; fixed, although the result does not depend on it


def adam_step_reference(
    value: Tensor, grad: Tensor, m: Tensor, v: Tensor, rate: float, age: Tensor, beta2: float = 0.999
) -> None:
    """One in-place Adam step (Kingma and Ba 2015) of an (N, ...) tensor; ``age`` (N,) counts each row's steps, this one
    included."""
    shape = (-1, *[1] * (value.dim() - 1))
    m.mul_(BETA1).add_(grad, alpha=1 - BETA1)
    v.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
    c1 = (1 - BETA1 ** age.to(value)).reshape(shape)
    c2 = (1 - beta2 ** age.to(value)).reshape(shape)
    value.sub_(rate * (m / c1) / ((v / c2).sqrt() + EPS))


@exact_kernel
def _adam_rows(start, stop, width, value, grad, m, v, rate, beta2, age, breaks, correction, root):  # type: ignore[no-untyped-def]
    """The same on flat float32 arrays of ``width`` numbers per row; of each age, correction = 1 / c1 and root = sqrt(1
    / c2).

    Rows of one age stand together nearly everywhere, so they are taken in runs, which end at ``breaks``: long loops
    that vectorise.
    """
    b1, b2, one_b1, one_b2, eps = (
        np.float32(BETA1),
        np.float32(beta2),
        np.float32(1 - BETA1),
        np.float32(1 - beta2),
        np.float32(EPS),
    )
    i, run = start, np.searchsorted(breaks, start, "right")
    while i < stop:
        j = min(stop, breaks[run]) if run < breaks.shape[0] else stop
        run += 1
        a, r = np.float32(rate * correction[age[i]]), np.float32(root[age[i]])
        x, g, mi, vi = (
            value[i * width : j * width],
            grad[i * width : j * width],
            m[i * width : j * width],
            v[i * width : j * width],
        )
        for k in range(x.shape[0]):
            mk = b1 * mi[k] + one_b1 * g[k]
            vk = b2 * vi[k] + one_b2 * g[k] * g[k]
            mi[k] = mk
            vi[k] = vk
            x[k] -= a * mk / (np.sqrt(vk) * r + eps)
        i = j


@exact_kernel
def _largest_bits(x):  # type: ignore[no-untyped-def]
    """The largest of float32 numbers' bits without their signs: those of infinity or more where one is not finite."""
    bits = x.view(np.uint32)
    largest = np.uint32(0)
    for k in range(
        bits.shape[0]
    ):  # of whole numbers the largest is found in any order: a loop that vectorises, which a sum is not
        largest = max(largest, bits[k] & np.uint32(0x7FFFFFFF))
    return largest


_INFINITY = 0x7F800000


def _check_gradient(name: str, grad: Tensor) -> None:
    if device.on_numba(grad) and grad.dtype == torch.float32:
        fine = _largest_bits(grad.contiguous().reshape(-1).numpy()) < _INFINITY
    else:
        fine = bool(torch.isfinite(grad).all())
    if not fine:
        row = int((~torch.isfinite(grad.reshape(grad.shape[0], -1)).all(dim=1)).nonzero()[0])
        raise NonFiniteError(f"gradient of {name} of primitive {row} is not finite: {grad[row].flatten()[:8].tolist()}")


def _all_finite(gradients: list[Tensor]) -> bool:
    """Whether they are, in one wait for a card: of a NaN and anything the largest is a NaN."""
    if not gradients:
        return True
    return bool(torch.isfinite(torch.stack([torch.linalg.vector_norm(g, torch.inf).double() for g in gradients])).all())


@lru_cache(maxsize=4)
def _corrections(beta2: float, ages: int) -> tuple[np.ndarray, np.ndarray]:
    """1 / c1 and sqrt(1 / c2) of the ages 0 to ``ages`` - 1; powers take longer than all else that a step does per
    row."""
    age = np.arange(1.0, ages)
    return np.append(0.0, 1 / (1 - BETA1**age)), np.append(0.0, np.sqrt(1 / (1 - beta2**age)))


class RowAdam:
    """Adam over the parameters of a model.

    Attributes:
        m, v: first and second moments by parameter name.
        age: (N,) steps every row has taken, float32-exact integers.
        beta2: decay of the second moment; short runs do better with a shorter memory.
    """

    def __init__(self, specs: Iterable[ParameterSpec], params: dict[str, Tensor], beta2: float = 0.999) -> None:
        self.beta2 = beta2
        self.specs = tuple(specs)
        self.m = {s.name: torch.zeros_like(params[s.name]) for s in self.specs}
        self.v = {s.name: torch.zeros_like(params[s.name]) for s in self.specs}
        self.age = torch.zeros(params["means"].shape[0], dtype=torch.int64, device=params["means"].device)

    def step(self, params: dict[str, Tensor], rates: dict[str, float]) -> None:
        """Update ``params`` in place from their ``.grad``.

        Raises:
            NonFiniteError: a gradient is NaN or infinite; names parameter and primitive, and changes nothing.
        """
        updates = []
        for spec in self.specs:
            value, grad = params[spec.name].detach(), params[spec.name].grad
            if grad is not None and value.numel():
                updates.append((spec, value, grad))
        if updates and device.on_warp(self.age) and self._step_kernels(updates, rates):
            return
        fused = device.on_numba(self.age)
        if fused or not _all_finite([grad for _, _, grad in updates]):
            for spec, _, grad in updates:
                _check_gradient(spec.name, grad)
        self.age += 1
        if not fused:
            self._step_rows(updates, rates)
            return
        age = self.age.numpy()
        breaks = np.flatnonzero(age[1:] != age[:-1]) + 1
        correction, root = _corrections(self.beta2, 1 << int(age.max(initial=0)).bit_length())
        work = []  # (arguments of _adam_rows), small enough to share out
        for spec, value, grad in updates:
            m, v, rate = self.m[spec.name], self.v[spec.name], rates[spec.name]
            if value.dtype == torch.float32:
                flat = [x.reshape(-1).numpy() for x in (value, grad.contiguous(), m, v)]
                rows = max(_CHUNK_NUMBERS // spec.size, 1)
                starts = range(0, value.shape[0], rows)
                work += [
                    (
                        r,
                        min(r + rows, value.shape[0]),
                        spec.size,
                        *flat,
                        rate,
                        self.beta2,
                        age,
                        breaks,
                        correction,
                        root,
                    )
                    for r in starts
                ]
            else:
                adam_step_reference(value, grad, m, v, rate, self.age, self.beta2)

        def share(start: int, stop: int) -> None:
            for arguments in work[start:stop]:
                _adam_rows(*arguments)

        parallel_for(share, len(work), 1, 0)

    def _step_kernels(self, updates: list[tuple[ParameterSpec, Tensor, Tensor]], rates: dict[str, float]) -> bool:
        """The update in two launches on a card; False, and nothing done, where it cannot be or a gradient is not
        finite."""
        from neuprim.core.train.adam_warp import adam_rows

        values, grads = [value for _, value, _ in updates], [grad for _, _, grad in updates]
        first, second = ([moments[spec.name] for spec, _, _ in updates] for moments in (self.m, self.v))
        groups = (values, grads, first, second)
        if not all(x.dtype == torch.float32 for group in groups for x in group) or not all(
            x.is_contiguous() for x in (*values, *first, *second)
        ):
            return False
        age, betas = self.age + 1, (BETA1, self.beta2)
        if not adam_rows(
            values,
            grads,
            first,
            second,
            [rates[s.name] for s, _, _ in updates],
            age,
            betas,
            (math.log(BETA1), math.log(self.beta2)),
        ):
            return False
        self.age = age
        return True

    def _step_rows(self, updates: list[tuple[ParameterSpec, Tensor, Tensor]], rates: dict[str, float]) -> None:
        """The update in torch code, in the arithmetic of the kernel."""
        if not updates:
            return
        age = self.age.double()
        correction, root = 1 / (1 - BETA1**age), (1 / (1 - self.beta2**age)).sqrt()
        gradients = [grad for _, _, grad in updates]
        first, second = ([moments[spec.name] for spec, _, _ in updates] for moments in (self.m, self.v))
        torch._foreach_mul_(first, BETA1)
        torch._foreach_add_(first, gradients, alpha=1 - BETA1)
        torch._foreach_mul_(second, self.beta2)
        torch._foreach_addcmul_(second, gradients, gradients, value=1 - self.beta2)
        for (spec, value, _), m, size in zip(updates, first, torch._foreach_sqrt(second), strict=True):
            shape = (-1, *[1] * (value.dim() - 1))
            step, slow = (x.to(value).reshape(shape) for x in (rates[spec.name] * correction, root))
            value.sub_((m * step).div_(size.mul_(slow).add_(EPS)))

    def select(self, rows: Tensor, fresh: Tensor) -> None:
        """Follow a change of population: keep ``rows`` (in their new order); where ``fresh`` is set, start again from
        nothing."""
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
            self.m[name], self.v[name] = (state[f"{moment}.{name}"].to(self.age.device, copy=True) for moment in "mv")
        self.age = state["age"].to(self.age.device, copy=True)

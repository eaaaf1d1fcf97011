"""Adam optimizer with a step count for each primitive (row of a parameter), instead of one count for all.

Population control creates primitives in the middle of a run, with zero moments. If all primitives had the same count,
the first step of a new primitive would be 3.2 times its learning rate. So Adam's bias correction uses the primitive's
own count.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.threads import parallel_for
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.schema import ParameterSpec

BETA1, EPS = 0.9, 1e-15
_CHUNK_NUMBERS = 65_536  # numbers per unit of work; fixed, although the result does not depend on it
_INFINITY = 0x7F800000  # bits of a float32


def adam_step_reference(
    value: Tensor, grad: Tensor, m: Tensor, v: Tensor, rate: float, age: Tensor, beta2: float = 0.999
) -> None:
    """Take one Adam step (Kingma and Ba 2015) in place on an (N, ...) tensor, which has one row per primitive.

    ``m`` and ``v`` are Adam's moments. ``age`` (N,) counts the steps of each row, including this one.
    """
    shape = (-1, *[1] * (value.dim() - 1))
    m.mul_(BETA1).add_(grad, alpha=1 - BETA1)
    v.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
    c1, c2 = ((1 - beta ** age.double()).to(value).reshape(shape) for beta in (BETA1, beta2))
    value.sub_(rate * (m / c1) / ((v / c2).sqrt() + EPS))


@exact_kernel
def _adam_rows(start, stop, width, value, grad, m, v, rate, beta2, age, breaks, correction, root):  # type: ignore[no-untyped-def]
    """Take an Adam step on rows start:stop of flat float32 arrays, ``width`` numbers per row.

    The step is that of :func:`adam_step_reference`. ``correction[age]`` is 1 / (1 - BETA1^age) and ``root[age]`` is
    sqrt(1 / (1 - beta2^age)). ``breaks`` are the rows whose ``age`` differs from the age of the row before. Most
    neighbouring rows have the same age, so the rows between two breaks are updated in one long loop, which vectorises.
    """
    b1, b2, eps = np.float32(BETA1), np.float32(beta2), np.float32(EPS)
    one_b1, one_b2 = np.float32(1 - BETA1), np.float32(1 - beta2)
    i, run = start, np.searchsorted(breaks, start, "right")
    while i < stop:
        j = min(stop, breaks[run]) if run < breaks.shape[0] else stop
        run += 1
        a, r = np.float32(rate * correction[age[i]]), np.float32(root[age[i]])
        x, g = value[i * width : j * width], grad[i * width : j * width]
        mi, vi = m[i * width : j * width], v[i * width : j * width]
        for k in range(x.shape[0]):
            mk = b1 * mi[k] + one_b1 * g[k]
            vk = b2 * vi[k] + one_b2 * g[k] * g[k]
            mi[k] = mk
            vi[k] = vk
            x[k] -= a * mk / (np.sqrt(vk) * r + eps)
        i = j


@exact_kernel
def _largest_gradient_bits_of_step(x):  # type: ignore[no-untyped-def]
    """Return the largest bit pattern of the absolute values in a float32 array, as uint32.

    The result is at least the bit pattern of infinity exactly if a value is NaN or infinite.
    """
    bits = x.view(np.uint32)
    largest = np.uint32(0)
    for k in range(bits.shape[0]):  # a maximum of integers vectorises, a sum of floats does not
        largest = max(largest, bits[k] & np.uint32(0x7FFFFFFF))
    return largest


def _all_gradients_finite(gradients: list[Tensor]) -> bool:
    if all(device.on_numba(g) and g.dtype == torch.float32 for g in gradients):
        return all(_largest_gradient_bits_of_step(g.contiguous().reshape(-1).numpy()) < _INFINITY for g in gradients)
    # one wait for the GPU; the largest of a NaN and anything is a NaN
    return bool(torch.isfinite(torch.stack([torch.linalg.vector_norm(g, torch.inf).double() for g in gradients])).all())


@lru_cache(maxsize=4)
def _bias_corrections(beta2: float, ages: int) -> tuple[np.ndarray, np.ndarray]:
    """Return two tables of Adam's bias correction, by age (number of steps of a row) from 0 to ``ages`` - 1.

    The tables are 1 / (1 - BETA1^age) and sqrt(1 / (1 - beta2^age)), with 0 for age 0. The tables are cached, because
    the powers take longer than the rest of the Adam step of a row.
    """
    age = np.arange(1.0, ages)
    return np.append(0.0, 1 / (1 - BETA1**age)), np.append(0.0, np.sqrt(1 / (1 - beta2**age)))


class _ParameterUpdate(NamedTuple):
    name: str
    value: Tensor
    grad: Tensor
    m: Tensor
    v: Tensor
    rate: Any  # float, or a tensor with one number


class RowAdam:
    """Adam optimizer of a model's parameters, with a step count for each primitive.

    Attributes:
        m, v: first and second moments by parameter name.
        age: (N,) int64, number of steps of each primitive.
        beta2: decay of the second moment per step; a smaller value is better for short runs.
    """

    def __init__(self, specs: Iterable[ParameterSpec], params: dict[str, Tensor], beta2: float = 0.999) -> None:
        self.beta2 = beta2
        self.specs = tuple(specs)
        self.m = {s.name: torch.zeros_like(params[s.name]) for s in self.specs}
        self.v = {s.name: torch.zeros_like(params[s.name]) for s in self.specs}
        self.age = torch.zeros(params["means"].shape[0], dtype=torch.int64, device=params["means"].device)

    def step(self, params: dict[str, Tensor], rates: dict[str, float]) -> None:
        """Update ``params`` in place from their ``.grad``, and clamp them to the lower bounds in ``specs``.

        Args:
            rates: learning rate by parameter name.

        Raises:
            NonFiniteError: a gradient is NaN or infinite. No parameter changes; the message names the parameter and the
                primitive.
        """
        updates = self._updates(params, rates)
        float32 = all(update.value.dtype == torch.float32 for update in updates)
        if updates and float32 and device.on_warp(self.age):
            refused = torch.zeros(1, dtype=torch.int32, device=self.age.device)
            self._step_on_gpu(updates, torch.tensor([u.rate for u in updates], device=self.age.device), refused)
            if int(refused):
                raise NonFiniteError(_describe_bad_gradient(updates))
        else:
            self._step(updates, float32 and device.on_numba(self.age))
        self._clamp(params)

    def step_recorded(self, params: dict[str, Tensor], rates: Tensor, refused: Tensor) -> None:
        """Update float32 ``params`` on a GPU from their ``.grad``, without waiting for the GPU.

        Args:
            rates: (P,) float32, learning rate of each parameter, in the order of ``specs``.
            refused: (1,) int32 flag. A gradient that is NaN or infinite sets the flag. If the flag is set, no parameter
                changes.
        """
        updates = self._updates(params, {spec.name: rate for spec, rate in zip(self.specs, rates, strict=True)})
        self._step_on_gpu(updates, torch.stack([update.rate for update in updates]), refused)
        self._clamp(params)

    def _updates(self, params: dict[str, Tensor], rates: Mapping[str, Any]) -> list[_ParameterUpdate]:
        updates = []
        for name in (spec.name for spec in self.specs):
            grad = params[name].grad
            if grad is not None and grad.numel():
                updates.append(
                    _ParameterUpdate(name, params[name].detach(), grad, self.m[name], self.v[name], rates[name])
                )
        return updates

    def _clamp(self, params: dict[str, Tensor]) -> None:
        for spec in self.specs:
            if spec.low > -math.inf:
                params[spec.name].detach().clamp_(min=spec.low)

    def _step(self, updates: list[_ParameterUpdate], fused: bool) -> None:
        if updates and not _all_gradients_finite([update.grad for update in updates]):
            raise NonFiniteError(_describe_bad_gradient(updates))
        self.age += 1
        if fused:
            self._step_on_cpu(updates)
            return
        for update in updates:
            adam_step_reference(update.value, update.grad, update.m, update.v, update.rate, self.age, self.beta2)

    def _step_on_gpu(self, updates: list[_ParameterUpdate], rates: Tensor, refused: Tensor) -> None:
        from neuprim.core.train.kernels_warp import adam_rows

        _, values, grads, first, second, _ = zip(*updates, strict=True)
        adam_rows(values, grads, first, second, rates, self.age, (BETA1, self.beta2), refused)

    def _step_on_cpu(self, updates: list[_ParameterUpdate]) -> None:
        age = self.age.numpy()
        breaks = np.flatnonzero(age[1:] != age[:-1]) + 1
        shared = (self.beta2, age, breaks, *_bias_corrections(self.beta2, 1 << int(age.max(initial=0)).bit_length()))
        work: list[tuple[Any, ...]] = []  # arguments of _adam_rows, small enough to share out
        for update in updates:
            count, width = len(update.value), update.value[0].numel()
            rows = max(_CHUNK_NUMBERS // width, 1)
            flat = [x.reshape(-1).numpy() for x in (update.value, update.grad.contiguous(), update.m, update.v)]
            work += [(at, min(at + rows, count), width, *flat, update.rate, *shared) for at in range(0, count, rows)]

        def step_rows(start: int, stop: int) -> None:
            for arguments in work[start:stop]:
                _adam_rows(*arguments)

        parallel_for(step_rows, len(work), 1, 0)

    def select(self, rows: Tensor, fresh: Tensor) -> None:
        """Apply a population change to moments and step counts.

        New primitive i takes the moments and step count of old primitive ``rows[i]``, or zeros if ``fresh[i]`` is true.
        If the number of primitives stays the same, the tensors keep their memory.
        """
        self.age = _select_rows(self.age, rows, fresh)
        for moments in (self.m, self.v):
            for name, value in moments.items():
                moments[name] = _select_rows(value, rows, fresh)

    def state(self) -> dict[str, Tensor]:
        """Return moments and step counts as named tensors, for a checkpoint."""
        return {**{f"m.{k}": t for k, t in self.m.items()}, **{f"v.{k}": t for k, t in self.v.items()}, "age": self.age}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore the result of :meth:`state`, with tensors on the device of the model."""
        self.m, self.v = ({name: state[f"{moment}.{name}"] for name in self.m} for moment in "mv")
        self.age = state["age"]


def _select_rows(value: Tensor, rows: Tensor, fresh: Tensor) -> Tensor:
    chosen = value[rows]
    chosen[fresh] = 0
    return value.copy_(chosen) if len(chosen) == len(value) else chosen


def _describe_bad_gradient(updates: list[_ParameterUpdate]) -> str:
    """Return an error text that names the first primitive whose gradient is not finite."""
    for update in updates:
        bad = (~torch.isfinite(update.grad.reshape(len(update.grad), -1)).all(dim=1)).nonzero()
        if len(bad):
            row = int(bad[0])
            numbers = update.grad[row].flatten()[:8].tolist()
            return f"gradient of {update.name} of primitive {row} is not finite: {numbers}"
    raise AssertionError("all gradients are finite")

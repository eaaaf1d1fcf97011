"""A model's extinction and source radiance at scattered points of one frame, differentiable.

sigma(x) = sum over primitives of (1 - |y|^2)^p max(0, f(x~)) / m inside their ellipsoids, as :func:`~neuprim.core.volumes.grid.density_grid`
has it, and the source q(x) = sum of sigma_i(x) c_i: what a ray's image integrates, L = integral of T q. c_i is the part of a primitive's
colour that is the same from all directions.

What lowers to a :class:`~neuprim.core.model.forms.Cosine` runs in compiled code, forward and backward; any other density is asked pair by
pair in torch code. Both find the pairs of points and primitives that meet in a uniform grid over the points.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute.threads import parallel_for
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.colours.sh import C0
from neuprim.core.model.fields import ColourField, Conditions, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Living, Primitives
from neuprim.core.volumes.points_cpu import add_values, count_pairs, fill_pairs, pull_values

__all__ = ["PointValues", "Shares", "cells_of", "pairs_of", "values_at"]

_SUMS = 8
"""Parts of the primitives whose sums are kept apart, so that the result does not depend on the number of threads."""

_ROWS = 64  # primitives per unit of work where none shares its output
_POINTS_PER_CELL = 0.3  # of a grid that is full; points lie where matter is, in a small part of it
_MOST_CELLS = 64  # along the longest side


class Shares:
    """Which primitives had a part in the values, and in what is wrong with them; the backward pass fills it.

    Attributes:
        error: (M,) any measure of what is wrong at each point.
        weight, error_weight: (N,) sums over points of sigma_i, and of sigma_i x error, of the primitives of the frame.
    """

    def __init__(self, count: int) -> None:
        self.error: Tensor | None = None
        self.weight, self.error_weight = torch.zeros(count), torch.zeros(count)


class PointValues(NamedTuple):
    """What a model holds at M points.

    Attributes:
        sigma: (M,) extinction, 1/scene unit.
        source: (M, C) sigma times colour; None for colours that have no part that is the same from all directions.
        rows: (N,) int64 rows of the model that live in the frame, None for all.
        shares: of these primitives; zeros until a backward pass.
    """

    sigma: Tensor
    source: Tensor | None
    rows: Tensor | None
    shares: Shares

    def watch(self, error: Tensor) -> Shares:
        """Let the backward pass sum up each primitive's part in an ``error`` (M,), which gets no gradient; call it before ``backward()``."""
        self.shares.error = error.detach()
        return self.shares


def values_at(model: Primitives, conditions: Conditions, points: Tensor, colour: bool = True, threads: int = 0) -> PointValues:
    """The values at (M, 3) ``points``, scene units; without gradient for the points.

    Args:
        conditions: of the frame, the same for all points.
        colour: whether the source is wanted.
        threads: 0 for all cores; the result does not depend on it.

    Raises:
        NonFiniteError: a parameter is NaN or infinite, or so large that the values are.
    """
    living = model.living(conditions)
    colors = _flat_colours(model.colour, living, conditions) if colour else None
    form = model.density.lower(living.own, living.geometry, conditions)
    shares = Shares(living.geometry.count)
    places = points.detach().double().contiguous().numpy()
    tensors = _asked(living, places, colors, shares) if not isinstance(form, Cosine) else None
    if tensors is None:
        assert isinstance(form, Cosine)
        axes = _Axes.of(living.geometry)
        prepared = _prepared(axes, form)
        shown = torch.zeros(living.geometry.count, 0, dtype=torch.float64) if colors is None else colors.double()
        if not all(bool(torch.isfinite(x.detach().sum())) for x in (*prepared, shown)):
            model.check_finite()
            raise NonFiniteError("extinction at points: a product of finite parameters is not finite")
        whole = _Values.apply(places, axes.reach, form.edge, shares, threads, *prepared, shown)
        tensors = whole[:, 0], (None if colors is None else whole[:, 1:])
    sigma, source = tensors
    return PointValues(sigma, source, living.rows, shares)


def _flat_colours(field: ColourField, living: Living, conditions: Conditions) -> Tensor | None:
    """(N, C) the colours without what depends on direction, at least 0."""
    own = {spec.name: living.params[spec.name] for spec in field.parameters()}
    found = field.harmonics(own, conditions)
    return None if found is None else (found[0] * C0 + 0.5).clamp_min(0.0)


class _Axes(NamedTuple):
    """Ellipsoids in float64, differentiable but for ``reach``.

    Attributes:
        means: (N, 3); m: (N,) longest semi-axes; whiten: (N, 3, 3), the A of y = A (x - mu).
        reach: (N, 3) half sides of the ellipsoids' boxes.
    """

    means: Tensor
    m: Tensor
    whiten: Tensor
    reach: np.ndarray

    @classmethod
    def of(cls, geometry: Geometry) -> _Axes:
        rotations, scales = geometry.rotations.double(), geometry.log_scales.double().exp()
        with torch.no_grad():
            reach = (rotations * scales[:, None, :]).norm(dim=-1).numpy()
        m = geometry.log_length_scale.double().exp()
        return cls(geometry.means.double(), m, rotations.transpose(1, 2) / scales[:, :, None], np.ascontiguousarray(reach))


def _prepared(axes: _Axes, form: Cosine) -> tuple[Tensor, ...]:
    """float64 tensors that the kernels read: means (N, 3), A (N, 3, 3) with y = A (x - mu), and of each neuron rate (N, K, 3), phase and
    amplitude (N, K), and offset (N,), so that f/m = offset + sum of amplitude cos(phase + rate . (x - mu)).
    """
    m, b2 = axes.m, form.b2.double().reshape(-1)
    rate = form.omega0 * form.W1.double() / m[:, None, None]
    return axes.means, axes.whiten, rate, form.omega0 * form.b1.double(), form.w2.double() / m[:, None], b2 / m


class Cells(NamedTuple):
    """Points sorted into a uniform grid.

    Attributes:
        order: (M,) int64, the points cell by cell. starts: (X Y Z + 1,) int64, where each cell's begin.
        low: (3,) float64 corner; step: edge of a cell; counts: (3,) int64.
    """

    order: np.ndarray
    starts: np.ndarray
    low: np.ndarray
    step: float
    counts: np.ndarray


def cells_of(points: np.ndarray) -> Cells:
    """A grid over (M, 3) points, fine enough that a cell holds few of them."""
    if len(points) == 0:
        return Cells(np.zeros(0, np.int64), np.zeros(2, np.int64), np.zeros(3), 1.0, np.ones(3, np.int64))
    low, high = points.min(0), points.max(0)
    across = min(_MOST_CELLS, max(1, round((len(points) / _POINTS_PER_CELL) ** (1 / 3))))
    step = float((high - low).max()) / across or 1.0
    counts = np.floor((high - low) / step).astype(np.int64) + 1
    cell = np.floor((points - low) / step).astype(np.int64).clip(0, counts - 1)
    flat = (cell[:, 0] * counts[1] + cell[:, 1]) * counts[2] + cell[:, 2]
    starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=int(counts.prod())))])
    return Cells(np.argsort(flat, kind="stable"), starts, low, step, counts)


class _Values(torch.autograd.Function):
    """(M, 1 + C) float32 extinction and source."""

    @staticmethod
    def forward(ctx: Any, places: np.ndarray, reach: np.ndarray, edge: int, shares: Shares, threads: int, *tensors: Tensor) -> Tensor:  # type: ignore[override]
        rows = [np.ascontiguousarray(x.detach().numpy()) for x in tensors]
        count, width = len(reach), 1 + rows[-1].shape[1]
        cells = cells_of(places)
        chunk = max(1, -(-count // _SUMS))
        sums = np.zeros((max(1, -(-count // chunk)), len(places), width))
        ctx.given = [np.ascontiguousarray(places[cells.order]), tuple(cells[1:]), reach, tuple(rows), edge]
        parallel_for(add_values, count, chunk, threads, *ctx.given, chunk, sums)
        found = np.empty((len(places), width), np.float32)
        found[cells.order] = sums.sum(0)
        ctx.order, ctx.shares, ctx.threads = cells.order, shares, threads
        ctx.shapes = [x.shape for x in tensors]
        return torch.from_numpy(found)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        pulled = np.ascontiguousarray(gradient.double().numpy()[ctx.order])
        shares: Shares = ctx.shares
        error = np.zeros(len(pulled)) if shares.error is None else shares.error.double().numpy()[ctx.order]
        made = [np.zeros(shape) for shape in ctx.shapes]
        sums = np.zeros((ctx.shapes[0][0], 2))
        parallel_for(pull_values, len(sums), _ROWS, ctx.threads, *ctx.given, pulled, error, tuple(made), sums)
        shares.weight, shares.error_weight = (torch.from_numpy(sums[:, i]).float() for i in range(2))
        return (None,) * 5 + tuple(torch.from_numpy(x) for x in made)


# ---------------------------------------------------------------- any other density


def pairs_of(geometry: Geometry, points: np.ndarray) -> tuple[Tensor, Tensor]:
    """(P,) int64 rows of points and of primitives that contain them, primitive by primitive."""
    cells = cells_of(points)
    with torch.no_grad():
        axes = _Axes.of(geometry)
    own = (np.ascontiguousarray(x.detach().numpy()) for x in (axes.means, axes.whiten))
    given = (np.ascontiguousarray(points[cells.order]), tuple(cells[1:]), axes.reach, *own)
    counts = np.zeros(geometry.count, np.int64)
    parallel_for(count_pairs, geometry.count, _ROWS, 0, *given, counts)
    starts = np.cumsum(counts) - counts
    point = np.empty(int(counts.sum()), np.int64)
    parallel_for(fill_pairs, geometry.count, _ROWS, 0, *given, starts, point)
    prim = torch.repeat_interleave(torch.arange(geometry.count), torch.from_numpy(counts))
    return torch.from_numpy(cells.order[point]), prim


def _asked(living: Living, places: np.ndarray, colors: Tensor | None, shares: Shares) -> tuple[Tensor, Tensor | None]:
    point, prim = pairs_of(living.geometry, places)
    sigma = living.sigma(prim, torch.from_numpy(places).to(living.geometry.means)[point]).clamp_min(0)
    columns = [sigma[:, None]] if colors is None else [sigma[:, None], sigma[:, None] * colors.to(sigma)[prim]]
    pairs = torch.cat(columns, 1)
    whole = torch.zeros(len(places), pairs.shape[1], dtype=pairs.dtype).index_add(0, point, pairs)

    def fill(gradient: Tensor) -> None:
        own = sigma.detach().float()
        shares.weight = torch.zeros_like(shares.weight).index_add_(0, prim, own)
        if shares.error is not None:
            shares.error_weight = torch.zeros_like(shares.weight).index_add_(0, prim, own * shares.error.float()[point])

    if whole.requires_grad:
        whole.register_hook(fill)
    return whole[:, 0], (None if colors is None else whole[:, 1:])

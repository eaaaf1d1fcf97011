"""A model's extinction and source radiance at scattered points of one frame, differentiable.

sigma(x) = sum over primitives of (1 - |y|^2)^p max(0, f(x~)) / m inside their ellipsoids, as
:func:`~neuprim.core.volumes.grid.density_grid` has it, and the source q(x) = sum of sigma_i(x) c_i: what a ray's image
integrates, L = integral of T q. c_i is the part of a primitive's colour that is the same from all directions.

What lowers to a :class:`~neuprim.core.model.forms.Cosine` runs in compiled code, forward and backward; any other
density is asked pair by pair in torch code. Both find the pairs of points and primitives that meet in a uniform grid
over the points.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.threads import parallel_for
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.colours.sh import C0
from neuprim.core.model.fields import ColourField, Conditions, Cosine, LoweredDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import ActiveSet, Primitives
from neuprim.core.volumes.points_cpu import add_values, count_pairs, fill_pairs, pull_values
from neuprim.core.volumes.points_prepare import merge_parts, prepare_axes, prepare_values, pull_parameters, sort_points
from neuprim.core.volumes.points_torch import cosine_values, numbers_finite, pairs_on, summed

_SUMS = 8
"""Parts of the primitives whose sums are kept apart, so that the result does not depend on the number of threads."""

_ROWS = 64  # primitives per unit of work where none shares its output
_ROWS_PREPARED = 1024  # the same where they meet no points
_POINTS_PER_CELL = 0.3  # of a grid that is full; points lie where matter is, in a small part of it
_MOST_CELLS = 64  # along the longest side


class Shares:
    """Which primitives had a part in the values, and in what is wrong with them; the backward pass fills it.

    Attributes:
        error: (M,) any measure of what is wrong at each point.
        weight, error_weight: (N,) sums over points of sigma_i, and of sigma_i x error, of the primitives of the frame.
    """

    def __init__(self, count: int, device: torch.device | None = None) -> None:
        self.error: Tensor | None = None
        self.weight, self.error_weight = (torch.zeros(count, device=device) for _ in range(2))


class PointValues(NamedTuple):
    """What a model holds at M points.

    Attributes:
        sigma: (M,) extinction, 1/scene unit.
        source: (M, C) sigma times colour; None for colours that have no part that is the same from all directions.
        components: name -> (M,) the part of sigma that comes from the source grid of that name.
        rows: (N,) int64 rows of the model that live in the frame, None for all.
        shares: of these primitives; zeros until a backward pass.
    """

    sigma: Tensor
    source: Tensor | None
    rows: Tensor | None
    shares: Shares
    components: dict[str, Tensor]

    def watch(self, error: Tensor) -> Shares:
        """Let the backward pass sum up each primitive's part in an ``error`` (M,), which gets no gradient; call it
        before ``backward()``."""
        self.shares.error = error.detach()
        return self.shares


def values_at(
    model: Primitives, conditions: Conditions, points: Tensor, colour: bool = True, threads: int = 0
) -> PointValues:
    """The values at (M, 3) ``points``, scene units; without gradient for the points.

    Args:
        conditions: of the frame, the same for all points.
        colour: whether the source is wanted.
        threads: 0 for all cores; the result does not depend on it.

    Raises:
        NonFiniteError: a parameter is NaN or infinite, or so large that the values are.
    """
    active = model.active(conditions)
    colors = _flat_colours(model.colour, active, conditions) if colour else None
    named = model.density.components(active.own)
    columns = [
        *([] if colors is None else [colors]),
        *(share[:, None] for share in named.values()),
    ]  # what sums are weighted by, alike
    weights = torch.cat(columns, 1) if columns else None
    form = model.density.lower(active.own, active.geometry, conditions)
    shares = Shares(active.geometry.count, active.geometry.means.device)
    places = points.detach().double().cpu().contiguous().numpy()
    if not device.on_numba(active.geometry.means):
        if not numbers_finite(active.geometry, form):
            model.check_finite()
            raise NonFiniteError("extinction at points: a product of finite parameters is not finite")
        sigma, sums = _elsewhere(active, form, places, weights, shares)
    elif isinstance(form, Cosine):
        g, shown = active.geometry, torch.zeros(active.geometry.count, 0) if weights is None else weights
        given = (g.means, g.log_scales, g.quats, form.W1, form.b1, form.w2, form.b2.reshape(-1), shown)
        try:
            whole = _Values.apply(places, form.omega0, form.edge, shares, threads, *given)
        except NonFiniteError:
            model.check_finite()  # names the parameter, if it is one
            raise
        sigma, sums = whole[:, 0], (None if weights is None else whole[:, 1:])
    else:
        sigma, sums = _asked(active, places, weights, shares)
    width = 0 if colors is None else colors.shape[1]
    source = None if colors is None or sums is None else sums[:, :width]
    return PointValues(
        sigma,
        source,
        active.rows,
        shares,
        {} if sums is None else dict(zip(named, sums[:, width:].unbind(1), strict=True)),
    )


def _flat_colours(field: ColourField, active: ActiveSet, conditions: Conditions) -> Tensor | None:
    """(N, C) the colours without what depends on direction, at least 0."""
    own = {spec.name: active.params[spec.name] for spec in field.parameters()}
    found = field.harmonics(own, conditions)
    return None if found is None else (found[0] * C0 + 0.5).clamp_min(0.0)


class _Axes(NamedTuple):
    """Ellipsoids in float64.

    Attributes:
        means: (N, 3); whiten: (N, 3, 3), the A of y = A (x - mu); m: (N,) longest semi-axes.
        reach: (N, 3) half sides of the ellipsoids' boxes.
        finite: whether all of these are.
    """

    means: np.ndarray
    whiten: np.ndarray
    m: np.ndarray
    reach: np.ndarray
    finite: bool

    @classmethod
    def of(cls, threads: int, *ellipsoids: np.ndarray) -> _Axes:
        """Of means, log_scales and quats."""
        count = len(ellipsoids[0])
        made = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty(count), np.empty((count, 3))
        return cls(*made, all(parallel_for(prepare_axes, count, _ROWS_PREPARED, threads, *ellipsoids, *made)))


class Cells(NamedTuple):
    """Points sorted into a uniform grid.

    Attributes:
        order: (M,) int64, the points cell by cell. starts: (X Y Z + 1,) int64, where each cell's begin.
        low: (3,) float64 corner; step: edge of a cell; counts: (3,) int64.
        placed: (M, 3) the points in that order.
    """

    order: np.ndarray
    starts: np.ndarray
    low: np.ndarray
    step: float
    counts: np.ndarray
    placed: np.ndarray

    @property
    def grid(self) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
        """As the kernels take it."""
        return self.starts, self.low, self.step, self.counts


def cells_of(points: np.ndarray) -> Cells:
    """A grid over (M, 3) points, fine enough that a cell holds few of them."""
    if len(points) == 0:
        return Cells(
            np.zeros(0, np.int64), np.zeros(2, np.int64), np.zeros(3), 1.0, np.ones(3, np.int64), np.zeros((0, 3))
        )
    low, high = points.min(0), points.max(0)
    across = min(_MOST_CELLS, max(1, round((len(points) / _POINTS_PER_CELL) ** (1 / 3))))
    step = float((high - low).max()) / across or 1.0
    counts = np.floor((high - low) / step).astype(np.int64) + 1
    starts, order, placed = (
        np.zeros(int(counts.prod()) + 1, np.int64),
        np.empty(len(points), np.int64),
        np.empty((len(points), 3)),
    )
    sort_points(points, low, step, counts, starts, order, placed)
    return Cells(order, starts, low, step, counts, placed)


class _Values(torch.autograd.Function):
    """(M, 1 + C) float32 extinction and source, of (means, log_scales, quats, W1, b1, w2, b2, colours), each a row per
    primitive."""

    @staticmethod
    def forward(
        ctx: Any, places: np.ndarray, omega0: float, edge: int, shares: Shares, threads: int, *tensors: Tensor
    ) -> Tensor:  # type: ignore[override]
        given = [np.ascontiguousarray(x.detach().numpy()) for x in tensors]
        if len({x.dtype for x in given}) > 1:  # a mix would compile kernels of its own
            given = [x.astype(np.float64, copy=False) for x in given]
        count, K, width = len(given[0]), given[3].shape[1], 1 + given[7].shape[1]
        axes = _Axes.of(threads, *given[:3])
        neurons = (
            np.empty((count, K, 3)),
            np.empty((count, K)),
            np.empty((count, K)),
            np.empty(count),
            np.empty((count, width - 1)),
        )
        finite = parallel_for(prepare_values, count, _ROWS_PREPARED, threads, *given[3:], omega0, axes.m, *neurons)
        if not (axes.finite and all(finite)):
            raise NonFiniteError("extinction at points: a product of finite parameters is not finite")
        cells = cells_of(places)
        chunk = max(1, -(-count // _SUMS))
        parts = np.zeros((max(1, -(-count // chunk)), len(places), width))
        prims = (axes.means, axes.whiten, *neurons)
        parallel_for(add_values, count, chunk, threads, cells.placed, cells.grid, axes.reach, prims, edge, chunk, parts)
        found = np.empty((len(places), width), np.float32)
        parallel_for(merge_parts, len(places), _ROWS_PREPARED, threads, parts, cells.order, found)
        ctx.given, ctx.prims, ctx.axes, ctx.cells, ctx.shares = given, prims, axes, cells, shares
        ctx.settings, ctx.dtypes = (omega0, edge, threads), [x.dtype for x in tensors]
        return torch.from_numpy(found)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        (omega0, edge, threads), cells, shares, count = ctx.settings, ctx.cells, ctx.shares, len(ctx.given[0])
        pulled = gradient.numpy()[cells.order].astype(np.float64)
        error = np.zeros(len(pulled)) if shares.error is None else shares.error.double().numpy()[cells.order]
        made = tuple(np.zeros_like(x) for x in ctx.prims)
        sums = np.zeros((count, 2))
        parallel_for(
            pull_values,
            count,
            _ROWS,
            threads,
            cells.placed,
            cells.grid,
            ctx.axes.reach,
            ctx.prims,
            edge,
            pulled,
            error,
            made,
            sums,
        )
        shares.weight, shares.error_weight = (torch.from_numpy(sums[:, i]).float() for i in range(2))
        own = tuple(np.empty(x.shape, x.dtype) for x in ctx.given[1:7])
        rest = (omega0, ctx.axes.m, ctx.prims[1:6], made[1:6], own)
        parallel_for(pull_parameters, count, _ROWS_PREPARED, threads, *ctx.given[1:3], *rest)
        gradients = (made[0], *own, made[6])
        return (None,) * 5 + tuple(
            torch.from_numpy(x).to(dtype) for x, dtype in zip(gradients, ctx.dtypes, strict=True)
        )


# ---------------------------------------------------------------- any other density


def pairs_of(geometry: Geometry, points: np.ndarray) -> tuple[Tensor, Tensor]:
    """(P,) int64 rows of points and of primitives that contain them, primitive by primitive."""
    cells = cells_of(points)
    axes = _Axes.of(
        0, *(np.ascontiguousarray(x.detach().numpy()) for x in (geometry.means, geometry.log_scales, geometry.quats))
    )
    given = (cells.placed, cells.grid, axes.reach, axes.means, axes.whiten)
    counts = np.zeros(geometry.count, np.int64)
    parallel_for(count_pairs, geometry.count, _ROWS, 0, *given, counts)
    starts = np.cumsum(counts) - counts
    point = np.empty(int(counts.sum()), np.int64)
    parallel_for(fill_pairs, geometry.count, _ROWS, 0, *given, starts, point)
    prim = torch.repeat_interleave(torch.arange(geometry.count), torch.from_numpy(counts))
    return torch.from_numpy(cells.order[point]), prim


def _elsewhere(
    active: ActiveSet, form: LoweredDensity, places: np.ndarray, colors: Tensor | None, shares: Shares
) -> tuple[Tensor, Tensor | None]:
    """The same of a model that compiled code cannot read."""
    g = active.geometry
    cells = cells_of(places)
    point, prim = pairs_on(g, cells.order, cells.grid, cells.placed)
    x = device.copy_from_host(torch.from_numpy(places), g.means.device)[point]
    values = cosine_values(form, g, prim, x) if isinstance(form, Cosine) else active.sigma(prim, x.to(g.means)).double()
    sigma = values.clamp_min(0)
    columns = [sigma[:, None]] if colors is None else [sigma[:, None], sigma[:, None] * colors.double()[prim]]
    whole = summed(len(places), point, torch.cat(columns, 1)).float()

    def fill(gradient: Tensor) -> None:
        own = sigma.detach()
        shares.weight = summed(g.count, prim, own).float()
        if shares.error is not None:
            shares.error_weight = summed(g.count, prim, own * shares.error.double()[point]).float()

    if whole.requires_grad:
        whole.register_hook(fill)
    return whole[:, 0], (None if colors is None else whole[:, 1:])


def _asked(
    active: ActiveSet, places: np.ndarray, colors: Tensor | None, shares: Shares
) -> tuple[Tensor, Tensor | None]:
    point, prim = pairs_of(active.geometry, places)
    sigma = active.sigma(prim, torch.from_numpy(places).to(active.geometry.means)[point]).clamp_min(0)
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

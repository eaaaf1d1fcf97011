"""A model's extinction and source radiance at scattered points of one frame, differentiable.

sigma(x) = sum over primitives of (1 - |y|^2)^p max(0, f(x~)) / m inside their ellipsoids, as
:func:`~neuprim.core.volumes.grid.density_grid` has it, and the source q(x) = sum of sigma_i(x) c_i: what a ray's image
integrates, L = integral of T q. c_i is the part of a primitive's colour that is the same from all directions.

A density that lowers to a :class:`~neuprim.core.model.forms.Cosine` runs in compiled code on the CPU, forward and
backward; on a GPU, and for any other density, torch code evaluates it pair by pair. Both find the pairs of points and
primitives that meet in a uniform grid over the points.
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
from neuprim.core.model.densities.cosine import cosine_density
from neuprim.core.model.fields import ColourField, Conditions, Cosine, LoweredDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import ActiveSet, Primitives
from neuprim.core.volumes.points_kernels import (
    add_values,
    merge_parts,
    prepare_axes,
    prepare_values,
    pull_parameters,
    pull_values,
    sort_points,
)

_SUMS = 8
"""Parts of the primitives whose sums are kept apart, so that the result does not depend on the number of threads."""

_ROWS = 64  # primitives per unit of work where none shares its output
_ROWS_PREPARED = 1024  # the same where they meet no points
_POINTS_PER_CELL = 0.3  # of a grid that is full; points lie where matter is, in a small part of it
_MOST_CELLS = 64  # along the longest side
_NOT_FINITE = "extinction at points: a product of finite parameters is not finite"


class Shares:
    """Each primitive's part in the values and in an error; the backward pass fills it.

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
        rows: (N,) int64 rows of the model that are active in the frame, None for all.
        shares: of these primitives; zeros until a backward pass.
        components: name -> (M,) the part of sigma that comes from the source grid of that name.
    """

    sigma: Tensor
    source: Tensor | None
    rows: Tensor | None
    shares: Shares
    components: dict[str, Tensor]

    def request_shares(self, error: Tensor) -> Shares:
        """Let the backward pass sum up each primitive's part in an ``error`` (M,), which gets no gradient."""
        self.shares.error = error.detach()
        return self.shares


def values_at(
    model: Primitives, conditions: Conditions, points: Tensor, colour: bool = True, threads: int = 0
) -> PointValues:
    """The values at (M, 3) ``points``, scene units; without gradient for the points.

    Args:
        conditions: of the frame, the same for all points.
        colour: whether to compute the source.
        threads: 0 for all cores; the result does not depend on it.

    Raises:
        NonFiniteError: a parameter is NaN or infinite, or so large that the values are.
    """
    active = model.active(conditions)
    colors = _isotropic_colours(model.colour, active, conditions) if colour else None
    named = model.density.components(active.own)
    columns = [*([] if colors is None else [colors]), *(share[:, None] for share in named.values())]
    geometry, count = active.geometry, active.geometry.count
    weights = torch.cat(columns, 1) if columns else geometry.means.new_zeros(count, 0)
    form = model.density.lower(active.own, geometry, conditions)
    shares = Shares(count, geometry.means.device)
    cells = sort_into_cells(points.detach().double().cpu().contiguous().numpy())
    try:
        if isinstance(form, Cosine) and device.on_numba(geometry.means):
            shape = (geometry.means, geometry.log_scales, geometry.quats)
            neurons = (form.W1, form.b1, form.w2, form.b2.reshape(-1))
            found = _CosineValues.apply(cells, form.omega0, form.edge, shares, threads, *shape, *neurons, weights)
        else:
            found = _torch_values(active, form, cells, weights, shares)
    except NonFiniteError:
        model.check_finite()  # names the parameter, if it is one
        raise
    width = 0 if colors is None else colors.shape[1]
    components = dict(zip(named, found[:, 1 + width :].unbind(1), strict=True))
    return PointValues(found[:, 0], found[:, 1 : 1 + width] if width else None, active.rows, shares, components)


def _isotropic_colours(field: ColourField, active: ActiveSet, conditions: Conditions) -> Tensor | None:
    """(N, C) the colours without what depends on direction, at least 0."""
    own = {spec.name: active.params[spec.name] for spec in field.parameters()}
    harmonics = field.harmonics(own, conditions)
    return None if harmonics is None else (harmonics[0] * C0 + 0.5).clamp_min(0.0)


class Cells(NamedTuple):
    """Points sorted into a uniform grid.

    Attributes:
        order: (M,) int64, the points cell by cell.
        points: (M, 3) float64 in that order.
        starts: (X Y Z + 1,) int64, where each cell's points begin.
        low: (3,) float64 corner; step: edge of a cell; counts: (3,) int64.
    """

    order: np.ndarray
    points: np.ndarray
    starts: np.ndarray
    low: np.ndarray
    step: float
    counts: np.ndarray

    @property
    def grid(self) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
        """As the kernels take it."""
        return self.starts, self.low, self.step, self.counts


def sort_into_cells(points: np.ndarray) -> Cells:
    """A grid over (M, 3) points, fine enough that a cell holds few of them."""
    if len(points) == 0:
        nothing, low, counts = np.zeros(0, np.int64), np.zeros(3), np.ones(3, np.int64)
        return Cells(nothing, np.zeros((0, 3)), np.zeros(2, np.int64), low, 1.0, counts)
    low, high = points.min(0), points.max(0)
    across = min(_MOST_CELLS, max(1, round((len(points) / _POINTS_PER_CELL) ** (1 / 3))))
    step = float((high - low).max()) / across or 1.0
    counts = np.floor((high - low) / step).astype(np.int64) + 1
    starts = np.zeros(int(counts.prod()) + 1, np.int64)
    order, placed = np.empty(len(points), np.int64), np.empty((len(points), 3))
    sort_points(points, low, step, counts, starts, order, placed)
    return Cells(order, placed, starts, low, step, counts)


class _CosineValues(torch.autograd.Function):
    """(M, 1 + C) float32 extinction and weighted extinctions, of (means, log_scales, quats, W1, b1, w2, b2, weights),
    each a row per primitive."""

    @staticmethod
    def forward(
        ctx: Any, cells: Cells, omega0: float, edge: int, shares: Shares, threads: int, *tensors: Tensor
    ) -> Tensor:  # type: ignore[override]
        given = [np.ascontiguousarray(x.detach().numpy()) for x in tensors]
        if len({x.dtype for x in given}) > 1:  # a mix would compile kernels of its own
            given = [x.astype(np.float64, copy=False) for x in given]
        count, K, width = len(given[0]), given[3].shape[1], 1 + given[7].shape[1]
        centers, whiten, m, reach = axes = (
            np.empty((count, 3)),
            np.empty((count, 3, 3)),
            np.empty(count),
            np.empty((count, 3)),
        )
        finite = parallel_for(prepare_axes, count, _ROWS_PREPARED, threads, *given[:3], *axes)
        shapes = ((count, K, 3), (count, K), (count, K), (count,), (count, width - 1))
        neurons = tuple(np.empty(shape) for shape in shapes)
        finite += parallel_for(prepare_values, count, _ROWS_PREPARED, threads, *given[3:], omega0, m, *neurons)
        if not all(finite):
            raise NonFiniteError(_NOT_FINITE)
        chunk = max(1, -(-count // _SUMS))
        parts = np.zeros((max(1, -(-count // chunk)), len(cells.points), width))
        prims = (centers, whiten, *neurons)
        parallel_for(add_values, count, chunk, threads, cells.points, cells.grid, reach, prims, edge, chunk, parts)
        found = np.empty((len(cells.points), width), np.float32)
        parallel_for(merge_parts, len(found), _ROWS_PREPARED, threads, parts, cells.order, found)
        ctx.given, ctx.prims, ctx.axes, ctx.cells, ctx.shares = given, prims, (m, reach), cells, shares
        ctx.settings, ctx.dtypes = (omega0, edge, threads), [x.dtype for x in tensors]
        return torch.from_numpy(found)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        (omega0, edge, threads), cells, shares = ctx.settings, ctx.cells, ctx.shares
        (m, reach), count = ctx.axes, len(ctx.given[0])
        pulled = gradient.numpy()[cells.order].astype(np.float64)
        error = np.zeros(len(pulled)) if shares.error is None else shares.error.double().numpy()[cells.order]
        made = tuple(np.zeros_like(x) for x in ctx.prims)
        sums = np.zeros((count, 2))
        places = (cells.points, cells.grid, reach, ctx.prims, edge)
        parallel_for(pull_values, count, _ROWS, threads, *places, pulled, error, made, sums)
        shares.weight, shares.error_weight = (torch.from_numpy(sums[:, i]).float() for i in range(2))
        own = tuple(np.empty(x.shape, x.dtype) for x in ctx.given[1:7])
        rest = (omega0, m, ctx.prims[1:6], made[1:6], own)
        parallel_for(pull_parameters, count, _ROWS_PREPARED, threads, *ctx.given[1:3], *rest)
        gradients = zip((made[0], *own, made[6]), ctx.dtypes, strict=True)
        return (None,) * 5 + tuple(torch.from_numpy(x).to(dtype) for x, dtype in gradients)


# ---------------------------------------------------------------- torch code: on a GPU, and for any other density


def _torch_values(active: ActiveSet, form: LoweredDensity, cells: Cells, weights: Tensor, shares: Shares) -> Tensor:
    """As :class:`_CosineValues`; sums run in a fixed order."""
    g = active.geometry
    with torch.no_grad():  # one synchronisation
        given = [g.means, g.scales, 1 / g.scales, g.rotations, *form.tensors().values()]
        if not bool(torch.isfinite(torch.stack([x.double().sum() for x in given])).all()):
            raise NonFiniteError(_NOT_FINITE)
    row, prim = find_pairs(g, cells)
    x = device.copy_from_host(torch.from_numpy(cells.points), g.means.device)[row]
    if isinstance(form, Cosine):
        W1, b1, w2, b2 = (v.double() for v in (form.W1, form.b1, form.w2, form.b2))
        place = Geometry(*(v.double() for v in (g.means, g.log_scales, g.quats)))
        sigma = cosine_density(Cosine(W1, b1, w2, b2, form.omega0, form.edge), place, prim, x).clamp_min(0)
    else:
        sigma = active.sigma(prim, x.to(g.means)).double().clamp_min(0)
    order = device.copy_from_host(torch.from_numpy(cells.order), g.means.device)
    point = order[row]
    values = torch.cat([sigma[:, None], sigma[:, None] * weights.double()[prim]], 1)
    found = _sum_rows(len(order), point, values).float()

    def fill(gradient: Tensor) -> None:
        own = sigma.detach()
        shares.weight = _sum_rows(g.count, prim, own).float()
        if shares.error is not None:
            shares.error_weight = _sum_rows(g.count, prim, own * shares.error.double()[point]).float()

    if found.requires_grad:
        found.register_hook(fill)
    return found


def find_pairs(geometry: Geometry, cells: Cells) -> tuple[Tensor, Tensor]:
    """(P,) int64 rows of ``cells.points`` and of primitives that contain them, primitive by primitive, on the device of
    the geometry; three synchronisations."""
    means, scales, axes = (x.detach().double() for x in (geometry.means, geometry.scales, geometry.rotations.double()))
    starts, low, counts, points = (
        device.copy_from_host(torch.from_numpy(x), means.device)
        for x in (cells.starts, cells.low, cells.counts, cells.points)
    )
    reach = (axes * scales[:, None, :]).norm(dim=2)
    first = ((means - reach - low) / cells.step).clamp_min(0.0).floor().minimum(counts).long()
    last = ((means + reach - low) / cells.step).clamp_min(-1.0).minimum(counts - 1.0).floor().long()
    wide = (last - first + 1).clamp_min(0)  # cells along each axis
    columns = wide[:, 0] * wide[:, 1] * (wide[:, 2] > 0)
    prim = torch.repeat_interleave(columns)  # a row for each primitive and column of cells along z
    number = torch.arange(len(prim), device=prim.device) - (columns.cumsum(0) - columns)[prim]
    across = wide[prim, 1]
    row = ((first[prim, 0] + number // across) * counts[1] + first[prim, 1] + number % across) * counts[2]
    begin = starts[row + first[prim, 2]]
    length = starts[row + last[prim, 2] + 1] - begin
    column = torch.repeat_interleave(length)
    number = torch.arange(len(column), device=column.device) - (length.cumsum(0) - length)[column]
    prim, place = prim[column], begin[column] + number
    y = (axes[prim].transpose(1, 2) @ (points[place] - means[prim])[:, :, None])[..., 0] / scales[prim]
    inside = (y.square().sum(1) < 1.0).nonzero()[:, 0]
    return place[inside], prim[inside]


def _sum_rows(count: int, rows: Tensor, values: Tensor) -> Tensor:
    """(count, ...) sums of ``values`` (P, ...) by ``rows`` (P,), in the order of P; differentiable."""
    nothing = torch.zeros((count, *values.shape[1:]), dtype=values.dtype, device=values.device)
    return nothing.index_put((rows,), values, accumulate=True)

"""A model's extinction and source radiance at scattered points of one frame, differentiable.

The extinction at x is sigma(x), the sum of sigma_i(x) = (1 - |y|^2)^p max(0, f(x~)) / m over the primitives i whose
ellipsoid contains x (symbols: :mod:`neuprim.core.volumes.density_grid`). The source radiance is q(x) = sum of
sigma_i(x) c_i, where c_i is the part of a primitive's colour that does not depend on direction. The colour of a ray is
the integral of transmittance times q. A density with the closed form :class:`~neuprim.core.model.fields.Cosine` runs in
compiled code. For any other density, torch code evaluates each pair of point and primitive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.cosine import cosine_density
from neuprim.core.model.fields import CHANNEL, Conditions, Cosine, LoweredDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import ActivePrimitives, Primitives
from neuprim.core.volumes.points_cpu import NOT_FINITE, CosinePointValues, PointCells, sort_points_into_cells


class PointShares:
    """Contribution of each primitive of a frame to the extinction at points, and to an error.

    The backward pass fills ``weight`` and ``error_weight``.

    Attributes:
        error: (M,) error at each point, in any measure.
        weight, error_weight: (N,) sums over points of sigma_i, the extinction of primitive i, and of sigma_i x error.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.error: Tensor | None = None
        self.weight, self.error_weight = (torch.zeros(count, device=device) for _ in range(2))


class PointValues(NamedTuple):
    """Values of a model at M points.

    Attributes:
        sigma: (M,) extinction, 1/scene unit.
        source: (M, C) sum of sigma_i times the colour of primitive i; None if not requested, or if the whole colour
            depends on direction.
        rows: (N,) int64 rows of the primitives that are active in the frame, None for all.
        shares: contributions of the active primitives; zeros until a backward pass.
        components: name of a source grid -> (M,) part of sigma that comes from this grid; name of a channel, after
            :data:`~neuprim.core.model.fields.CHANNEL` -> (M, C) sum of sigma_i times the values of primitive i.
        scattered: (M, C) sum of sigma_i times :meth:`~neuprim.core.model.fields.ColourField.scattering`; None if
            ``source`` is None, or if the field does not separate scattered light.
    """

    sigma: Tensor
    source: Tensor | None
    rows: Tensor | None
    shares: PointShares
    components: dict[str, Tensor]
    scattered: Tensor | None

    def request_shares(self, error: Tensor) -> PointShares:
        """Return the object to which the backward pass writes each primitive's contribution to ``error`` (M,).

        ``error`` gets no gradient.
        """
        self.shares.error = error.detach()
        return self.shares


def volume_values_at(
    model: Primitives, conditions: Conditions, points: Tensor, colour: bool = True, threads: int = 0
) -> PointValues:
    """Return extinction and source radiance of a model at ``points`` (M, 3), scene units, in one frame.

    Differentiable with respect to the parameters, not the points.

    Args:
        colour: whether to compute the source radiance.
        threads: number of threads, 0 for all cores; the result does not depend on it.

    Raises:
        NonFiniteError: a parameter is NaN or infinite, or so large that the values are NaN or infinite. Compiled code
            on a GPU returns NaN values instead, because a check would have to wait for the GPU.
    """
    compiled = device.on_warp(model.params["means"]) and model.density.stage is not None
    active = model.active(conditions, everything=compiled)
    geometry, count = active.geometry, active.geometry.count
    colour_params = {spec.name: active.params[spec.name] for spec in model.colour.parameters()}
    isotropic = model.colour.isotropic(colour_params, conditions) if colour else None
    scattering = None if isotropic is None else model.colour.scattering(colour_params)
    named = model.density.components(active.own)
    named |= {CHANNEL + name: values for name, values in model.density.channels(active.own).items()}
    columns = [x for x in (isotropic, scattering) if x is not None]
    widths = [0 if x is None else x.shape[1] for x in (isotropic, scattering)]
    columns += [factor if factor.dim() == 2 else factor[:, None] for factor in named.values()]
    weights = torch.cat(columns, 1) if columns else geometry.means.new_zeros(count, 0)
    form = model.density.lower(active.own, geometry, conditions)
    shapes = {name: factor.shape[1:] for name, factor in named.items()}
    shares = PointShares(count, geometry.means.device)
    if compiled and isinstance(form, Cosine):
        from neuprim.core.volumes.points_warp import cosine_point_values

        values = cosine_point_values(geometry, form, points, weights, shares)
        return _point_values(values, widths, active.rows, shares, shapes)
    try:
        values = weighted_extinctions_at(active, form, points, weights, shares, threads)
    except NonFiniteError:
        model.check_finite()  # names the parameter, if it is one
        raise
    return _point_values(values, widths, active.rows, shares, shapes)


def weighted_extinctions_at(
    active: ActivePrimitives,
    form: LoweredDensity,
    points: Tensor,
    weights: Tensor,
    shares: PointShares | None = None,
    threads: int = 0,
) -> Tensor:
    """Return (M, 1 + C) float32 sums over N primitives at ``points`` (M, 3): extinction, and extinction x ``weights``.

    Column 0 is the sum of sigma_i, the extinction of primitive i. Column 1 + c is the sum of sigma_i x weights[i, c].

    Args:
        active: the N active primitives of a frame.
        form: closed form of the primitives' density.
        weights: (N, C) factors of the extinction of each primitive.
        shares: object that the backward pass fills with the contribution of each primitive; None for none.
        threads: number of threads, 0 for all cores; the result does not depend on it.

    Raises:
        NonFiniteError: a value is not finite.
    """
    geometry = active.geometry
    shares = PointShares(geometry.count, geometry.means.device) if shares is None else shares
    cells = sort_points_into_cells(points.detach().double().cpu().contiguous().numpy())
    if not isinstance(form, Cosine) or not device.on_numba(geometry.means):
        return _torch_density_point_values(active, form, cells, weights, shares)
    shape = (geometry.means, geometry.log_scales, geometry.quats)
    neurons = (form.W1, form.b1, form.w2, form.b2.reshape(-1))
    values: Tensor = CosinePointValues.apply(cells, form.omega0, form.edge, shares, threads, *shape, *neurons, weights)
    return values


def channel_values_at(model: Primitives, conditions: Conditions, points: Tensor, threads: int = 0) -> dict[str, Tensor]:
    """Return channel name -> (M, C) float32 values of a model at ``points`` (M, 3), scene units, in one frame.

    A value is the mean over primitives, weighted by their extinctions; 0 where no primitive absorbs.
    """
    with torch.no_grad():
        active = model.to(device.HOST).active(conditions)
        channels = active.field.channels(active.own)
        if not channels:
            return {}
        form = active.field.lower(active.own, active.geometry, conditions)
        sums = weighted_extinctions_at(active, form, points, torch.cat([*channels.values()], 1), threads=threads)
        values = sums[:, 1:] / sums[:, :1].clamp_min(torch.finfo(torch.float32).tiny)
        widths = [own.shape[1] for own in channels.values()]
    return dict(zip(channels, values.split(widths, 1), strict=True))


def _point_values(
    values: Tensor, widths: Sequence[int], rows: Tensor | None, shares: PointShares, shapes: Mapping[str, torch.Size]
) -> PointValues:
    """Split the columns of ``values``: extinction, source radiance, scattered radiance and components.

    ``widths`` are the numbers of columns of the two radiances, 0 for none. ``shapes`` are the shapes of the components
    at a point, by name.
    """
    sigma, source, scattered, *components = values.split([1, *widths, *(s.numel() for s in shapes.values())], 1)
    found = zip(shapes.items(), components, strict=True)
    parts = {name: part.reshape(len(values), *shape) for (name, shape), part in found}
    light = [x if x.shape[1] else None for x in (source, scattered)]
    return PointValues(sigma[:, 0], light[0], rows, shares, parts, light[1])


# ---------------------------------------------------------------- torch code, for any other density


def _torch_density_point_values(
    active: ActivePrimitives, form: LoweredDensity, cells: PointCells, weights: Tensor, shares: PointShares
) -> Tensor:
    """Return what :func:`weighted_extinctions_at` returns, by torch code for any density; sums run in a fixed order."""
    g = active.geometry
    with torch.no_grad():  # one synchronisation
        inputs = [g.means, g.scales, 1 / g.scales, g.rotations, *form.tensors().values()]
        if not bool(torch.isfinite(torch.stack([x.double().sum() for x in inputs])).all()):
            raise NonFiniteError(NOT_FINITE)
    row, prim = find_point_pairs(g, cells)
    x = device.copy_to_device(torch.from_numpy(cells.points), g.means.device)[row]
    if isinstance(form, Cosine):
        W1, b1, w2, b2 = (v.double() for v in (form.W1, form.b1, form.w2, form.b2))
        place = g.double()
        sigma = cosine_density(Cosine(W1, b1, w2, b2, form.omega0, form.edge), place, prim, x).clamp_min(0)
    else:
        sigma = active.sigma(prim, x.to(g.means)).double().clamp_min(0)
    point = device.copy_to_device(torch.from_numpy(cells.order), g.means.device)[row]
    values = torch.cat([sigma[:, None], sigma[:, None] * weights.double()[prim]], 1)
    sums = _sum_density_point_rows(len(cells.order), point, values).float()

    def fill_shares(gradient: Tensor) -> None:
        own = sigma.detach()
        shares.weight = _sum_density_point_rows(g.count, prim, own).float()
        if shares.error is not None:
            shares.error_weight = _sum_density_point_rows(g.count, prim, own * shares.error.double()[point]).float()

    if sums.requires_grad:
        sums.register_hook(fill_shares)
    return sums


def find_point_pairs(geometry: Geometry, cells: PointCells) -> tuple[Tensor, Tensor]:
    """Return the P pairs of a point and a primitive whose ellipsoid contains the point, primitive by primitive.

    The pairs are two (P,) int64 tensors: rows of ``cells.points``, and rows (indices) of primitives. The function runs
    on the device of the geometry, and waits for a GPU three times.
    """
    means, scales, axes = (x.detach().double() for x in (geometry.means, geometry.scales, geometry.rotations.double()))
    starts, low, counts, points = (
        device.copy_to_device(torch.from_numpy(x), means.device)
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


def _sum_density_point_rows(count: int, rows: Tensor, values: Tensor) -> Tensor:
    """Return (count, ...) sums: entry r adds up ``values`` (P, ...) where ``rows`` is r, in order; differentiable."""
    zeros = torch.zeros((count, *values.shape[1:]), dtype=values.dtype, device=values.device)
    return zeros.index_put((rows,), values, accumulate=True)

"""Points and primitives that meet, and what the primitives hold there, in torch code: for tensors that
:mod:`neuprim.core.volumes.points_cpu` cannot read. Sums go by :func:`summed`, in an order that does not change from one
time to the next."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.model.densities.cosine import cosine_density
from neuprim.core.model.forms import Cosine, LoweredDensity
from neuprim.core.model.geometry import Geometry

Grid = tuple[np.ndarray, np.ndarray, float, np.ndarray]


def pairs_on(geometry: Geometry, sorted_by: np.ndarray, grid: Grid, sorted_points: np.ndarray) -> tuple[Tensor, Tensor]:
    """(P,) int64 rows of points and of primitives that contain them, primitive by primitive, on the device of the
    geometry; three waits for it.

    The points are those of :class:`~neuprim.core.volumes.points.Cells`: their ``order``, ``grid`` and ``placed``.
    """
    means, scales, axes = (x.detach().double() for x in (geometry.means, geometry.scales, geometry.rotations.double()))
    order, starts, low, counts, placed = (
        device.copy_from_host(torch.from_numpy(x), means.device) for x in (sorted_by, *grid[:2], grid[3], sorted_points)
    )
    reach = (axes * scales[:, None, :]).norm(dim=2)
    first = ((means - reach - low) / grid[2]).clamp_min(0.0).floor().minimum(counts).long()
    last = ((means + reach - low) / grid[2]).clamp_min(-1.0).minimum(counts - 1.0).floor().long()
    wide = (last - first + 1).clamp_min(0)  # cells along each axis
    columns = wide[:, 0] * wide[:, 1] * (wide[:, 2] > 0)
    prim = torch.repeat_interleave(columns)  # a row for each primitive and column of cells along z
    number = torch.arange(len(prim), device=prim.device) - (columns.cumsum(0) - columns)[prim]
    across = wide[prim, 1]
    row = ((first[prim, 0] + number // across) * counts[1] + first[prim, 1] + number % across) * counts[2]
    begin = starts[row + first[prim, 2]]
    length = starts[row + last[prim, 2] + 1] - begin
    column = torch.repeat_interleave(length)
    prim, place = (
        prim[column],
        begin[column] + torch.arange(len(column), device=column.device) - (length.cumsum(0) - length)[column],
    )
    inner = (axes[prim].transpose(1, 2) @ (placed[place] - means[prim])[:, :, None])[..., 0] / scales[prim]
    inside = (inner.square().sum(1) < 1.0).nonzero()[:, 0]
    return order[place[inside]], prim[inside]


def numbers_finite(geometry: Geometry, form: LoweredDensity) -> bool:
    """Whether primitives have a place and a density; one wait for a card."""
    with torch.no_grad():
        given = [geometry.means, geometry.scales, 1 / geometry.scales, geometry.rotations, *form.tensors().values()]
        return bool(torch.isfinite(torch.stack([x.double().sum() for x in given])).all())


def cosine_values(form: Cosine, geometry: Geometry, prim: Tensor, x: Tensor) -> Tensor:
    """(P,) float64 world density, unclamped, of primitives ``prim`` at points ``x`` (P, 3) inside them;
    differentiable."""
    W1, b1, w2, b2 = (value.double() for value in (form.W1, form.b1, form.w2, form.b2))
    place = Geometry(*(value.double() for value in (geometry.means, geometry.log_scales, geometry.quats)))
    return cosine_density(Cosine(W1, b1, w2, b2, form.omega0, form.edge), place, prim, x.double())


def summed(count: int, rows: Tensor, values: Tensor) -> Tensor:
    """(count, ...) sums of ``values`` (P, ...) by ``rows`` (P,), in the order of P; differentiable."""
    return torch.zeros((count, *values.shape[1:]), dtype=values.dtype, device=values.device).index_put(
        (rows,), values, accumulate=True
    )

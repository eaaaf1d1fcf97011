"""Real spherical harmonics up to degree 3, in the order and signs of 3D Gaussian splatting."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.errors import FormError
from neuprim.core.model.colour_constants import C0, C1, C2, C3
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import Params
from neuprim.core.model.tensors import Shape, Sizes, primitive_tensors_fault

__all__ = ["initial_sh_dc", "sh_basis", "sh_coefficient_count", "sh_colors"]


def sh_coefficient_count(degree: int) -> int:
    """Return the number of coefficients per channel of all bands up to ``degree``."""
    return (degree + 1) ** 2


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Return (N, (degree + 1)^2) values of the spherical harmonics at unit ``directions`` (N, 3), degree 0..3."""
    if not 0 <= degree <= 3:
        raise ValueError(f"spherical-harmonics degree {degree}; expected 0..3")
    x, y, z = directions.unbind(-1)
    rows = [torch.full_like(x, C0)]
    if degree >= 1:
        rows += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        rows += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
    if degree >= 3:
        rows += [
            C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            C3[4] * x * (4 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(rows, -1)


def lowest_band_colors(dc: Tensor) -> Tensor:
    """Return the (N, C) colours max(0, C0 dc + 1/2), which do not depend on direction, of coefficients ``dc`` (N, C).

    C0 is the spherical harmonic of degree 0, a constant.
    """
    return (dc * C0 + 0.5).clamp_min(0.0)


def sh_colors(means: Tensor, dc: Tensor, rest: Tensor | None, origin: Tensor, degree: int) -> Tensor:
    """Return the (N, C) colours max(0, SH(d) + 1/2), where SH is a sum of spherical harmonics.

    d is the unit direction from ``origin`` to the primitive's centre. For float32 tensors, one compiled kernel computes
    all colours.

    Args:
        means: (N, 3) centres of the primitives, scene units.
        dc: (N, C) zero-order coefficients.
        rest: (N, at least (degree + 1)^2 - 1, C) coefficients of the higher bands; None only at degree 0.
        origin: (3,) position of the camera.
        degree: highest band in use, 0..3.

    Raises:
        FormError: a tensor has a wrong type, shape or device, or ``degree`` is invalid.
    """
    _check_sh_inputs(means, dc, rest, origin, degree)
    if degree == 0:
        return lowest_band_colors(dc)
    assert rest is not None  # checked above
    if device.on_numba(means, dc, rest) and dc.dtype == means.dtype == torch.float32:
        from neuprim.core.model.colours_cpu import fused_harmonic_colors  # numba, loaded when first needed

        return fused_harmonic_colors(means, dc, rest, origin, degree)
    if device.on_warp(means, dc, rest) and dc.dtype == means.dtype == torch.float32:
        from neuprim.core.model import colours_warp

        return colours_warp.fused_harmonic_colors(means, dc, rest, origin, degree)
    offset = means - device.to_device_like(origin, means)
    direction = offset / offset.norm(dim=-1, keepdim=True).clamp_min(1e-30)
    bands = sh_basis(direction, degree)[:, 1:]
    return (dc * C0 + 0.5 + (bands[:, :, None] * rest[:, : bands.shape[1]]).sum(1)).clamp_min(0.0)


def _check_sh_inputs(means: Tensor, dc: Tensor, rest: Tensor | None, origin: Tensor, degree: int) -> None:
    if not isinstance(degree, int) or not 0 <= degree <= 3:
        raise FormError(f"sh.colors: degree {degree!r}; expected 0..3")
    needed = sh_coefficient_count(degree) - 1
    if needed and rest is None:
        raise FormError(f"sh.colors: rest is None; expected (N, at least {needed}, C) for degree {degree}")
    tensors: list[tuple[str, Any, tuple[Shape, ...]]] = [("means", means, (("N", 3),)), ("dc", dc, (("N", "C"),))]
    if needed:
        tensors += [("rest", rest, (("N", "bands", "C"),)), ("origin", origin, ((3,),))]
    sizes: Sizes = {}
    fault = primitive_tensors_fault(tensors, sizes)
    if fault is None and needed and sizes["bands"][0] < needed:
        fault = f"rest has {sizes['bands'][0]} bands; expected at least {needed} for degree {degree}"
    if fault is not None:
        raise FormError(f"sh.colors: {fault}")


def truncate_sh_bands(params: Params, name: str, degree: int) -> dict[str, Tensor]:
    """Return the parameters without the spherical-harmonics bands above ``degree`` in the parameter ``name``.

    Spherical harmonics are orthogonal, so this is the least-squares fit over all directions (before colours are clamped
    at 0). With degree 0, the parameter is removed.
    """
    kept = {key: value for key, value in params.items() if key != name}
    return {**kept, name: params[name][:, : sh_coefficient_count(degree) - 1].contiguous()} if degree else kept


_DARKEST = 1e-3
"""Lowest initial colour. At 0 and below, max(0, colour) passes no gradient, so black primitives would stay black."""


def prunable_sh_coefficients(degree: int, channels: int, name: str) -> tuple[PrunableUnit, ...]:
    """Return one prunable unit for each spherical-harmonics coefficient and channel, in groups by band.

    The coefficients are the parameter ``name``, (N, (degree + 1)^2 - 1, ``channels``) for N primitives.
    """
    return tuple(
        PrunableUnit(
            f"coefficient {band} {order - band:+d}, channel {c}", {name: (band * band - 1 + order, c)}, f"band {band}"
        )
        for band in range(1, degree + 1)
        for order in range(2 * band + 1)
        for c in range(channels)
    )


def initial_sh_dc(color: Tensor) -> Tensor:
    """Return (N, C) float32 zero-order coefficients that give the colours ``color`` (N, C) in all directions.

    Colours below 1e-3 are raised to 1e-3, because a colour that is clamped at 0 would pass no gradient.
    """
    return ((color.clamp_min(_DARKEST) - 0.5) / C0).float()

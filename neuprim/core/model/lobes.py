"""View-dependent colours from spherical Gaussian lobes: a base colour plus smooth peaks around a few directions.

    c(d) = max(0, C0 dc + 1/2 + sum_l a_l exp(s_l (m_l . d - 1)))

d is the unit direction from the camera to the primitive's centre, and C0 dc + 1/2 is the base colour. Lobe l has the
amplitude a_l, one number per channel, the axis m_l = axis_l / |axis_l| and the sharpness s_l = exp(log s_l). Spherical
Gaussians of this form are those of Wang et al. 2009 (All-frequency rendering of dynamic, spatially-varying
reflectance).
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.errors import FormError
from neuprim.core.model.colour_constants import C0, LOG_LIMIT, MOST_LOBES, SHORTEST
from neuprim.core.model.schema import Params
from neuprim.core.model.sh import sh_colors
from neuprim.core.model.tensors import Sizes, primitive_tensors_fault

__all__ = ["lobe_colors"]

AMPLITUDE, AXIS, LOG_SHARPNESS = "lobe_amplitude", "lobe_axis", "lobe_log_sharpness"
"""Names of the parameters of lobes: (N, L, C), (N, L, 3) and (N, L), for L lobes per primitive and C channels."""


def lobe_colors(
    means: Tensor, dc: Tensor, amplitude: Tensor, axis: Tensor, log_sharpness: Tensor, origin: Tensor
) -> Tensor:
    """Return the (N, C) colours of primitives with spherical Gaussian lobes, in the colour space of the images.

    c(d) = max(0, C0 dc + 1/2 + sum_l a_l exp(s_l (m_l . d - 1))), d the unit direction from the camera to the centre.
    For float32 tensors, one compiled kernel computes all colours.

    Args:
        means: (N, 3) centres of the primitives, scene units.
        dc: (N, C) base colours as zero-order coefficients of spherical harmonics: C0 dc + 1/2 is the colour.
        amplitude: (N, L, C) amplitudes a_l of the L lobes of each primitive, L from 0 to 8.
        axis: (N, L, 3) axes m_l, of any length; the function normalises them.
        log_sharpness: (N, L) natural logarithms of the sharpnesses s_l.
        origin: (3,) position of the camera.

    Raises:
        FormError: a tensor has a wrong type, shape or device, or there are more than 8 lobes.
    """
    sizes: Sizes = {}
    fault = primitive_tensors_fault(
        [
            ("means", means, (("N", 3),)),
            ("dc", dc, (("N", "C"),)),
            ("amplitude", amplitude, (("N", "L", "C"),)),
            ("axis", axis, (("N", "L", 3),)),
            ("log_sharpness", log_sharpness, (("N", "L"),)),
            ("origin", origin, ((3,),)),
        ],
        sizes,
    )
    if fault is None and sizes["L"][0] > MOST_LOBES:
        fault = f"amplitude has {sizes['L'][0]} lobes; expected at most {MOST_LOBES}"
    if fault is not None:
        raise FormError(f"lobes.lobe_colors: {fault}")
    if not axis.shape[1]:
        return sh_colors(means, dc, None, origin, 0)
    tensors = (means, dc, amplitude, axis, log_sharpness)
    if all(tensor.dtype == torch.float32 for tensor in tensors):
        if device.on_numba(*tensors):
            from neuprim.core.model import colours_cpu  # numba, loaded when first needed

            return colours_cpu.fused_lobe_colors(*tensors, origin)
        if device.on_warp(*tensors):
            from neuprim.core.model import colours_warp

            return colours_warp.fused_lobe_colors(*tensors, origin)
    centers = means.double()
    direction = _unit_or_zero(centers - device.to_device_like(origin, centers))
    nearness = ((_unit_or_zero(axis.double()) * direction[:, None]).sum(-1) - 1).clamp_max(0.0)
    weight = (log_sharpness.double().clamp(-LOG_LIMIT, LOG_LIMIT).exp() * nearness).exp()
    mixed = C0 * dc.double() + 0.5 + (weight[..., None] * amplitude.double()).sum(1)
    return mixed.clamp_min(0.0).to(dc.dtype)


def _unit_or_zero(vectors: Tensor) -> Tensor:
    length = vectors.norm(dim=-1, keepdim=True)
    return torch.where(length <= SHORTEST, 0.0, vectors / length.clamp_min(SHORTEST))  # NaN stays NaN


def random_lobe_axes(count: int, lobes: int, generator: torch.Generator) -> Tensor:
    """Draw the lobe axes of ``count`` primitives: (count, lobes, 3) float32 unit vectors, uniform over the sphere."""
    drawn = torch.randn((count, lobes, 3), generator=generator, dtype=torch.float64)
    return _unit_or_zero(drawn).float()


def reduce_lobes(params: Params, keep: int) -> dict[str, Tensor]:
    """Return the parameters with fewer lobes: each primitive keeps the ``keep`` lobes that vary most over directions.

    The mean of each removed lobe over all directions is added to the base colour.
    """
    amplitude = params[AMPLITUDE].double()
    s = params[LOG_SHARPNESS].double().clamp(-LOG_LIMIT, LOG_LIMIT).exp()
    pointed = params[AXIS].double().norm(dim=-1) > SHORTEST
    mean = torch.where(pointed, -torch.expm1(-2 * s) / (2 * s), (-s).exp())
    square = torch.where(pointed, -torch.expm1(-4 * s) / (4 * s), (-2 * s).exp())
    varied = amplitude.square().sum(-1) * (square - mean.square()).clamp_min(0)
    order = varied.argsort(dim=1, descending=True, stable=True)
    kept, gone = order[:, :keep].sort(dim=1).values, order[:, keep:]
    found = {key: value for key, value in params.items() if key not in (AMPLITUDE, AXIS, LOG_SHARPNESS)}
    left = (mean[..., None] * amplitude).gather(1, gone[..., None].expand(-1, -1, amplitude.shape[-1])).sum(1)
    found["sh_dc"] = (params["sh_dc"].double() + left / C0).to(params["sh_dc"])
    if keep:
        for name in (AMPLITUDE, AXIS):
            width = params[name].shape[-1]
            found[name] = params[name].gather(1, kept[..., None].expand(-1, -1, width)).contiguous()
        found[LOG_SHARPNESS] = params[LOG_SHARPNESS].gather(1, kept).contiguous()
    return found

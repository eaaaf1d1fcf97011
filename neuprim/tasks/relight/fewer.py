"""A colour network with fewer units: those whose part of the colour varies most stay, the others leave their mean
behind.

A unit is cos(phi + beta (W_x x~ + W_d d + W_l l)). With x~ over the ellipsoid, and d and l over all directions, the
mean is

    cos(phi) b(|beta W_x diag|) sinc(|beta W_d|) sinc(|beta W_l|)

with b the mean over a ball (:func:`~neuprim.core.model.cosine_sums.ball_mean`), and the variance follows from cos^2
= (1 + cos 2(.))/2.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.model.cosine_sums import ball_mean
from neuprim.core.model.edge import sinc
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import Params

__all__ = ["fewer_units"]


def fewer_units(params: Params, geometry: Geometry, keep: int, boost: float, multiplicative: bool) -> dict[str, Tensor]:
    """The tensors of a :class:`~neuprim.tasks.relight.colour.LightNetwork` with ``keep`` units for each primitive.

    Args:
        params: c_dc (N, C), net_x, net_view and net_light (N, H, 3), net_phase (N, H), and net_out (N, C, H), or (N, 1,
        H) of the
            multiplicative form.
        multiplicative: which form it is; there the mean becomes part of the albedo.
    """
    net_x, view, light = (params[name].double() * boost for name in ("net_x", "net_view", "net_light"))
    phase, out = boost * params["net_phase"].double(), params["net_out"].double()
    semi_axes = (geometry.log_scales.double() - geometry.log_length_scale.double()[:, None]).exp()
    rotations = Geometry(geometry.means.double(), geometry.log_scales.double(), geometry.quats.double()).rotations
    rates = ((net_x @ rotations) * semi_axes[:, None, :]).norm(dim=-1), view.norm(dim=-1), light.norm(dim=-1)

    def mean_of(times: int) -> Tensor:
        return (times * phase).cos() * ball_mean(times * rates[0]) * sinc(times * rates[1]) * sinc(times * rates[2])

    mean = mean_of(1)
    variance = (1 + mean_of(2)) / 2 - mean.square()
    order = (out.square().sum(1) * variance).argsort(dim=1, descending=True, stable=True)
    kept, gone = order[:, :keep].sort(dim=1).values, order[:, keep:]
    fewer = {
        name: params[name].gather(1, kept[..., None].expand(-1, -1, 3)).contiguous()
        for name in ("net_x", "net_view", "net_light")
    }
    fewer["net_phase"] = params["net_phase"].gather(1, kept).contiguous()
    outputs = out.shape[1]
    stays = params["net_out"].gather(2, kept[:, None].expand(-1, outputs, -1))
    left = (out * mean[:, None]).gather(2, gone[:, None].expand(-1, outputs, -1)).sum(2)
    base = params["c_dc"].double()
    if not multiplicative:
        return {**params, **fewer, "net_out": stays.contiguous(), "c_dc": (base + left).to(params["c_dc"])}
    # c_dc (1 + left + w . h) = c_dc (1 + left) (1 + w/(1 + left) . h); where little would be left, only the units go
    scale = torch.where(1 + left > 0.1, 1 + left, torch.ones_like(left))
    return {
        **params,
        **fewer,
        "net_out": (stays.double() / scale[:, :, None]).to(params["net_out"]).contiguous(),
        "c_dc": (base * scale).to(params["c_dc"]),
    }

"""Single primitives of a frame: the ellipsoids that one sees, which of them lies under the mouse, and its numbers in
words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.channels import Channels
from neuprim.core.errors import ConfigError
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.pairs import Pairs
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.core.render.near import decided
from neuprim.inspect.field import absorbed
from neuprim.viewer.frame import Look

__all__ = ["Ellipsoids", "described", "ellipsoid_of", "ellipsoids_of", "strongest"]

_SHOWN = 24
"""Numbers of a parameter that are written out."""


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """M ellipsoids where they are in a frame.

    Attributes:
        rows: (M,) int64 of the model.
        positions: (M, 3), scales: (M, 3) semi-axes, scene units; wxyz: (M, 4) unit quaternions. float32.
        colours: (M, 3) uint8 sRGB at their centres, as seen from the frame's camera.
    """

    rows: np.ndarray
    positions: np.ndarray
    wxyz: np.ndarray
    scales: np.ndarray
    colours: np.ndarray


def ellipsoids_of(model: Primitives, look: Look, channels: Channels, most: int) -> Ellipsoids:
    """The ellipsoids of a look's frame, at most so many: those that absorb most."""
    with torch.no_grad():
        lowered = model.lower(look.camera, look.conditions)
        count = lowered.geometry.count
        keep = torch.arange(count)
        if count > most:
            mass = absorbed(model.to(torch.device("cpu")).active(look.conditions))
            keep = torch.from_numpy(np.sort(np.argsort(-mass, kind="stable")[:most]))
        colours = channels.display_rows(
            lowered.center_colors(look.camera.position.to(lowered.geometry.means)).float().cpu().clamp_min(0)
        )
        rows = torch.arange(count) if lowered.rows is None else lowered.rows.cpu()
        return _of(lowered.geometry, keep, rows, np.rint(255 * colours.numpy()).astype(np.uint8))


def ellipsoid_of(model: Primitives, look: Look, row: int) -> Ellipsoids | None:
    """One primitive of the model, yellow; None where it does not live in the frame.

    Raises:
        ConfigError: the model has no such primitive.
    """
    if not 0 <= row < model.count:
        raise ConfigError(f"primitive {row}: the model has {model.count} primitives, 0 to {model.count - 1}")
    with torch.no_grad():
        active = model.active(look.conditions)
    rows = torch.arange(model.count) if active.rows is None else active.rows.cpu()
    place = (rows == row).nonzero()[:, 0]
    if not len(place):
        return None
    return _of(active.geometry, place, rows, np.tile(np.array([[255, 210, 0]], np.uint8), (len(rows), 1)))


def _of(geometry: Geometry, keep: Tensor, rows: Tensor, colours: np.ndarray) -> Ellipsoids:
    means, scales, quats = (x.detach().float().cpu()[keep] for x in (geometry.means, geometry.scales, geometry.quats))
    quats = quats / quats.norm(dim=-1, keepdim=True)
    return Ellipsoids(rows[keep].numpy(), means.numpy(), quats.numpy(), scales.numpy(), colours[keep.numpy()])


def strongest(model: Primitives, look: Look, direction: np.ndarray, settings: RenderSettings) -> int | None:
    """The row of the primitive that contributes most to what is seen along a ray from the look's camera; None where
    nothing is.

    The ray is drawn as the reference renderer draws it: chords cut at the near plane, composited by the depth of the
    centres.

    Args:
        direction: (3,) of the ray, scene axes, any norm.
    """
    with torch.no_grad():
        lowered = model.to(torch.device("cpu")).lower(look.camera, look.conditions, settings)
        g, origin = lowered.geometry, look.camera.position.double()
        d = torch.as_tensor(np.asarray(direction, np.float64))
        d = d / d.norm()
        forward = look.camera.viewmat[2, :3].double()
        near = decided(settings, g.means, [look.camera]).near_plane / max(float(forward @ d), 1e-9)
        offset = origin - g.means.double()
        axes = g.scales.double()
        p, v = (
            (g.rotations.double().transpose(1, 2) @ x[..., None])[..., 0] / axes for x in (offset, d.expand_as(offset))
        )
        a = v.square().sum(-1)
        middle = -(p * v).sum(-1) / a
        D = 1 - (p + middle[:, None] * v).square().sum(-1)
        half = (D.clamp_min(0) / a).sqrt()
        t0, t1 = (middle - half).clamp_min(near), middle + half
        prim = ((D > 0) & (t1 > near)).nonzero()[:, 0]
        prim = prim[
            torch.argsort((offset[prim] @ forward), descending=True, stable=True)
        ]  # front to back: offset is from the centre
        if not len(prim):
            return None
        pairs = Pairs.of(g, prim, origin, d.expand(len(prim), 3), t0[prim], t1[prim])
        alpha = -torch.expm1(-lowered.optical_depth(pairs).clamp_min(0))
        alpha = alpha.clamp_max(settings.alpha_max)
        alpha = torch.where(alpha >= settings.alpha_min, alpha, 0.0)
        weight = alpha * torch.cat([torch.ones(1, dtype=alpha.dtype), (1 - alpha).cumprod(0)[:-1]])
        best = int(weight.argmax())
        if float(weight[best]) <= 0:
            return None
        return int(prim[best]) if lowered.rows is None else int(lowered.rows[prim[best]])


def described(model: Primitives, row: int) -> str:
    """Every parameter of a primitive, a line each, and what follows from its geometry."""
    lines = [f"primitive {row} of {model.count}"]
    axes = model.params["log_scales"][row].detach().double().exp().tolist()
    lines.append(f"semi-axes {' '.join(f'{x:.4g}' for x in axes)} scene units")
    for spec in model.specs:
        values = model.params[spec.name][row].detach().double().flatten().tolist()
        more = f" … ({len(values)} numbers)" if len(values) > _SHOWN else ""
        lines.append(f"{spec.name}: {' '.join(f'{x:.4g}' for x in values[:_SHOWN])}{more}")
    return "\n".join(lines)

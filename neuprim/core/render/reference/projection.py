"""Exact screen bounds of ellipsoids (support radius 1), float64."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.geometry import Geometry, quaternion_to_matrix

__all__ = ["screen_boxes"]


def screen_boxes(geometry: Geometry, camera: Camera, near: float) -> Tensor:
    """(N, 4) pixel-coordinate bounds (x0, y0, x1, y1) of each ellipsoid's projection, float64.

    For the plane through the camera spanned by an image axis i and the optical axis, the tangents to the ellipsoid are
    x_i/z = (k +- sqrt(D))/(z^2 - S_zz) with k = c_i z - S_iz and D = z^2 S_ii - 2 c_i z S_iz + c_i^2 S_zz - (S_ii S_zz
    - S_iz^2),
    S = B diag(s^2) B^T the ellipsoid's shape in camera axes and c its centre. D is written without the cancelling c_i^2
    z^2.
    An ellipsoid that the near plane cuts bounds to the whole screen, one behind it to nothing (x1 < x0).
    """
    view = camera.viewmat.detach().double()
    R = view[:3, :3]
    c = geometry.means.detach().double() @ R.T + view[:3, 3]
    s = geometry.log_scales.detach().double().exp()
    B = R @ quaternion_to_matrix(geometry.quats.detach().double())
    L = B * s[:, None, :]
    S = L @ L.transpose(1, 2)
    z, szz = c[:, 2], S[:, 2, 2]
    reach = szz.sqrt()
    front = z - reach > near
    out = []
    for i, f, c0, size in ((0, camera.fx, camera.cx, camera.width), (1, camera.fy, camera.cy, camera.height)):
        ci, sii, siz = c[:, i], S[:, i, i], S[:, i, 2]
        D = z * z * sii - 2 * ci * z * siz + ci * ci * szz - (sii * szz - siz * siz)
        root = D.clamp_min(0).sqrt()
        k = ci * z - siz
        den = torch.where(front, z * z - szz, torch.ones_like(z))
        whole = torch.tensor([0.0, float(size)], dtype=torch.float64)
        out.append(torch.where(front, f * (k - root) / den + c0, whole[0]))
        out.append(torch.where(front, f * (k + root) / den + c0, whole[1]))
    box = torch.stack([out[0], out[2], out[1], out[3]], -1)
    behind = z + reach <= near
    box[behind] = torch.tensor([0.0, 0.0, -1.0, -1.0], dtype=torch.float64)
    return box

"""Gaussians of 3D Gaussian splatting (Kerbl et al. 2023) in place of neural primitives, and how that method draws
them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.world import World
from neuprim.core.extensions import TrainedModel
from neuprim.core.model.fields import Conditions
from neuprim.core.model.geometry import Geometry
from neuprim.export.appearance import Harmonics

__all__ = ["SIZES", "Gaussians", "draw_gaussians", "fit_gaussians"]

SIZES = ("moments", "footprint", "profile")
"""What the size of a Gaussian may be fitted to."""


_SIDE = 12
"""Points of the quadrature along an axis of the unit ball; a density of 30 rad across a primitive has five waves in
it."""
_CHUNK = 512
_FACTORS = [1.06**i for i in range(-24, 25)]
"""On the covariance, a quarter to four: how much wider than its density's a footprint may be. Steps of three percent in
size."""
_NEAR, _BLUR, _ALPHA_MAX, _ALPHA_MIN, _TRANSMITTANCE_MIN = (
    0.2,
    0.3,
    0.99,
    1.0 / 255.0,
    1e-4,
)  # of the authors' rasteriser


@dataclass(frozen=True)
class Gaussians:
    """M Gaussians; float64.

    Attributes:
        means: (M, 3), covariances: (M, 3, 3), scene units.
        opacities: (M,) alpha at the middle of the footprint, 0..1.
        rows: (M,) which of the active primitives each stands for.
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    rows: Tensor

    def within(self, world: World) -> Gaussians:
        """The same in the scene of ``world``, where these are in the world; of an identity these."""
        if world.identity:
            return self
        linear = world.scene_from_world[:3, :3]
        return replace(self, means=world.scene_points(self.means), covariances=linear @ self.covariances @ linear.T)

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """(M, 3) standard deviations, and (M, 4) quaternions wxyz of the axes."""
        values, vectors = np.linalg.eigh(self.covariances.numpy())
        vectors[np.linalg.det(vectors) < 0, :, 0] *= -1
        quats = Rotation.from_matrix(vectors).as_quat()[:, [3, 0, 1, 2]] if len(values) else np.zeros((0, 4))
        return np.sqrt(np.maximum(values, 1e-30)), quats


def fit_gaussians(run: TrainedModel, conditions: Conditions, size: str) -> Gaussians:
    """One Gaussian per primitive that absorbs anything.

    By quadrature on the ellipsoid, with rho = max(0, sigma): mean and covariance are those of rho; the opacity is the
    mean over the ellipsoid's three axes of 1 - exp(-tau), tau the integral of rho along the axis' ray through that
    mean. That is ``size="moments"``. A 3DGS footprint is opacity x exp(-d^2/2) on the screen, never more than a bell,
    while an opaque primitive is flat with an edge, so the covariance is scaled: with "footprint" so that both cover the
    same area, the mean over the axes of the integral of alpha across the screen; with "profile" so that the bell is
    closest to alpha, by least squares over the three axes' screens, among those whose opacity makes up the area.
    """
    model = run.model
    with torch.no_grad():
        active = model.active(conditions)
        own, still, moved = active.own, active.stored, active.geometry
        parts = [
            _fit(model.density.density, {n: v[i : i + _CHUNK] for n, v in own.items()}, still[i : i + _CHUNK], moved[i : i + _CHUNK], conditions, size)
            for i in range(0, still.count, _CHUNK)
        ]  # fmt: skip
    empty = (torch.zeros(0, 3), torch.zeros(0, 3, 3), torch.zeros(0), torch.zeros(0, dtype=torch.bool))
    means, covariances, opacities, kept = (torch.cat(column) for column in zip(empty, *parts, strict=True))
    found = kept.nonzero()[:, 0]
    return Gaussians(means[found].double(), covariances[found].double(), opacities[found].double(), found)


def _fit(density, own, still: Geometry, moved: Geometry, conditions: Conditions, size: str) -> tuple[Tensor, ...]:  # type: ignore[no-untyped-def]
    n, step = still.count, 2.0 / _SIDE
    ticks = (torch.arange(_SIDE, dtype=torch.float64) + 0.5) * step - 1
    ball = torch.cartesian_prod(ticks, ticks, ticks)
    inside = ball.square().sum(-1) < 1
    scales, R = moved.scales.double(), moved.rotations.double()
    points = moved.means.double()[:, None] + torch.einsum("nij,pj->npi", R * scales[:, None, :], ball[inside])
    prim = torch.arange(n).repeat_interleave(int(inside.sum()))
    rho = torch.zeros(n, len(ball), dtype=torch.float64)
    rho[:, inside] = (
        density(own, still, prim, points.reshape(-1, 3).float(), conditions).double().reshape(n, -1).clamp_min(0)
    )
    total = rho.sum(1)
    kept = total * step**3 * scales.amin(1) > 1e-9  # an optical depth that no image shows
    weight = rho / total.clamp_min(1e-300)[:, None]
    mean = weight @ ball
    spread = torch.einsum("np,npi,npj->nij", weight, ball - mean[:, None], ball - mean[:, None])
    cube = rho.reshape(n, _SIDE, _SIDE, _SIDE)
    middle = ((mean + 1) / step).floor().long().clamp(0, _SIDE - 1)
    every = torch.arange(n)
    alphas, areas, bells, screens = [], [], [], []
    for axis in range(3):
        alpha = -torch.expm1(-cube.sum(axis + 1) * step * scales[:, axis, None, None])
        u, v = (a for a in range(3) if a != axis)
        flat = spread[:, [u, u, v, v], [u, v, u, v]].reshape(n, 2, 2)
        alphas.append(alpha[every, middle[:, u], middle[:, v]])
        areas.append(alpha.sum((1, 2)) * step * step)
        bells.append(2 * torch.pi * torch.linalg.det(flat).clamp_min(1e-12).sqrt())
        screens.append((alpha, flat, mean[:, [u, v]], scales[:, u] * scales[:, v]))
    opacity = torch.stack(alphas).mean(0).clamp(1e-6, 1 - 1e-6)
    if size == "footprint":
        spread = spread * (torch.stack(areas) / (opacity * torch.stack(bells))).mean(0)[:, None, None]
    elif size == "profile":
        wider, opacity = _closest(screens, torch.stack(areas), torch.stack(bells), ticks)
        spread = spread * wider[:, None, None]
    world = R * scales[:, None, :]
    return (
        moved.means.double() + (world @ mean[:, :, None])[..., 0],
        world @ spread @ world.transpose(1, 2),
        opacity,
        kept,
    )


def _closest(
    screens: Sequence[tuple[Tensor, ...]], areas: Tensor, bells: Tensor, ticks: Tensor
) -> tuple[Tensor, Tensor]:
    """(n,) factors on the covariance and (n,) opacities of the bells closest to what three screens show, (alpha,
    covariance, mean, area) each.

    For each of some factors, the opacity is that with the same integral of alpha over the screens, at most 0.99; taken
    is the factor with the least squares of what is left, over the whole of the screens: the part of a bell that is
    outside the primitive's own is known in closed form.
    """
    step = ticks[1] - ticks[0]
    weights = torch.stack([screen[3] for screen in screens])
    u, v = torch.meshgrid(ticks, ticks, indexing="ij")
    away = []
    for _, flat, mean, _ in screens:
        d = torch.stack([u - mean[:, 0, None, None], v - mean[:, 1, None, None]], -1)
        inverse = torch.linalg.inv(flat + 1e-12 * torch.eye(2, dtype=torch.float64))
        away.append(torch.einsum("nuvi,nij,nuvj->nuv", d, inverse, d))
    best: tuple[Tensor, ...] = ()
    for factor in _FACTORS:
        opacity = ((weights * areas).sum(0) / (weights * bells * factor).sum(0)).clamp(1e-6, _ALPHA_MAX)
        error = torch.zeros_like(opacity)
        for weight, bell, square, (alpha, *_) in zip(weights, bells, away, screens, strict=True):
            common = (alpha * (-0.5 / factor * square).exp()).sum((1, 2)) * step * step
            error = error + weight * (opacity.square() * bell * factor / 2 - 2 * opacity * common)
        new = (error, torch.full_like(error, factor), opacity)
        best = tuple(torch.where(error < best[0], x, y) for x, y in zip(new, best, strict=True)) if best else new
    return best[1], best[2]


def draw_gaussians(gaussians: Gaussians, colours: Harmonics, camera: Camera, background: Tensor) -> Tensor:
    """(H, W, 3) float32 image as the 3DGS rasteriser makes it, in float64.

    Projection by its local affine approximation (EWA), 0.3 square pixels of blur, alpha = min(0.99, opacity
    exp(-d^2/2)), pairs below 1/255 skipped, front to back by the depth of centres, stop before the transmittance falls
    below 1e-4; Gaussians nearer than 0.2 are left out. Unlike there, a footprint ends where alpha is 1/255, not at the
    tile around three standard deviations.
    """
    view = camera.viewmat.double()
    W, t = view[:3, :3], gaussians.means @ view[:3, :3].T + view[:3, 3]
    order = torch.argsort(t[:, 2], stable=True)
    order = order[t[order, 2] > _NEAR]
    t, cov = t[order], gaussians.covariances[order]
    z = t[:, 2]
    limits = 1.3 * 0.5 * camera.width / camera.fx, 1.3 * 0.5 * camera.height / camera.fy
    x, y = ((t[:, a] / z).clamp(-limits[a], limits[a]) * z for a in (0, 1))
    J = torch.zeros(len(t), 2, 3, dtype=torch.float64)
    J[:, 0, 0], J[:, 0, 2], J[:, 1, 1], J[:, 1, 2] = (
        camera.fx / z,
        -camera.fx * x / z**2,
        camera.fy / z,
        -camera.fy * y / z**2,
    )
    flat = J @ W @ cov @ W.T @ J.transpose(1, 2) + _BLUR * torch.eye(2, dtype=torch.float64)
    centers = torch.stack([camera.fx * t[:, 0] / z + camera.cx, camera.fy * t[:, 1] / z + camera.cy], -1)
    away = gaussians.means[order] - camera.position.double()
    colors = colours.towards(gaussians.rows[order], away / away.norm(dim=-1, keepdim=True)).numpy()
    inverse, opacity = torch.linalg.inv(flat).numpy(), gaussians.opacities[order].numpy()
    reach = (
        np.sqrt(2 * np.log(np.maximum(opacity / _ALPHA_MIN, 1.0)))[:, None]
        * flat.diagonal(dim1=1, dim2=2).sqrt().numpy()
    )
    middle = centers.numpy()
    first = np.clip(np.floor(middle - reach), 0, [camera.width, camera.height]).astype(int)
    last = np.clip(np.ceil(middle + reach), 0, [camera.width, camera.height]).astype(int)
    image, left = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    for i in np.flatnonzero((last > first).all(1) & (opacity >= _ALPHA_MIN)):
        (x0, y0), (x1, y1) = first[i], last[i]
        dx, dy = np.arange(x0, x1) + 0.5 - middle[i, 0], (np.arange(y0, y1) + 0.5 - middle[i, 1])[:, None]
        power = -0.5 * (inverse[i, 0, 0] * dx * dx + inverse[i, 1, 1] * dy * dy) - inverse[i, 0, 1] * dx * dy
        alpha = np.minimum(_ALPHA_MAX, opacity[i] * np.exp(power))
        here = left[y0:y1, x0:x1]
        after = here * (1 - alpha)
        drawn = (alpha >= _ALPHA_MIN) & (here > 0)
        ends = drawn & (after < _TRANSMITTANCE_MIN)
        drawn &= ~ends
        image[y0:y1, x0:x1] += np.where(drawn, here * alpha, 0.0)[..., None] * colors[i]
        here[drawn] = after[drawn]
        here[ends] = -here[ends]  # finished: the sign marks it, the magnitude still lets the background through
    picture: Tensor = torch.from_numpy(image + np.abs(left)[..., None] * background.double().numpy()).float()
    return picture

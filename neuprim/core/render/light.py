"""The light that arrives at a primitive: its direction, its intensity, and its visibility through other primitives."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.threads import chunk_size, parallel_for
from neuprim.core.model.fields import Conditions, LoweredDensity, Shading
from neuprim.core.model.geometry import Geometry
from neuprim.core.render import render_slabs
from neuprim.core.render.layer_frame import LayerFrame, LayerSpec
from neuprim.core.settings import RenderSettings

VISIBILITY = ("none", "primitive", "pixel")
"""Where the visibility of the light (1: lit, 0: in shadow) can be computed: nowhere, at the centres of the primitives,
or at the mean depth of each pixel."""

# ---------------------------------------------------------------- directions

_MIN_LENGTH = 1e-6  # in units of ``size``; a direction's gradient, 1/length, stays below 1e6 per size
_MIN_LIGHT_DISTANCE = 1e-4  # in units of a primitive's size; a nearer light does not get stronger


def normalize_direction(vector: Tensor, size: Tensor | float = 1.0) -> Tensor:
    """Return (..., 3) unit vectors; vectors shorter than 1e-6 ``size`` are divided by 1e-6 ``size``."""
    scaled = vector / vector.detach().abs().amax(-1, keepdim=True).clamp_min(_MIN_LENGTH * size)
    return scaled / scaled.norm(dim=-1, keepdim=True).clamp_min(1.0)


def check_typical_light(typical: float) -> None:
    if not 0 < typical < math.inf:
        raise ValueError(f"typical light {typical!r}; expected a number above 0")


def light_factor(geometry: Geometry, conditions: Conditions, typical: float, falloff: bool) -> Tensor:
    """Return the (N, C) light intensity at N primitives, divided by the intensity ``typical``.

    With ``falloff``, the result is also divided by the squared distance from the light to the primitive's centre.
    """
    means = geometry.means
    strength = device.to_device_like(conditions["light_intensity"], means) / typical
    if not falloff:
        return strength.reshape(1, -1).expand(len(means), -1)
    squared = (device.to_device_like(conditions["light"], means) - means).square().sum(-1, keepdim=True)
    return strength / squared.clamp_min((_MIN_LIGHT_DISTANCE * geometry.detached_length_scale[:, None]).square())


# ---------------------------------------------------------------- visibility

SIZE = 192  # pixels per side of the square depth images
LAYERS = 4  # slabs of equal depth; more of them separate depths better and take longer
VOLUME_SIZE, VOLUME_LAYERS = 96, 24  # for smoke, which shadows itself at every depth; 48, 16: dense smoke loses 1 dB

FADE, EXTENTS, PIXEL_FADE = 1 / 50, 1.5, 1 / 10
"""Distances over which light fades behind a depth image of a shadow map. At a primitive, the distance is FADE scene
diameters plus EXTENTS times the primitive's own extent towards the light. At a pixel, the distance is PIXEL_FADE scene
diameters. Surfaces made of ellipsoids are bumpy: with shorter distances, the bumps shadow each other; with longer
distances, shadows detach from their casters. A point at the depth of the depth image keeps all of its light."""

_FAR = 1e3  # scene radii; beyond, all rays are parallel, and float32 depths lose all digits
_OUTSIDE = 1 / 0.94  # scene radii; one camera sees everything from a light that is farther away
_CHUNK = 1024  # points per unit of work


def shade_by_light(
    where: str, geometry: Geometry, density: LoweredDensity, conditions: Conditions, settings: RenderSettings
) -> Shading | None:
    """Return the visibility of the light, a factor on colours; None if ``where`` is "none".

    ``where`` is one of :data:`VISIBILITY`. With "primitive", the visibility is computed at the primitives' centres;
    with "pixel", at the mean depth of each pixel.
    """
    if where == "none":
        return None
    light = conditions["light"]
    visible = light_visibility(geometry, density, light, settings)
    if where == "pixel":
        return Shading(pixels=partial(visible, fade=PIXEL_FADE))
    return Shading(primitives=visible(geometry.means, FADE, EXTENTS * extents_towards(geometry, light)))


def shade_volume_by_light(
    geometry: Geometry, density: LoweredDensity, conditions: Conditions, settings: RenderSettings
) -> Shading:
    """Return the visibility of the light at the primitives' centres, for overlapping primitives such as smoke.

    The primitives are sorted into slabs (ranges of depth from the light). Each slab absorbs light gradually, around its
    mean depth, over a distance of 1/VOLUME_LAYERS of the scene's diameter.
    """
    visible = light_visibility(geometry, density, conditions["light"], settings, VOLUME_SIZE, VOLUME_LAYERS)
    return Shading(primitives=visible(geometry.means, 1 / VOLUME_LAYERS, before=0.5))


@torch.no_grad()
def extents_towards(geometry: Geometry, point: Tensor) -> Tensor:
    """Return the (N,) extent of each ellipsoid along the direction from its centre to ``point`` (3,), in scene units.

    The extent is the distance between the two planes that touch the ellipsoid and are perpendicular to this direction.
    """
    towards = device.to_device_like(point, geometry.means) - geometry.means
    units = normalize_direction(towards, geometry.detached_length_scale[:, None])
    quats = geometry.quats / geometry.quats.norm(dim=-1, keepdim=True)
    turn = 2 * torch.linalg.cross(units, quats[:, 1:])  # turned into the ellipsoid's axes without the 3x3 matrices
    own = units + quats[:, :1] * turn + torch.linalg.cross(turn, quats[:, 1:])
    return 2 * (own * geometry.scales).norm(dim=-1)


class Visibility(Protocol):
    """Function of scene points (M, 3) that returns the (M,) float32 visibility of a light, 0 to 1, at the points.

    A slab is a group of primitives at similar depth from the light. At each slab, light fades over a distance of
    ``fade`` scene diameters plus ``more`` (M,) scene units. The fraction ``before`` of this distance lies before the
    slab's mean depth, the rest behind.
    """

    def __call__(self, points: Tensor, fade: float, more: Tensor | None = None, before: float = 0.0) -> Tensor: ...


def light_visibility(
    geometry: Geometry,
    density: LoweredDensity,
    light: Tensor,
    settings: RenderSettings,
    size: int = SIZE,
    layers: int = LAYERS,
) -> Visibility:
    """Return the function that gives the visibility of a point light (3,), computed by layered shadow maps.

    The primitives are sorted into ``layers`` slabs by depth from the light. Each slab is rendered alone, as an image of
    ``size`` x ``size`` pixels with opacity A_k and mean depth d_k. The visibility of the light at a point x of depth z
    is the transmittance

        V(x) = prod_k (1 - A_k s((z - d_k)/fade + before)),      s a smooth step from 0 at 0 to 1 at 1.

    fade is the distance over which light fades at a slab; for ``before`` see :class:`Visibility`. With ``before`` = 0,
    V is exactly 1 where nothing lies in front, and 1 - A well behind an object of opacity A. A single slab would be an
    ordinary shadow map. The depth of such a map is one mean per pixel, between a translucent object and the floor below
    it.

    The light's camera looks at the middle of all centres and sees all of them. If the light is among the primitives or
    close to them, six cameras look along the axes of the scene instead, and each has maps of its own. Inverse depths,
    weighted by opacity, are interpolated bilinearly. The interpolation is exact on planes, so that a lit floor does not
    shadow itself at grazing light. V has no gradient. The depth images are rendered with the backend and threads of the
    frame's ``settings``.
    """
    with torch.no_grad():
        if not geometry.count:
            return _see_everything
        means = geometry.means.detach().double()
        light = light.detach().double()
        middle = (means.amin(0) + means.amax(0)) / 2
        far, largest = (means - middle).norm(dim=-1).max(), geometry.scales.detach().max()
        *place, far_away, margin = torch.cat([middle, far[None], largest.double()[None]]).tolist()  # one GPU sync
        center, light = torch.tensor(place, dtype=torch.float64), light.cpu()
        radius = far_away + margin
        distance = float((light - center).norm())
        if distance > _FAR * radius:
            light, distance = center + (light - center) * (_FAR * radius / distance), _FAR * radius
        own = replace(settings, depth=True, samples=1)
        if distance > _OUTSIDE * radius:
            overhead = abs(float(light[2] - center[2])) >= 0.9 * distance
            up = torch.tensor([0.0, 1.0, 0.0] if overhead else [0.0, 0.0, 1.0], dtype=torch.float64)
            focal = 0.5 * size / math.tan(math.asin(radius / distance))
            view, near = look_at(light, center, up), max(1e-4 * radius, distance - 1.5 * radius)
            return _draw_shadow_maps(geometry, density, layers, own, _square_camera(view, focal, size), near, radius)
        axes = torch.cat([torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])
        extents, near, faces = geometry.scales.detach().amax(-1), 1e-4 * radius, []
        for axis in axes:
            # a little more than 90 degrees, so that a map has pixels on both sides of the edge to the next map
            camera = _square_camera(look_at(light, light + axis, axis.roll(1)), 0.5 * size - 1, size)
            ahead = (_camera_depths(means, camera) + extents > near).nonzero()[:, 0]
            seen = geometry[ahead], density.primitive_rows(ahead)
            face = _draw_shadow_maps(*seen, layers, own, camera, near, radius) if len(ahead) else _see_everything
            faces.append(face)

    def visibility(points: Tensor, fade: float, more: Tensor | None = None, before: float = 0.0) -> Tensor:
        points = points.detach().double()
        towards = points - device.to_device_like(light, points)
        nearest = (towards @ device.to_device_like(axes, points).T).argmax(-1)
        found = torch.ones(len(points), device=points.device)
        for k, face in enumerate(faces):
            rows = (nearest == k).nonzero()[:, 0]
            found[rows] = face(points[rows], fade, None if more is None else more[rows], before)
        return found

    return visibility


def _see_everything(points: Tensor, fade: float, more: Tensor | None = None, before: float = 0.0) -> Tensor:
    return torch.ones(len(points), device=points.device)


def _square_camera(view: Tensor, focal: float, size: int) -> Camera:
    return Camera(view, focal, focal, size / 2, size / 2, size, size)


def _camera_depths(means: Tensor, camera: Camera) -> Tensor:
    """Return the (N,) float64 depths of the centres ``means``, float64, along the camera's axis."""
    return means @ device.to_device_like(camera.viewmat[2, :3], means) + camera.viewmat[2, 3]


def _draw_shadow_maps(
    geometry: Geometry,
    density: LoweredDensity,
    layers: int,
    settings: RenderSettings,
    camera: Camera,
    near: float,
    radius: float,
) -> Visibility:
    """Render the shadow maps that a light's ``camera`` sees; see :func:`light_visibility`.

    ``near`` is the smallest depth that the camera sees, ``radius`` that of the whole scene.
    """
    depths = _camera_depths(geometry.means.detach().double(), camera)
    low, high = torch.stack([depths.min(), depths.max()]).tolist()
    slabs = ((depths - low) * (layers / max(high - low, 1e-30))).ceil_().long().sub_(1).clamp_(0, layers - 1)
    opacities, distances = render_slabs(geometry, density, slabs, layers, camera, replace(settings, near=near))
    view = camera.viewmat[:3].contiguous()
    maps = None
    if device.on_numba(depths, opacities):
        maps = interleave_shadow_maps(opacities.numpy(), distances.numpy(), near)

    def visibility(points: Tensor, fade: float, more: Tensor | None = None, before: float = 0.0) -> Tensor:
        points = points.detach().double().contiguous()
        fades = torch.full_like(points[:, 0], fade * 2.0 * radius)
        if more is not None:
            fades += more
        if maps is None:
            place = device.to_device_like(view, points)
            return sample_visibility(points, place, near, camera.fx, opacities, distances, fades, before)
        found = np.empty(len(points), np.float32)
        inputs = (points.numpy(), view.numpy(), near, camera.fx, maps, fades.numpy(), before, found)
        chunk = chunk_size(len(found), _CHUNK, settings.threads)
        parallel_for(_visibility_kernel, len(found), chunk, settings.threads, *inputs)
        return torch.from_numpy(found)

    return visibility


def sample_visibility(
    points: Tensor,
    view: Tensor,
    near: float,
    focal: float,
    alphas: Tensor,
    depths: Tensor,
    fades: Tensor,
    before: float = 0.0,
) -> Tensor:
    """Return the (M,) float32 visibility of a light at ``points`` (M, 3) float64; the torch version, for GPUs.

    ``alphas`` and ``depths`` (slabs, S, S) are the images of the shadow maps. ``view`` is the (3, 4) matrix from scene
    to light camera, ``focal`` the camera's focal length in pixels. Points with a depth of at most ``near`` are lit.
    ``fades`` (M,) are the distances over which light fades at a slab. The fraction ``before`` of each distance lies
    before the slab's mean depth.
    """
    nearness = torch.where(alphas > 0, alphas.double() / depths.double().clamp_min(near), 0.0)
    images = torch.stack([alphas.double(), nearness], 1)  # (slabs, 2, S, S)
    x, y, z = ((view[a, :3] * points).sum(-1) + view[a, 3] for a in range(3))
    ahead = (z > near) & x.isfinite() & y.isfinite() & z.isfinite()
    scale = 2.0 * focal / alphas.shape[1] / torch.where(ahead, z, 1.0)
    where = torch.where(ahead[:, None], torch.stack([x * scale, y * scale], -1), 0.0).clamp(-3.0, 3.0)
    # outside of the images nothing absorbs
    read = F.grid_sample(images.flatten(0, 1)[None], where[None, None], align_corners=False)[0, :, 0]
    alpha, inverse_depth = read.unflatten(0, (-1, 2)).unbind(1)
    behind = z - alpha / inverse_depth.clamp_min(1e-30)
    s = (behind / fades + before).clamp(0.0, 1.0)
    return torch.where(ahead, (1.0 - alpha * s * s * (3.0 - 2.0 * s)).prod(0), 1.0).float()


def interleave_shadow_maps(alphas: np.ndarray, depths: np.ndarray, near: float) -> np.ndarray:
    """Return each pixel's opacity and opacity / depth as a float64 array (S + 2, S + 2, 2, slabs) with a border of 0.

    ``alphas`` and ``depths`` (slabs, S, S) are the images of the shadow maps; depths count as at least ``near``.
    """
    slabs, size, _ = alphas.shape
    maps = np.zeros((size + 2, size + 2, 2, slabs))
    _interleave_kernel(alphas, depths, near, maps)
    return maps


@exact_kernel
def _interleave_kernel(alphas, depths, near, maps):  # type: ignore[no-untyped-def]
    for k in range(alphas.shape[0]):
        for i in range(alphas.shape[1]):
            for j in range(alphas.shape[2]):
                alpha = np.float64(alphas[k, i, j])
                if alpha > 0.0:  # most pixels of a slab are empty
                    maps[i + 1, j + 1, 0, k] = alpha
                    maps[i + 1, j + 1, 1, k] = alpha / max(np.float64(depths[k, i, j]), near)


@exact_kernel
def _visibility_kernel(start, stop, points, view, near, focal, maps, fades, before, found):  # type: ignore[no-untyped-def]
    """Write the visibility of a light at points ``start:stop`` into ``found``; see :func:`sample_visibility`.

    ``maps`` is the result of :func:`interleave_shadow_maps`. Its last axis is the slabs, so that LLVM vectorises the
    loops over slabs.
    """
    size, slabs = maps.shape[0] - 2, maps.shape[3]
    passed = np.empty(slabs)
    for p in range(start, stop):
        x = view[0, 0] * points[p, 0] + view[0, 1] * points[p, 1] + view[0, 2] * points[p, 2] + view[0, 3]
        y = view[1, 0] * points[p, 0] + view[1, 1] * points[p, 1] + view[1, 2] * points[p, 2] + view[1, 3]
        z = view[2, 0] * points[p, 0] + view[2, 1] * points[p, 1] + view[2, 2] * points[p, 2] + view[2, 3]
        found[p] = 1.0
        if not z > near:  # behind the light's camera
            continue
        # in pixels, 0 the middle of the first
        u, v = focal * x / z + 0.5 * size - 0.5, focal * y / z + 0.5 * size - 0.5
        if not (-1.0 < u < size and -1.0 < v < size):
            continue
        i, j = int(np.floor(v)) + 1, int(np.floor(u)) + 1
        down, right = v + 1 - i, u + 1 - j
        a, b, c, d = maps[i, j], maps[i, j + 1], maps[i + 1, j], maps[i + 1, j + 1]
        wa, wb, wc, wd = (1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right
        fade = 1.0 / fades[p]
        for k in range(slabs):
            alpha = wa * a[0, k] + wb * b[0, k] + wc * c[0, k] + wd * d[0, k]
            nearness = wa * a[1, k] + wb * b[1, k] + wc * c[1, k] + wd * d[1, k]
            s = min(max((z - alpha / max(nearness, 1e-30)) * fade + before, 0.0), 1.0)
            passed[k] = 1.0 - alpha * s * s * (3.0 - 2.0 * s)
        arrives = 1.0
        for k in range(slabs):
            arrives *= passed[k]
        found[p] = arrives


# ---------------------------------------------------------------- layers


def unshadowed_layer(frame: LayerFrame) -> Tensor | None:
    """Return the (H, W, C) image without shadows; None if the model computes no shadows."""
    return None if frame.shading is None else frame.unshaded


def visibility_layer(frame: LayerFrame) -> Tensor | None:
    """Return the (H, W) mean visibility of the light; None if the model computes no shadows."""
    return None if frame.shading is None else frame.shading.clamp(0.0, 1.0)  # rounding may exceed 1


LIGHT_LAYERS = (
    LayerSpec(
        "unshadowed",
        "the image as if the light arrived everywhere, linear light, premultiplied by alpha",
        unshadowed_layer,
    ),
    LayerSpec(
        "visibility",
        "how much of the light arrives, 0 to 1: the mean over what the pixel shows, "
        "weighted by its part in the pixel; 0 where alpha is 0",
        visibility_layer,
        ("Y",),
    ),
)

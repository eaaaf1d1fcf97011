"""Shading of the generated scenes: Lambertian reflectance plus a normalised Blinn-Phong highlight,

f = albedo / pi + k (n + 8) / (8 pi) (N.H)^n,     k = specular gloss,  n = 6 + 110 gloss^2,

where N is the surface normal and H the half vector between the directions to the eye and to the light. The factors
``specular`` and ``gloss`` are members of :class:`~neuprim.scenes.shapes.Solid`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuprim.scenes.raycast import Hits, Scene

Array = NDArray[np.float32]
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Daylight:
    """Sun and sky that light a generated scene."""

    direction: tuple[float, float, float] = (0.42, -0.62, 0.92)  # (3,) towards the sun; any length
    sun: Colour = (2.3, 2.2, 2.0)  # linear RGB irradiance of a surface that faces the sun
    # sky, ground: linear RGB radiance from straight above and straight below, blended in between
    sky: Colour = (0.42, 0.46, 0.53)
    ground: Colour = (0.22, 0.2, 0.18)


DAYLIGHT = Daylight()


def shading_dot(a: Array, b: Array) -> Array:
    """Return (M,) dot products of the rows of ``a`` (M, 3) with the rows of ``b`` (M, 3) or with one vector (3,)."""
    return np.einsum("nc,nc->n", a, np.broadcast_to(b, a.shape))  # several times faster than a sum over three


def reflectance_lobes(hits: Hits, to_eye: ArrayLike, to_light: ArrayLike) -> tuple[Array, Array]:
    """Return two (M,) arrays for M surface hits: cosine of the angle between normal and light, and highlight.

    The cosine is clamped at 0 from below. The highlight is the second term of f (see the module) times pi.
    ``to_eye`` and ``to_light`` are unit vectors.
    """
    eye, light = np.asarray(to_eye, dtype=np.float32), np.asarray(to_light, dtype=np.float32)
    cosine = np.maximum(shading_dot(hits.normal, light), 0)
    half: Array = eye + light
    half /= np.sqrt(np.maximum(shading_dot(half, half), np.float32(1e-12)))[:, None]
    exponent = 6 + 110 * hits.gloss**2
    highlight = (
        hits.specular * hits.gloss * (exponent + 8) / 8 * np.maximum(shading_dot(hits.normal, half), 0) ** exponent
    )
    return cosine, highlight.astype(np.float32, copy=False)


def reflect_light(hits: Hits, to_eye: ArrayLike, to_light: ArrayLike) -> Array:
    """Return the (M, 3) linear RGB radiance that M surface hits reflect from one light.

    The light gives irradiance 1 to a surface that faces it.
    """
    cosine, highlight = reflectance_lobes(hits, to_eye, to_light)
    return ((hits.albedo + highlight[:, None]) * (cosine / np.float32(np.pi))[:, None]).astype(np.float32)


def scene_daylight_radiance(
    scene: Scene, origins: ArrayLike, directions: ArrayLike, light: Daylight = DAYLIGHT
) -> tuple[Array, NDArray[np.bool_]]:
    """Shade N rays in daylight: return (N, 3) linear RGB, zero without a hit, and an (N,) bool hit mask."""
    d = np.asarray(directions, dtype=np.float32)
    hits = scene.intersect(origins, d)
    to_eye = -d[hits.hit]
    to_sun = np.array(light.direction, dtype=np.float32)
    to_sun /= np.linalg.norm(to_sun)
    lit = scene_light_visibility(scene, hits, np.broadcast_to(to_sun, hits.position.shape), np.inf)
    rgb = reflect_light(hits, to_eye, to_sun) * (np.array(light.sun, dtype=np.float32) * lit[:, None])
    add_scene_surroundings(rgb, hits, to_eye, light.sky, light.ground)
    if hits.emission is not None:
        rgb += hits.emission
    image = np.zeros(d.shape, dtype=np.float32)
    image[hits.hit] = rgb
    return image, hits.hit


def scene_light_visibility(scene: Scene, hits: Hits, to_light: Array, away: ArrayLike) -> NDArray[np.bool_]:
    """Return (M,) bool: whether light from the directions ``to_light`` (M, 3) reaches M surface hits.

    ``away`` is the distance to the light, in lengths of ``to_light``; infinite for the sun.
    """
    lit: NDArray[np.bool_] = shading_dot(hits.face, to_light) > 0  # what faces away is in its own shadow: no ray needed
    lit[lit] = ~scene.occluded(hits.lifted()[lit], to_light[lit], np.broadcast_to(away, len(lit))[lit])
    return lit


def add_scene_surroundings(rgb: Array, hits: Hits, to_eye: Array, sky: Colour, ground: Colour) -> None:
    """Add reflected ambient light to ``rgb`` (M, 3), in place: radiance ``sky`` from above, ``ground`` from below."""

    def surroundings(height: Array) -> Array:
        t = (0.5 + 0.5 * height)[:, None]
        return t * np.array(sky, dtype=np.float32) + (1 - t) * np.array(ground, dtype=np.float32)

    rgb += hits.albedo * surroundings(hits.normal[:, 2])
    # Polished things mirror the surroundings faintly, more so at grazing angles (Schlick).
    facing = np.clip(shading_dot(hits.normal, to_eye), 0, 1)
    mirrored = 2 * facing * hits.normal[:, 2] - to_eye[:, 2]
    strength = hits.gloss * (0.06 + 0.5 * (1 - facing) ** 5)
    rgb += strength[:, None] * surroundings(mirrored)


def encode_scene_srgb(linear: Array) -> Array:
    """Convert linear values, clipped to 0..1, to sRGB display values (IEC 61966-2-1)."""
    x = np.clip(linear, 0, 1)
    curve = 1.055 * np.maximum(x, np.float32(0.0031308)) ** np.float32(1 / 2.4) - 0.055
    return np.where(x <= 0.0031308, 12.92 * x, curve).astype(np.float32)

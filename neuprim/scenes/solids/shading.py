"""Light on the solids: one hard-shadowed sun, a soft sky and a mild gloss that moves with the eye. Linear RGB
throughout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuprim.scenes.raycast import Hits, Scene
from neuprim.scenes.reflectance import dot, reflected

__all__ = ["DAYLIGHT", "Colour", "Daylight", "add_surroundings", "encode_srgb", "radiance", "unshadowed"]

Array = NDArray[np.float32]
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Daylight:
    """The fixed light of the static scene.

    Attributes:
        direction: (3,) towards the sun; any length.
        sun: (3,) linear RGB irradiance of a surface facing it.
        sky, ground: (3,) linear RGB radiance from straight above and straight below, blended in between.
    """

    direction: tuple[float, float, float] = (0.42, -0.62, 0.92)
    sun: Colour = (2.3, 2.2, 2.0)
    sky: Colour = (0.42, 0.46, 0.53)
    ground: Colour = (0.22, 0.2, 0.18)


DAYLIGHT = Daylight()


def radiance(
    scene: Scene, origins: ArrayLike, directions: ArrayLike, light: Daylight = DAYLIGHT
) -> tuple[Array, NDArray[np.bool_]]:
    """What N rays see: (N, 3) linear RGB, zero where nothing is hit, and (N,) bool of hits.

    Args:
        origins: (N, 3) or (3,).
        directions: (N, 3) unit vectors.
    """
    d = np.asarray(directions, dtype=np.float32)
    hits = scene.intersect(origins, d)
    to_eye = -d[hits.hit]
    to_sun = np.array(light.direction, dtype=np.float32)
    to_sun /= np.linalg.norm(to_sun)
    lit = unshadowed(scene, hits, np.broadcast_to(to_sun, hits.position.shape), np.inf)
    rgb = reflected(hits, to_eye, to_sun) * (np.array(light.sun, dtype=np.float32) * lit[:, None])
    add_surroundings(rgb, hits, to_eye, light.sky, light.ground)
    if hits.emission is not None:
        rgb += hits.emission
    image = np.zeros(d.shape, dtype=np.float32)
    image[hits.hit] = rgb
    return image, hits.hit


def unshadowed(scene: Scene, hits: Hits, to_light: Array, away: ArrayLike) -> NDArray[np.bool_]:
    """(M,) whether light from ``to_light`` (M, 3), ``away`` lengths of it far, reaches the surfaces."""
    lit: NDArray[np.bool_] = dot(hits.face, to_light) > 0  # what faces away is in its own shadow: no ray needed
    lit[lit] = ~scene.occluded(hits.lifted()[lit], to_light[lit], np.broadcast_to(away, len(lit))[lit])
    return lit


def encode_srgb(linear: Array) -> Array:
    """Display values 0..1 of linear ones, clipped (IEC 61966-2-1)."""
    x = np.clip(linear, 0, 1)
    return np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, np.float32(0.0031308)) ** np.float32(1 / 2.4) - 0.055
    ).astype(np.float32)


def add_surroundings(rgb: Array, hits: Hits, to_eye: Array, sky: Colour, ground: Colour) -> None:
    """Add to ``rgb`` (M, 3) what soft light from all around, ``sky`` above and ``ground`` below, makes the surfaces
    send to the eye.

    Args:
        to_eye: (M, 3) unit vectors away from the surface.
        sky, ground: (3,) linear RGB radiance from straight above and straight below, blended in between.
    """
    rgb += hits.albedo * _surroundings(sky, ground, hits.normal[:, 2])
    # Polished things mirror the surroundings faintly, more so at grazing angles (Schlick).
    facing = np.clip(dot(hits.normal, to_eye), 0, 1)
    mirrored = 2 * facing * hits.normal[:, 2] - to_eye[:, 2]
    strength = hits.gloss * (0.06 + 0.5 * (1 - facing) ** 5)
    rgb += strength[:, None] * _surroundings(sky, ground, mirrored)


def _surroundings(sky: Colour, ground: Colour, height: Array) -> Array:
    """(M, 3) radiance of sky and ground seen towards a direction of z component ``height`` (M,)."""
    t = (0.5 + 0.5 * height)[:, None]
    return t * np.array(sky, dtype=np.float32) + (1 - t) * np.array(ground, dtype=np.float32)

"""Light in the room: one lamp that hangs from the ceiling and casts hard shadows, and what walls and floor give back.
Linear RGB throughout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuprim.scenes.reflectance import dot, reflected
from neuprim.scenes.room.layout import BULB, LAMP
from neuprim.scenes.room.scene import Room
from neuprim.scenes.solids.shading import Colour, add_surroundings, unshadowed

__all__ = ["LAMPLIGHT", "Lamplight", "radiance"]


@dataclass(frozen=True)
class Lamplight:
    """The fixed light of the room.

    Attributes:
        position: (3,) the lamp, a point for shading.
        power: (3,) linear RGB irradiance of a surface that faces the lamp at distance 1; it falls with the distance
        squared. above, below: (3,) linear RGB radiance from straight above and straight below, blended in between.
    """

    position: Colour = LAMP
    power: Colour = (39.0, 35.8, 30.0)
    above: Colour = (0.31, 0.32, 0.34)
    below: Colour = (0.27, 0.25, 0.23)


LAMPLIGHT = Lamplight()


def radiance(
    room: Room, origins: ArrayLike, directions: ArrayLike, light: Lamplight = LAMPLIGHT
) -> NDArray[np.float32]:
    """What N rays see: (N, 3) linear RGB; zero where nothing is hit, which inside of the room does not happen.

    Args:
        origins: (N, 3) or (3,).
        directions: (N, 3) unit vectors.
    """
    d = np.asarray(directions, dtype=np.float32)
    hits = room.intersect(origins, d)
    to_eye = -d[hits.hit]
    to_lamp = np.array(light.position, dtype=np.float32) - hits.position
    away = np.sqrt(dot(to_lamp, to_lamp))
    to_lamp /= away[:, None]
    lit = unshadowed(
        room, hits, to_lamp, np.maximum(away - np.float32(1.2 * BULB), 0)
    )  # the bulb itself is no obstacle
    rgb = reflected(hits, to_eye, to_lamp) * (np.array(light.power, dtype=np.float32) * (lit / away**2)[:, None])
    add_surroundings(rgb, hits, to_eye, light.above, light.below)
    glow = room.glow[hits.solid][:, None]
    image = np.zeros(d.shape, dtype=np.float32)
    image[hits.hit] = np.where(glow > 0, glow * hits.albedo, rgb)
    return image

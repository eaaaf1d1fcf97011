"""The room with the solids in it, as rays meet it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuprim.scenes.raycast import Engine, Hits, Scene
from neuprim.scenes.reflectance import dot
from neuprim.scenes.room.layout import Furnishing
from neuprim.scenes.shapes import Solid, plain

__all__ = ["Room"]

_GRAZING = 0.04
"""Least cosine between a ray and a surface's normal for the width that the ray stands for."""


class Room(Scene):
    """Solids, and what is around them.

    Args:
        solids: the subject, coloured as in scenes of its own.
        around: coloured by textures that are averaged over what a ray stands for.
        spacing: of neighbouring rays at distance 1.

    Attributes:
        glow: (solids and furnishings,) float32 radiance sent out per unit of reflectance; above 0 nothing else is seen.
        subject: how many of the first bodies are solids.
    """

    def __init__(
        self, solids: Sequence[Solid], around: Sequence[Furnishing], spacing: float, engine: Engine = "auto"
    ) -> None:
        super().__init__([*solids, *(Solid(f.name, f.mesh, plain("#000000"), f.gloss) for f in around)], engine)
        self.subject = len(solids)
        self.glow = np.array([0.0] * len(solids) + [f.glow for f in around], dtype=np.float32)
        self._textures = [f.texture for f in around]
        self._spacing = np.float32(spacing)

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """As of any scene, for directions of unit length."""
        hits = super().intersect(origins, directions)
        towards = np.asarray(directions, dtype=np.float32)[hits.hit]
        # A pixel covers an ellipse of the surface; its area decides, so grazing views blur across rather than flicker
        # along.
        root: NDArray[np.float32] = np.sqrt(np.maximum(np.abs(dot(hits.face, towards)), np.float32(_GRAZING)))
        width = hits.distance * self._spacing / root
        albedo = hits.albedo.copy()
        for index in np.unique(hits.solid[hits.solid >= self.subject]):
            mine = np.flatnonzero(hits.solid == index)
            albedo[mine] = self._textures[index - self.subject](hits.position[mine], width[mine])
        return replace(hits, albedo=albedo)

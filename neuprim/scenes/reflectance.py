"""How the solids reflect a light: Lambert's reflectance plus Blinn and Phong's highlight in its energy-scaled form,

f = albedo / pi + k (n + 8) / (8 pi) (N.H)^n,     k = specular gloss,  n = 6 + 110 gloss^2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuprim.scenes.raycast import Hits

__all__ = ["dot", "lobes", "reflected"]

Array = NDArray[np.float32]


def lobes(hits: Hits, to_eye: ArrayLike, to_light: ArrayLike) -> tuple[Array, Array]:
    """The cosine to the light, zero where the surface faces away, and pi times the highlight's reflectance; (M,)
    float32 each.

    Args:
        to_eye, to_light: (M, 3) or (3,) unit vectors away from the surface.
    """
    eye, light = np.asarray(to_eye, dtype=np.float32), np.asarray(to_light, dtype=np.float32)
    cosine = np.maximum(dot(hits.normal, light), 0)
    half: Array = eye + light
    half /= np.sqrt(np.maximum(dot(half, half), np.float32(1e-12)))[:, None]
    exponent = 6 + 110 * hits.gloss**2
    highlight = hits.specular * hits.gloss * (exponent + 8) / 8 * np.maximum(dot(hits.normal, half), 0) ** exponent
    return cosine, highlight.astype(np.float32, copy=False)


def reflected(hits: Hits, to_eye: ArrayLike, to_light: ArrayLike) -> Array:
    """(M, 3) linear RGB radiance towards the eye per unit irradiance of a surface facing the light: reflectance times
    cosine.

    Args:
        to_eye, to_light: (M, 3) or (3,) unit vectors away from the surface.
    """
    cosine, highlight = lobes(hits, to_eye, to_light)
    return ((hits.albedo + highlight[:, None]) * (cosine / np.float32(np.pi))[:, None]).astype(np.float32)


def dot(a: Array, b: Array) -> Array:
    """(M,) products of (M, 3) rows with (M, 3) rows or one (3,) vector."""
    return np.einsum(
        "nc,nc->n", a, np.broadcast_to(b, a.shape)
    )  # several times faster than a sum over an axis of three

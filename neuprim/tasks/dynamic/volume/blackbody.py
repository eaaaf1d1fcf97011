"""The colour of a glowing body: Planck's law seen through the CIE 1931 observer in linear sRGB."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

__all__ = ["black_body_rgb", "black_body_xyz"]

_WAVELENGTHS = np.arange(360.0, 831.0, 1.0)
_SECOND_RADIATION_CONSTANT = 1.438776877e7
"""h c / k in nm K."""

_SRGB_FROM_XYZ = np.array(
    [[3.2406255, -1.5372080, -0.4986286], [-0.9689307, 1.8757561, 0.0415175], [0.0557101, -0.2040211, 1.0569959]]
)
"""IEC 61966-2-1 with the white of D65 at (1, 1, 1)."""


def _lobe(mean: float, below: float, above: float) -> np.ndarray:
    off = _WAVELENGTHS - mean
    return np.exp(-0.5 * (off * np.where(off < 0, below, above)) ** 2)


@lru_cache(maxsize=1)
def _observer() -> np.ndarray:
    """(3, L) colour matching functions of the CIE 1931 2° observer: the multi-lobe fit of Wyman, Sloan and Shirley
    (JCGT 2013)."""
    x = (
        0.362 * _lobe(442.0, 0.0624, 0.0374)
        + 1.056 * _lobe(599.8, 0.0264, 0.0323)
        - 0.065 * _lobe(501.1, 0.0490, 0.0382)
    )
    y = 0.821 * _lobe(568.8, 0.0213, 0.0247) + 0.286 * _lobe(530.9, 0.0613, 0.0322)
    z = 1.217 * _lobe(437.0, 0.0845, 0.0278) + 0.681 * _lobe(459.0, 0.0385, 0.0725)
    return np.stack([x, y, z])


def black_body_xyz(kelvin: np.ndarray) -> np.ndarray:
    """(…, 3) CIE XYZ of black bodies, all in one unit of radiance: XYZ = ∫ B(λ, T) (x̄, ȳ, z̄) dλ with B ∝ λ⁻⁵ /
    (exp(hc/λkT) - 1)."""
    exponent = _SECOND_RADIATION_CONSTANT / (_WAVELENGTHS * np.asarray(kelvin, np.float64)[..., None])
    spectrum = (_WAVELENGTHS / 560.0) ** -5.0 / np.expm1(np.minimum(exponent, 700.0))
    return spectrum @ _observer().T


def black_body_rgb(kelvin: np.ndarray, hottest: float) -> np.ndarray:
    """(…, 3) linear sRGB radiance, relative to a body of ``hottest`` kelvin whose largest channel is 1; out of gamut is
    clipped at 0."""
    top = np.maximum(black_body_xyz(np.array(hottest)) @ _SRGB_FROM_XYZ.T, 0.0).max()
    return np.maximum(black_body_xyz(kelvin) @ _SRGB_FROM_XYZ.T, 0.0) / top

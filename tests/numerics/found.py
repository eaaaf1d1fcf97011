"""Cases that once broke a bound, by the reason they did."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Draw:
    """One primitive and camera by their proportions; see ``tests/numerics/extremes/draw.py`` for the meaning."""

    seed: int
    distance: float
    ratio: float
    kind: str
    neurons: int
    rate: float
    pixels: float
    off: float
    depth: float
    offset: float


FOUND: dict[str, Draw] = {
    "the camera inside a needle, nearly two thin radii off its centre": Draw(
        seed=0,
        distance=0.01,
        ratio=10.0**2.25,
        kind="needle",
        neurons=0,
        rate=0.0,
        pixels=1.0,
        off=1.0,
        depth=1.0,
        offset=1.0,
    )
}
"""What hypothesis found."""

SWEPT: dict[str, tuple[str, int]] = {
    "the quaternion's norm rounded to float32": ("axis ratio 10000, needle", 5),
    "a slanted needle, whose two offset terms cancel": ("axis ratio 100, needle", 5),
    "a slanted needle from afar": ("needles and discs, far", 15),
    "a disc around the camera": ("needles and discs, inside or near", 20),
    "the camera a few radii from a wide view's rim": ("field of view 160", 21),
    "a rim pixel with D = 4e-6": ("grazing", 1),
}
"""What the sweep found: region and number of the case."""

"""What a file of cameras holds."""

from __future__ import annotations

from dataclasses import dataclass

from neuprim.core.cameras.pinhole import Camera

__all__ = ["LARGEST", "MOST", "RATES", "CameraViews"]

MOST = 100_000
"""Cameras of one file."""

LARGEST = 32768
"""Pixels of an image's side."""

RATES = (0.1, 240.0)
"""Least and most frames per second of a film, as ``--fps`` takes them."""


@dataclass(frozen=True)
class CameraViews:
    """Cameras in their order, one or more.

    Attributes:
        named: name and camera of each.
        times: what the file says as the time of each, in its own unit; None where it does not.
        fps: frames per second of the film that they are; None where the file does not say.
        notes: one line each, for the user: conventions that were met, and what of the file cannot be drawn.
    """

    named: tuple[tuple[str, Camera], ...]
    times: tuple[float, ...] | None = None
    fps: float | None = None
    notes: tuple[str, ...] = ()

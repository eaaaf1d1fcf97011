"""A pinhole camera as attributes of an OpenEXR file.

The standard ones (OpenEXR, "Standard Attributes") multiply row vectors from the right, as Imath does: the camera's
space is left-handed, x right, y up, z forward, and normalised device coordinates run from (0, 0), the upper left corner
of the image, to (1, 1).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from neuprim.core.cameras.pinhole import Camera

__all__ = ["exr_attributes"]


def exr_attributes(camera: Camera, near: float) -> dict[str, Any]:
    """Attribute name -> value: ``worldToCamera``, ``worldToNDC``, ``screenWindowCenter`` and ``screenWindowWidth`` as
    the standard has them, and in float64, for cameras far from the origin, ``neuprim:worldToCamera``, and
    in plain numbers ``neuprim:focalLength`` and ``neuprim:principalPoint`` (x, y, pixels), ``neuprim:near`` (camera z,
    units of the camera's position).
    """
    view = camera.viewmat.detach().double().cpu().numpy()
    up = np.diag([1.0, -1.0, 1.0, 1.0])
    width, height = float(camera.width), float(camera.height)
    project = np.array(
        [
            [camera.fx / width, 0.0, camera.cx / width, 0.0],
            [0.0, camera.fy / height, camera.cy / height, 0.0],
            [0.0, 0.0, 1.0, -near],  # after the division: 0 at the near plane, 1 far away
            [0.0, 0.0, 1.0, 0.0],
        ]
    )
    return {
        "worldToCamera": np.ascontiguousarray((up @ view).T, dtype=np.float32),
        "neuprim:worldToCamera": np.ascontiguousarray((up @ view).T),
        "worldToNDC": np.ascontiguousarray((project @ view).T, dtype=np.float32),
        "screenWindowCenter": np.array(
            [(width / 2 - camera.cx) / camera.fx, (camera.cy - height / 2) / camera.fy], np.float32
        ),
        "screenWindowWidth": width / camera.fx,
        "neuprim:focalLength": np.array([camera.fx, camera.fy], np.float32),
        "neuprim:principalPoint": np.array([camera.cx, camera.cy], np.float32),
        "neuprim:near": float(near),
    }

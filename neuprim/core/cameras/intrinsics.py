"""Intrinsics and lenses as ``transforms.json`` files say them (instant-ngp, nerfstudio, NeRF-synthetic).

``fl_x fl_y cx cy`` in pixels, or ``camera_angle_x camera_angle_y`` in radians; ``camera_model``, ``k1 k2 k3 k4 p1 p2``.
"""

from __future__ import annotations

import math

from torch import Tensor

from neuprim.core.cameras.pinhole import Camera, opengl_to_viewmat
from neuprim.core.io.records import Record

__all__ = ["COEFFICIENTS", "MODELS", "camera_of", "is_fisheye"]

MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
"""Camera models that are pinholes but for radial and tangential distortion."""

COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


def camera_of(record: Record, width: int, height: int, pose: Tensor | None = None) -> Camera:
    """The pinhole of a record: a frame's fields over its file's.

    Args:
        width, height: of the image, pixels.
        pose: (4, 4) camera to world, OpenGL axes; None for the field ``transform_matrix``.

    Raises:
        DataError: a field that is missing or wrong.
    """
    if record.has("fl_x"):
        fx = record.number("fl_x", "a focal length in pixels above 0", 0.0)
        fy = record.number_or("fl_y", fx, "a focal length in pixels above 0", 0.0)
    elif record.has("camera_angle_x"):
        fx = _focal(record, "camera_angle_x", width)
        fy = _focal(record, "camera_angle_y", height) if record.has("camera_angle_y") else fx
    else:
        raise record.fail("fl_x", "a focal length in pixels (or camera_angle_x), in the frame or in the file")
    cx, cy = record.number_or("cx", 0.5 * width), record.number_or("cy", 0.5 * height)
    return Camera(opengl_to_viewmat(record.matrix("transform_matrix") if pose is None else pose), fx, fy, cx, cy, width, height)


def is_fisheye(record: Record, others: tuple[str, ...] = ("OPENCV_FISHEYE",)) -> bool:
    """Whether the lens is OpenCV's fisheye.

    Args:
        others: models beside :data:`MODELS` that messages offer.

    Raises:
        DataError: a camera model that is neither it nor one of :data:`MODELS`.
    """
    model = record.text("camera_model") if record.has("camera_model") else "OPENCV"
    if model == "OPENCV_FISHEYE" or record.values.get("is_fisheye") is True:
        return True
    if model not in MODELS:
        raise record.fail("camera_model", "one of " + ", ".join((*MODELS, *others)))
    return False


def _focal(record: Record, key: str, size: int) -> float:
    return 0.5 * size / math.tan(0.5 * record.number(key, "a field of view in radians, between 0 and pi", 0.0, math.pi))

"""Cameras from a JSON file, in the layout that NeRF-synthetic and nerfstudio share."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch

from neuprim.core.cameras import Camera, opengl_to_viewmat
from neuprim.core.errors import DataError

__all__ = ["read_cameras"]

_MAX_BYTES = 64 * 1024 * 1024


def read_cameras(path: Path, size: tuple[int, int] | None = None) -> list[tuple[str, Camera]]:
    """Named cameras of ``{"w", "h", "camera_angle_x" | "fl_x"[, "fl_y", "cx", "cy"], "frames": [{"transform_matrix", ...}]}``.

    Matrices are camera-to-world with OpenGL axes. A frame may override every intrinsic; ``size`` (width, height) serves
    where the file names none.

    Raises:
        DataError: names the file and the field that is missing or wrong.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise DataError(f"{path}: {path.stat().st_size} bytes; a camera file has at most {_MAX_BYTES}")
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: not readable as JSON ({error})") from error
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{path}: field 'frames' is {type(frames).__name__}; expected a non-empty list")
    result = []
    for i, frame in enumerate(frames):
        where = f"{path}: frames[{i}]"
        if not isinstance(frame, dict):
            raise DataError(f"{where}: found {type(frame).__name__}; expected an object")
        merged = {**data, **frame}
        width = int(_number(merged, "w", where, size[0] if size else None))
        height = int(_number(merged, "h", where, size[1] if size else None))
        if not (0 < width <= 32768 and 0 < height <= 32768):
            raise DataError(f"{where}: size {width}x{height}; expected 1 to 32768 pixels a side")
        if "fl_x" in merged:
            fx = _number(merged, "fl_x", where)
        else:
            angle = _number(merged, "camera_angle_x", where)
            if not 0 < angle < math.pi:
                raise DataError(f"{where}: camera_angle_x is {angle}; expected radians between 0 and pi")
            fx = 0.5 * width / math.tan(angle / 2)
        fy = _number(merged, "fl_y", where, fx)
        cx, cy = _number(merged, "cx", where, width / 2), _number(merged, "cy", where, height / 2)
        try:
            matrix = torch.tensor(merged["transform_matrix"], dtype=torch.float64)
        except KeyError:
            raise DataError(f"{where}: field 'transform_matrix' is missing") from None
        except (ValueError, TypeError, OverflowError) as error:
            raise DataError(f"{where}: transform_matrix is not a 4x4 matrix of numbers ({error})") from error
        if matrix.shape != (4, 4):
            raise DataError(f"{where}: transform_matrix has shape {tuple(matrix.shape)}; expected (4, 4)")
        camera = Camera(opengl_to_viewmat(matrix), fx, fy, cx, cy, width, height).validate(where)
        result.append((f"camera_{i:03d}", camera))
    return result


def _number(data: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    value = data.get(key, default)
    if value is None:
        raise DataError(f"{where}: field {key!r} is missing")
    try:
        fine = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer beyond floats
        fine = False
    if not fine:
        raise DataError(f"{where}: {key} is {value!r}; expected a finite number")
    return float(value)

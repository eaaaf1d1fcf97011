"""OpenEXR files out: one image, or several layers of one, always linear light, whole or not at all, compressed without
loss (ZIP).

Channels follow the format's own convention: those without a prefix are the image that every reader shows (R, G, B and
premultiplied A), and a layer is a prefix and a dot, ``depth.Z`` (OpenEXR, "Technical Introduction": channel names and
layers), as Nuke and Blender read them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from torch import Tensor

from neuprim.core.errors import DataError
from neuprim.core.io.channel_names import names_fault
from neuprim.core.io.files import writing

__all__ = ["Plane", "check_finite", "write_exr", "write_layers"]

_LARGEST = 65504.0  # of a 16-bit float


@dataclass(frozen=True)
class Plane:
    """One channel of a file.

    Attributes:
        values: (H, W) finite numbers.
        half: stored as 16-bit instead of 32-bit floats.
    """

    values: Tensor
    half: bool = False


def check_finite(path: Path, pixels: np.ndarray) -> None:
    """Raise :class:`DataError` that names the first NaN or infinite value of (H, W, C) pixels."""
    bad = ~np.isfinite(pixels)
    if bad.any():
        row, column, channel = (int(i[0]) for i in np.nonzero(bad))
        raise DataError(
            f"{path}: value {pixels[row, column, channel]} at row {row}, column {column}, channel {channel}; expected finite numbers"
        )


def write_exr(
    path: Path,
    image: Tensor,
    half: bool = True,
    extra: Mapping[str, Tensor] | None = None,
    names: Sequence[str] | None = None,
) -> None:
    """Write (H, W, 3 or 4) *linear* values, alpha premultiplied, or channels of other names as OpenEXR without
    clamping; atomic.

    Args:
        half: store colour as 16-bit instead of 32-bit floats.
        extra: further channels by name, each (H, W), stored as 32-bit floats, e.g. ``{"Z": depth}``.
        names: of the channels C of an (H, W, C) image that is not R, G, B(, A).

    Raises:
        DataError: wrong shapes or names, colour values that are not finite or (with ``half``) beyond 65504, or the file
        cannot be written.
    """
    wrong = None if names is None else names_fault(names)
    if wrong:
        raise DataError(f"{path}: names{wrong}")
    if (
        image.ndim != 3
        or 0 in image.shape
        or (image.shape[-1] not in (3, 4) if names is None else image.shape[-1] != len(names))
    ):
        expected = (
            "(H, W, 3) or (H, W, 4)" if names is None else f"(H, W, {len(names)}), for the channels {', '.join(names)}"
        )
        raise DataError(f"{path}: image to write has shape {tuple(image.shape)}; expected {expected}")
    check_finite(path, image.detach().cpu().float().numpy())
    channels = {c: _stored(path, c, image[..., i], half) for i, c in enumerate(names or "RGBA"[: image.shape[-1]])}
    for name, plane in (extra or {}).items():
        if tuple(plane.shape) != tuple(image.shape[:2]) or name in channels:
            raise DataError(
                f"{path}: channel {name!r} has shape {tuple(plane.shape)}; expected {tuple(image.shape[:2])} and a name of its own"
            )
        channels[name] = _stored(path, name, plane, False)
    _write(path, channels, {})


def write_layers(path: Path, planes: Mapping[str, Plane], attributes: Mapping[str, Any] | None = None) -> None:
    """Write an image of several layers as one OpenEXR file; atomic.

    Args:
        planes: channel name, with its layer's prefix, -> (H, W) values, all of one size.
        attributes: of the file's header: texts, numbers, float32 arrays of 2, 3 or 4 x 4 numbers, lists of floats.

    Raises:
        DataError: no channels, different sizes, values that are not finite or (where half) beyond 65504, or the file
        cannot be written.
    """
    shapes = sorted({tuple(plane.values.shape) for plane in planes.values()})
    if len(shapes) != 1 or len(shapes[0]) != 2 or 0 in shapes[0]:
        raise DataError(f"{path}: channels to write have shapes {shapes}; expected one (H, W)")
    for name, plane in planes.items():
        bad = (~plane.values.isfinite()).nonzero()
        if len(bad):
            y, x = bad[0].tolist()
            raise DataError(
                f"{path}: channel {name}: value {float(plane.values[y, x])} at row {y}, column {x}; expected finite numbers"
            )
    _write(
        path, {name: _stored(path, name, plane.values, plane.half) for name, plane in planes.items()}, attributes or {}
    )


def _stored(path: Path, name: str, plane: Tensor, half: bool) -> np.ndarray:
    values = plane.detach().cpu().float().numpy()
    if half and np.abs(values).max() > _LARGEST:
        largest = f"{np.abs(values).max():.6g}"
        raise DataError(
            f"{path}: channel {name}: value {largest} does not fit 16-bit floats ({_LARGEST:.0f}); write 32-bit floats (half=False)"
        )
    return np.ascontiguousarray(values, dtype=np.float16 if half else np.float32)


def _write(path: Path, channels: dict[str, np.ndarray], attributes: Mapping[str, Any]) -> None:
    header = {**attributes, "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with writing(path) as temporary:
        try:
            with OpenEXR.File(header, channels) as file:
                file.write(str(temporary))
        except RuntimeError as error:
            raise DataError(f"{path}: cannot be written ({error})") from None

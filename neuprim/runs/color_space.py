"""Colour spaces of OpenEXR files, from OpenColorIO: :func:`load_output_color_space`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import BackendUnavailable, ConfigError, nearest
from neuprim.core.io.exr import REC709

_ACES = {
    "ACEScg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
    "ACES2065-1": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
}
_REC709_NAME = "lin_rec709_srgb"  # in OpenColorIO's built-in configurations
_TOLERANCE = 1e-5


@dataclass(frozen=True)
class OutputColorSpace:
    """A linear RGB colour space: name, 3x3 float64 matrix from linear Rec. 709, and chromaticities if they are known.

    The matrix includes the chromatic adaptation between the white points.
    """

    name: str
    matrix: Tensor
    chromaticities: tuple[float, ...] | None

    def convert(self, image: Tensor) -> Tensor:
        """Convert (..., 3) colours from linear Rec. 709."""
        return (image.double() @ self.matrix.T).to(image.dtype)


def load_output_color_space(name: str) -> OutputColorSpace:
    """Return a colour space by its name in the OpenColorIO configuration.

    The configuration is the file that the environment variable ``OCIO`` names, otherwise OpenColorIO's default.

    Raises:
        BackendUnavailable: OpenColorIO is not installed.
        ConfigError: the configuration cannot be read, or has no such colour space, or the space is not linear. Colours
            in OpenEXR files are multiplied by alpha, which only linear spaces allow.
    """
    try:
        import PyOpenColorIO as ocio
    except ImportError as error:
        raise BackendUnavailable(
            f"--colorspace {name} needs OpenColorIO ({error}): pip install 'neuprim[ocio]'"
        ) from error
    where = os.environ.get("OCIO") or "ocio://default"
    try:
        config = ocio.Config.CreateFromFile(where)
    except (ocio.Exception, ocio.ExceptionMissingFile) as error:
        raise ConfigError(f"--colorspace {name}: {where}: {_first_line(error)}") from None
    space = config.getColorSpace(name)
    if space is None:
        found = nearest(name, list(config.getColorSpaceNames()))
        raise ConfigError(f"--colorspace {name}: no such colour space in {where}{found}")
    matrix = None if space.isData() else _linear_matrix(ocio, config, name, where)
    if matrix is None:
        raise ConfigError(f"--colorspace {name}: not a linear space; expected one such as ACEScg")
    default = ocio.Config.CreateFromFile("ocio://default")
    for known, chromaticities in (("Linear Rec.709 (sRGB)", REC709), *_ACES.items()):
        same = _linear_matrix(ocio, default, known, where)
        if same is not None and np.allclose(matrix, same, atol=_TOLERANCE):
            return OutputColorSpace(name, torch.from_numpy(matrix), chromaticities)
    return OutputColorSpace(name, torch.from_numpy(matrix), None)


def _linear_matrix(ocio: Any, config: Any, name: str, where: str) -> np.ndarray | None:
    """Return the 3x3 matrix from linear Rec. 709 to a colour space; None if the conversion is not linear."""
    try:
        processor = ocio.Config.GetProcessorFromBuiltinColorSpace(_REC709_NAME, config, name)
    except (ocio.Exception, ocio.ExceptionMissingFile) as error:
        raise ConfigError(f"--colorspace {name}: {where}: {_first_line(error)}") from None
    convert = processor.getDefaultCPUProcessor()
    colors = np.concatenate([np.eye(3), np.random.default_rng(0).uniform(0, 8, (16, 3))]).astype(np.float32)
    found = colors.copy()
    convert.applyRGB(found)
    matrix = found[:3].T.astype(np.float64)
    return matrix if np.allclose(colors @ matrix.T, found, rtol=1e-4, atol=_TOLERANCE) else None


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]

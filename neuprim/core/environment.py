"""Environment maps: latitude-longitude images of the light from all directions, and lights that approximate them.

The top row of the image is the upward direction ("up"), the bottom row the downward direction. The middle column looks
along the first horizontal axis. From the middle column to the right, directions turn clockwise about up, as seen from
above. With up = +z, the middle column is +x, a quarter of the image to the right is -y, both edges are -x, and a
quarter to the left is +y, as in Blender's environment textures. For another up, the first horizontal axis is the
scene's x (y if x is up), made perpendicular to up. The second horizontal axis, a quarter to the left, is the cross
product of up and the first axis. A rotation turns the light anticlockwise about up as seen from above: after 90
degrees, light that came from +x comes from +y.

To choose the directions of the lights, the image is cut into rectangles, and each rectangle becomes one light. Each cut
is the one that most lowers a sum over all rectangles: the variance of direction, weighted by energy (Viriyothai and
Debevec 2009, "Variance minimization light probe sampling"; not the median cut). Each light carries the whole energy of
its rectangle. So the total energy per colour is the energy of the image, whatever the number of lights.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.images import image_info, read_image, srgb_to_linear

__all__ = ["DirectionalLights", "Environment", "EnvironmentFile", "Illumination", "read_environment"]

MAX_LIGHTS = 4096
_ROWS = 512  # most rows of cells; larger images are summed into cells, which loses no energy
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709, linear
Array = NDArray[np.float64]


@dataclass(frozen=True)
class EnvironmentFile:
    """An environment map and how to use it, as ``neuprim render --environment`` takes it."""

    path: Path  # image that read_environment reads
    samples: int = 64  # number of lights that approximate the environment map
    rotation: float = 0.0  # degrees about the scene's upward direction
    scale: float = 1.0  # multiplies the radiance
    guesses: bool = True  # whether to use light from directions without training data


@dataclass(frozen=True)
class DirectionalLights:
    """M distant lights, each with parallel rays from one direction."""

    directions: Tensor  # (M, 3) float64 unit vectors from the scene towards the light, scene axes
    irradiance: Tensor  # (M, 3) float64 linear RGB on a surface that faces the light: radiance times solid angle


@dataclass(frozen=True)
class Illumination:
    """Conditions of frames whose images add up to the image under an environment map.

    ``TaskSpec.environment`` returns an ``Illumination``.
    """

    conditions: tuple[dict[str, Tensor], ...]  # per frame: values that replace the view's conditions of the same names
    notes: tuple[str, ...] = ()  # one line each, for the user
    # per frame: True if no training light is near the frame's light; empty if this holds for no frame
    guessed: tuple[bool, ...] = ()

    def frames(self, guesses: bool) -> tuple[dict[str, Tensor], ...]:
        """Return the conditions of each frame.

        Without ``guesses``, leave out frames whose light has no training light nearby; the result may be empty.
        """
        if guesses or not any(self.guessed):
            return self.conditions
        return tuple(c for c, guess in zip(self.conditions, self.guessed, strict=True) if not guess)


class Environment:
    """Radiance from every direction, as a latitude-longitude image.

    Args:
        radiance: (H, 2H, 3) linear RGB, finite and not negative.
        up: (3,) direction of the top row, scene axes; None is +z.
        rotation: degrees about ``up``, anticlockwise as seen from above.
        where: name of the image in messages.

    Raises:
        DataError: the shape is wrong, or a value is negative or not finite.
    """

    def __init__(
        self, radiance: Tensor, up: Tensor | None = None, rotation: float = 0.0, where: str = "environment"
    ) -> None:
        if radiance.dim() != 3 or radiance.shape[1:] != (2 * len(radiance), 3) or not len(radiance):
            shape = tuple(radiance.shape)
            raise DataError(f"{where}: image has shape {shape}; expected (H, 2 H, 3), RGB in latitude and longitude")
        axes = _environment_axes(torch.tensor([0.0, 0.0, 1.0]) if up is None else up)
        self._flux, self._moment = _sum_texel_blocks(radiance, axes, math.radians(rotation), where)

    @property
    def irradiance(self) -> Tensor:
        """Integral of the radiance over all directions, (3,) float64, without a cosine factor.

        For the radiance 1 in all directions, the integral is 4 pi.
        """
        return torch.from_numpy(self._flux.sum((0, 1)))

    def directional_lights(self, count: int) -> DirectionalLights:
        """Return at most ``count`` lights that together carry all energy of the image; ``count`` is 1 to 4096.

        If fewer cells (blocks of texels) of the image are bright, there are fewer lights. A black image gives no light.
        The choice is deterministic.
        """
        if not 1 <= count <= MAX_LIGHTS:
            raise ConfigError(f"{count} lights for an environment; expected 1 to {MAX_LIGHTS}")
        directions, irradiance = [], []
        for r0, r1, c0, c1 in _cut_environment_into_rectangles(self._moment, self._flux @ _LUMINANCE, count):
            flux, moment = self._flux[r0:r1, c0:c1].sum((0, 1)), self._moment[r0:r1, c0:c1].sum((0, 1))
            length = np.linalg.norm(moment)
            if length <= 1e-9 * float(flux @ _LUMINANCE):  # equal light from all sides has no mean direction; take any
                moment, length = self._moment[r0, c0], np.linalg.norm(self._moment[r0, c0])
            directions.append(moment / length)
            irradiance.append(flux)
        shape = (len(directions), 3)
        arrays = (np.array(x, dtype=np.float64).reshape(shape) for x in (directions, irradiance))
        return DirectionalLights(*map(torch.from_numpy, arrays))

    def share_beyond(self, directions: Tensor, degrees: float) -> float:
        """Return the fraction 0..1 of the luminance that comes from far outside the given ``directions``.

        Luminance counts if its direction is more than ``degrees`` away from each of the unit vectors ``directions`` (D,
        3).
        """
        weight = self._flux @ _LUMINANCE
        total = float(weight.sum())
        if total == 0.0:
            return 0.0
        known = directions.detach().double().numpy().T
        beyond = 0.0
        for row, moment in zip(weight, self._moment, strict=True):
            lit = row > 0
            if lit.any():
                nearest = (moment[lit] @ known).max(axis=1) / np.linalg.norm(moment[lit], axis=1)
                beyond += float(row[lit][nearest < math.cos(math.radians(degrees))].sum())
        return beyond / total


def read_environment(path: Path, up: Tensor | None = None, rotation: float = 0.0, scale: float = 1.0) -> Environment:
    """Read an environment map from an OpenEXR file (linear), or from a PNG or JPEG file (sRGB, converted to linear).

    Alpha is ignored.

    Args:
        up: see :class:`Environment`.
        rotation: see :class:`Environment`.
        scale: factor on the radiance.

    Raises:
        DataError: :func:`neuprim.core.io.images.read_image` refuses the file, the image is not 2:1, or a value is
            negative.
    """
    info = image_info(path)
    if info.width != 2 * info.height:
        expected = "an environment in latitude and longitude, twice as wide as high"
        raise DataError(f"{path}: image is {info.width}x{info.height}; expected {expected}")
    pixels = read_image(path)[..., :3]
    radiance = pixels if info.linear else srgb_to_linear(pixels.float() / 255.0)
    return Environment(radiance if scale == 1.0 else radiance.float() * scale, up, rotation, str(path))


def _environment_axes(up: Tensor) -> Array:
    """Return the axes of an environment map as rows of a (3, 3) matrix: first and second horizontal axis, and up."""
    top = up.detach().double().numpy()
    length = np.linalg.norm(top)
    if not (np.isfinite(length) and length > 0):
        raise DataError(f"up is {top.tolist()}; expected a direction of non-zero length")
    top = top / length
    first = np.eye(3)[0 if abs(top[0]) < 0.9 else 1]
    first = first - (first @ top) * top
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(top, first), top])


def _sum_texel_blocks(radiance: Tensor, axes: Array, turn: float, where: str) -> tuple[Array, Array]:
    """Sum an environment map over blocks of texels; return flux and direction sums, (R, C, 3) for R x C blocks.

    The flux is radiance x solid angle, per colour channel. The direction sum is the sum of (luminance of the flux) x
    direction. ``turn`` is the rotation in radians, ``where`` the image's name in messages.
    """
    height, width = radiance.shape[:2]
    block = -(-height // _ROWS)
    starts = np.arange(0, width, block)
    azimuth = 2 * math.pi * (0.5 - (np.arange(width) + 0.5) / width) + turn
    around = np.stack([np.cos(azimuth), np.sin(azimuth)], -1) @ axes[:2]
    flux: list[Array] = []
    moment: list[Array] = []
    for top in range(0, height, block):
        rows = np.arange(top, min(top + block, height))
        band = radiance[top : top + block].double().numpy()
        wrong = ~(np.isfinite(band) & (band >= 0))
        if wrong.any():
            y, x, channel = (int(i[0]) for i in np.nonzero(wrong))
            place = f"row {top + y}, column {x}, channel {channel}"
            raise DataError(f"{where}: radiance {band[y, x, channel]} at {place}; expected 0 or more")
        polar = (rows + 0.5) * (math.pi / height)
        # cos of the upper edge - cos of the lower
        solid = (2 * math.pi / width) * 2 * np.sin(polar) * math.sin(0.5 * math.pi / height)
        energy = band * solid[:, None, None]
        luminance = (energy @ _LUMINANCE)[..., None]
        way = np.sin(polar)[:, None, None] * around + np.cos(polar)[:, None, None] * axes[2]
        for sums, values in ((flux, energy), (moment, luminance * way)):
            sums.append(np.add.reduceat(values.sum(axis=0), starts, axis=0))
    return np.stack(flux), np.stack(moment)


def _cut_environment_into_rectangles(moment: Array, weight: Array, count: int) -> list[tuple[int, int, int, int]]:
    """Return at most ``count`` rectangles (first row, end, first column, end) that contain all cells with energy.

    ``moment`` (R, C, 3) is the sum of luminance x direction in each cell, ``weight`` (R, C) the sum of luminance.
    """
    rows, columns = weight.shape
    table = np.zeros((rows + 1, columns + 1, 4))
    table[1:, 1:] = np.concatenate([moment, weight[..., None]], -1).cumsum(0).cumsum(1)
    total = table[-1, -1, 3]
    if total == 0.0:
        return []
    whole: tuple[int, int, int, int] = (0, rows, 0, columns)
    queue = [(-float(_direction_spread(table[-1, -1])), whole)]
    done: list[tuple[int, int, int, int]] = []
    while queue and len(queue) + len(done) < count:
        _, box = heapq.heappop(queue)
        parts = _cut_environment_rectangle(table, box, 1e-12 * total)
        if not parts:
            done.append(box)
        for part in parts:
            heapq.heappush(queue, (-float(_direction_spread(_sum_rectangle(table, part))), part))
    return sorted(done + [box for _, box in queue])


def _sum_rectangle(table: Array, box: tuple[int, int, int, int]) -> Array:
    r0, r1, c0, c1 = box
    return np.asarray(table[r1, c1] - table[r0, c1] - table[r1, c0] + table[r0, c0])


def _direction_spread(sums: Array) -> Array:
    """Return energy x variance of direction, W - |M|^2/W, from ``sums`` (..., 4).

    The first three numbers of ``sums`` are M, the sum of luminance x direction. The last number is W, the sum of
    luminance.
    """
    weight = sums[..., 3]
    return np.asarray(np.maximum(weight - (sums[..., :3] ** 2).sum(-1) / np.maximum(weight, 1e-300), 0.0))


def _cut_environment_rectangle(
    table: Array, box: tuple[int, int, int, int], least: float
) -> list[tuple[int, int, int, int]]:
    """Return the two parts after the best cut of rectangle ``box``; empty if no cut lowers the spread by ``least``.

    The spread is the value of :func:`_direction_spread`. ``table`` (R + 1, C + 1, 4) holds cumulative sums of the
    values that this function reads.
    """
    r0, r1, c0, c1 = box
    whole = _sum_rectangle(table, box)
    best, parts = float(_direction_spread(whole)) - least, []
    rows = table[r0 + 1 : r1, c1] - table[r0, c1] - table[r0 + 1 : r1, c0] + table[r0, c0]
    columns = table[r1, c0 + 1 : c1] - table[r1, c0] - table[r0, c0 + 1 : c1] + table[r0, c0]
    for along_rows, first in ((True, rows), (False, columns)):
        if not len(first):
            continue
        second = whole - first
        cost = _direction_spread(first) + _direction_spread(second)
        cost[np.minimum(first[:, 3], second[:, 3]) <= 0.1 * least] = np.inf  # a part without energy is no light
        at = int(cost.argmin())
        if cost[at] < best:
            best = float(cost[at])
            middle = at + 1
            if along_rows:
                parts = [(r0, r0 + middle, c0, c1), (r0 + middle, r1, c0, c1)]
            else:
                parts = [(r0, r1, c0, c0 + middle), (r0, r1, c0 + middle, c1)]
    return parts

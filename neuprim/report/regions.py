"""The worst region of every held-out view: a mean over an image hides the corner that went wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from neuprim.core.errors import DataError
from neuprim.core.io import images
from neuprim.core.io.files import write_json
from neuprim.core.io.plain import finite, load_json
from neuprim.report.pictures import error_map

__all__ = ["FILE", "Region", "RegionFile", "Regions", "read_regions", "worst_region"]

FILE = "worst.json"
"""Beside the pictures in ``renders/``."""

SHARE, LEAST = 0.25, 16
"""Side of a region over the shorter side of its image, and in pixels."""

MOST = 60
"""Views whose regions are kept: the worst of them."""

_STEPS = 8
"""Places along a region's side at which regions are compared."""


@dataclass(frozen=True)
class Region:
    """A square of an image, in pixels from its upper left corner, and its PSNR in dB (infinite where nothing
    differs)."""

    x: int
    y: int
    side: int
    psnr: float

    def of(self, image: Tensor) -> Tensor:
        """(side, side, C) of an (H, W, C) image."""
        return image[self.y : self.y + self.side, self.x : self.x + self.side]


def worst_region(rendered: Tensor, truth: Tensor) -> Region:
    """Where the mean squared error over a square of a quarter of the shorter side is largest; (H, W, C) images in the
    same colour space."""
    height, width = truth.shape[:2]
    side = min(max(round(SHARE * min(height, width)), LEAST), height, width)
    error = (rendered.double() - truth.double()).square().mean(-1)[None, None]
    stride = max(side // _STEPS, 1)
    means = F.avg_pool2d(error, side, stride)[0, 0]
    row, column = divmod(int(means.argmax()), means.shape[1])
    mse = float(means[row, column])
    return Region(column * stride, row * stride, side, -10 * math.log10(mse) if mse > 0 else math.inf)


class Regions:
    """Collects the worst regions of views as they are measured, and writes those of the worst views.

    Args:
        display: turns a linear or many-channelled image into what a picture shows.
    """

    def __init__(self, display: Callable[[Tensor], Tensor]) -> None:
        self._display = display
        self._found: list[tuple[Region, str, Tensor]] = []

    def look(self, name: str, rendered: Tensor, truth: Tensor) -> None:
        """Remember a view's worst region."""
        region = worst_region(rendered, truth)
        if not math.isfinite(region.psnr):
            return
        first, second = region.of(truth), region.of(rendered)
        shown = [images.to_uint8(self._display(x)) for x in (first, second)]
        self._found.append((region, name, torch.cat([*shown, torch.from_numpy(error_map(second, first))], dim=1)))
        if len(self._found) > 2 * MOST:
            self._worst()

    def _worst(self) -> None:
        self._found.sort(key=lambda found: found[0].psnr)
        del self._found[MOST:]

    def write(self, folder: Path) -> None:
        """``worst_000.png`` (truth, render and error side by side), the worst first, and ``worst.json`` that says what
        they are."""
        self._worst()
        entries = []
        for place, (region, name, picture) in enumerate(self._found):
            images.write_png(folder / f"worst_{place:03d}.png", picture)
            entries.append({"file": f"worst_{place:03d}.png", "name": name, **asdict(region)})
        write_json(folder / FILE, entries)


@dataclass(frozen=True)
class RegionFile:
    """One entry of ``worst.json``."""

    path: Path
    name: str
    psnr: float
    place: str


def read_regions(folder: Path) -> list[RegionFile]:
    """What ``folder`` (``renders/``) has; empty without ``worst.json``, as older runs and those that have not ended
    are.

    Raises:
        DataError: the file is damaged.
    """
    file = folder / FILE
    if not file.is_file():
        return []
    try:
        entries = load_json(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file}: not valid JSON ({error})") from error
    if not isinstance(entries, list):
        raise DataError(f"{file}: expected a list, found {type(entries).__name__}")
    return [entry for one in entries if (entry := _entry(folder, one)) is not None]


def _entry(folder: Path, one: Any) -> RegionFile | None:
    """None for what is no region of a picture in this folder."""
    if not isinstance(one, Mapping):
        return None
    name, psnr = one.get("file"), one.get("psnr")
    numbers = [one.get(key) for key in ("x", "y", "side")]
    if (
        not isinstance(name, str)
        or Path(name).name != name
        or not name.startswith("worst_")
        or name not in {f.name for f in folder.iterdir()}
    ):
        return None
    value = finite(psnr)
    if value is None or not all(isinstance(n, int) for n in numbers):
        return None
    x, y, side = numbers
    return RegionFile(folder / name, str(one.get("name")), value, f"{side}×{side} at ({x}, {y})")

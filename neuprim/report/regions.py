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
from neuprim.core.io.files import read_json, write_json
from neuprim.core.io.plain import finite_json_number
from neuprim.report.pictures import error_map

REGIONS_FILE = "worst.json"  # beside the pictures in ``renders/``
_SIDE_SHARE, MIN_SIDE = 0.25, 16  # side of a region over the shorter side of its image, and in pixels
MAX_REGIONS = 60  # views whose regions are kept: the worst of them
_STEPS = 8  # places along a region's side at which regions are compared


@dataclass(frozen=True)
class Region:
    """A square of an image, in pixels from its upper left corner, and its PSNR, dB (infinite where nothing differs)."""

    x: int
    y: int
    side: int
    psnr: float

    def of(self, image: Tensor) -> Tensor:
        """Return the (side, side, C) part of an (H, W, C) image."""
        return image[self.y : self.y + self.side, self.x : self.x + self.side]


def worst_region(rendered: Tensor, truth: Tensor) -> Region:
    """Return the square of a quarter of the shorter side with the largest mean squared error.

    Args:
        rendered, truth: (H, W, C) images in the same colour space.
    """
    height, width = truth.shape[:2]
    side = min(max(round(_SIDE_SHARE * min(height, width)), MIN_SIDE), height, width)
    error = (rendered.double() - truth.double()).square().mean(-1)[None, None]
    stride = max(side // _STEPS, 1)
    means = F.avg_pool2d(error, side, stride)[0, 0]
    row, column = divmod(int(means.argmax()), means.shape[1])
    mse = float(means[row, column])
    return Region(column * stride, row * stride, side, -10 * math.log10(mse) if mse > 0 else math.inf)


class WorstRegions:
    """Collects the worst regions of views as they are measured, and writes those of the worst views.

    Args:
        display: turns a linear or many-channelled image into what a picture shows.
    """

    def __init__(self, display: Callable[[Tensor], Tensor]) -> None:
        self._display = display
        self._found: list[tuple[Region, str, Tensor]] = []

    def add_view(self, name: str, rendered: Tensor, truth: Tensor) -> None:
        """Remember a view's worst region."""
        region = worst_region(rendered, truth)
        if not math.isfinite(region.psnr):
            return
        first, second = region.of(truth), region.of(rendered)
        shown = [images.to_uint8(self._display(x)) for x in (first, second)]
        self._found.append((region, name, torch.cat([*shown, torch.from_numpy(error_map(second, first))], dim=1)))
        self._found.sort(key=lambda found: found[0].psnr)
        del self._found[MAX_REGIONS:]

    def write(self, folder: Path) -> None:
        """Write ``worst_000.png`` (truth, render and error side by side), the worst first, and ``worst.json``."""
        entries = []
        for place, (region, name, picture) in enumerate(self._found):
            images.write_png(folder / f"worst_{place:03d}.png", picture)
            entries.append({"file": f"worst_{place:03d}.png", "name": name, **asdict(region)})
        write_json(folder / REGIONS_FILE, entries)


@dataclass(frozen=True)
class RegionFile:
    """One entry of ``worst.json``: its picture, the view's name, dB, and the square as text."""

    path: Path
    name: str
    psnr: float
    place: str


def read_regions(folder: Path) -> list[RegionFile]:
    """Read the regions of ``renders/``; empty without ``worst.json``.

    Raises:
        DataError: the file is damaged.
    """
    file = folder / REGIONS_FILE
    entries = read_json(file, "a list of regions", "evaluate the run again")
    if entries is None:
        return []
    if not isinstance(entries, list):
        raise DataError(f"{file}: expected a list, found {type(entries).__name__}")
    pictures = {path.name: path for path in folder.glob("worst_*.png")}
    return [region for entry in entries if (region := _parse_worst_region(pictures, entry)) is not None]


def _parse_worst_region(pictures: Mapping[str, Path], entry: Any) -> RegionFile | None:
    """Return a region; None for what is no region of a picture in the folder."""
    if not isinstance(entry, Mapping) or not isinstance(entry.get("file"), str) or entry["file"] not in pictures:
        return None
    value, numbers = finite_json_number(entry.get("psnr")), [entry.get(key) for key in ("x", "y", "side")]
    if value is None or not all(isinstance(n, int) for n in numbers):
        return None
    x, y, side = numbers
    return RegionFile(pictures[entry["file"]], str(entry.get("name")), value, f"{side}×{side} at ({x}, {y})")

"""Images of every frame from every camera: what they depend on, and what is written of a frame.

volumes/KEY/scene.json                 what was rendered, and how scene units map to the files' world
volumes/KEY/frame_00012/cam_07.exr     linear RGB radiance and alpha, premultiplied, half floats
volumes/KEY/frame_00012/points.npz     where the frame's matter is, for starting points
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.core.cameras import Camera
from neuprim.core.compute import device as hardware
from neuprim.core.errors import DataError
from neuprim.core.io.exr import write_exr
from neuprim.core.io.store import Store
from neuprim.core.io.vdb import VdbFrame
from neuprim.core.volumes.source import Extent
from neuprim.tasks.dynamic.volume.grids import GridReader
from neuprim.tasks.dynamic.volume.march import integrate
from neuprim.tasks.dynamic.volume.medium import Medium
from neuprim.tasks.dynamic.volume.normalise import Normalisation
from neuprim.tasks.dynamic.volume.optics import Look, medium_of

__all__ = ["LAST", "POINTS", "RENDERER_VERSION", "Capture"]

RENDERER_VERSION = 2
"""Part of the cache's key: to be raised with every change to the march, the optics, the rig or the files' layout."""

POINTS = 8192
"""Starting points kept per frame."""

LAST = "points.npz"
"""The file of a frame that is written last."""

_POINTS_BYTES = 2 * POINTS * 3 * 4 + 2**16


@dataclass(frozen=True)
class Capture:
    """Everything the images depend on.

    Attributes:
        frames: the files, in order.
        reader: which grids mean what.
        cameras: all of them, those held out included.
        bounds: (2, 3) box around all matter, scene units.
        device: what renders them. A card's images have a folder of their own, as they differ in their last bits.
        ends: numbers whose times are 0 and 1; None: the first and the last frame's.
        measured: number of a frame -> what its extinction grid holds; empty where nobody needs to know.
    """

    frames: Sequence[VdbFrame]
    reader: GridReader
    look: Look
    cameras: Sequence[Camera]
    samples: int
    normalisation: Normalisation
    bounds: np.ndarray
    device: torch.device = hardware.HOST
    ends: tuple[int, int] | None = None
    measured: Mapping[int, Extent] = field(default_factory=dict)

    @property
    def components(self) -> tuple[str, ...]:
        """The extinction grid's meaning where flames add to its extinction, so that its own part is kept apart; else
        none."""
        return (self.reader.extinction,) if self.look.mixes(self.reader.names) else ()

    @property
    def clock(self) -> tuple[int, int]:
        """Numbers whose times are 0 and 1."""
        return self.ends or (self.frames[0].number, self.frames[-1].number)

    def time(self, frame: VdbFrame) -> float:
        """A frame's time; numbers are time: a gap in them is one in time."""
        first, last = self.clock
        return (frame.number - first) / max(last - first, 1)

    def within(self, first: int, last: int) -> Capture:
        """The frames with these numbers and between them; their times stay, and the folder of the images is that of all
        frames."""
        return replace(self, frames=[frame for frame in self.frames if first <= frame.number <= last], ends=self.clock)

    def key(self) -> str:
        """A short hash of all of it; files count by name, size and time of change."""
        stats = [(f.number, str(f.path), f.path.stat().st_size, f.path.stat().st_mtime_ns) for f in self.frames]
        cameras = [(c.viewmat.tolist(), c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in self.cameras]
        parts = [
            RENDERER_VERSION,
            stats,
            asdict(self.look),
            dict(self.reader.names),
            cameras,
            self.samples,
            self.normalisation.to_json(),
        ]
        parts += [self.device.type] * hardware.has_warp(self.device)
        return hashlib.sha256(json.dumps(parts, default=_plain).encode()).hexdigest()[:16]

    def medium(self, frame: VdbFrame) -> Medium:
        """What a frame's file holds, as extinction and radiance; nothing where it lacks the grids that absorb in the
        others."""
        grids = self.reader.read(frame.path)
        if self.reader.extinction not in grids and not (self.components and self.look.flame_grid in grids):
            return Medium.nothing()
        try:
            return medium_of(
                grids,
                replace(self.look, extinction_grids=(self.reader.extinction,)),
                self.normalisation,
                where=self.device,
            )
        except DataError as error:
            raise DataError(f"{frame.path}: {error}") from error

    def name(self, frame: VdbFrame) -> str:
        """Of the folder of a frame's files."""
        return f"frame_{frame.number:05d}"

    def image(self, store: Store, frame: VdbFrame, camera: int) -> Path:
        """File of one image. Raises DataError where the store cannot be read."""
        pixels = self.cameras[camera].width * self.cameras[camera].height
        return store.fetch_file(f"{self.name(frame)}/cam_{camera:02d}.exr", pixels * 4 * 4 + 2**16)

    def points(self, store: Store, frame: VdbFrame) -> Path:
        """File of a frame's points: means (M, 3) scene units, colors (M, 3) linear radiance, weight (), the frame's
        total extinction, and largest (), its largest."""
        return store.fetch_file(f"{self.name(frame)}/{LAST}", _POINTS_BYTES)

    def describe(self) -> dict[str, Any]:
        """What ``scene.json`` holds."""
        return {
            "renderer_version": RENDERER_VERSION,
            "frames": [{"number": f.number, "file": str(f.path)} for f in self.frames],
            "grids": dict(self.reader.names),
            "look": json.loads(json.dumps(asdict(self.look), default=_plain)),
            "cameras": len(self.cameras),
            "size": [self.cameras[0].width, self.cameras[0].height],
            "samples": self.samples,
            "normalisation": self.normalisation.to_json(),
        }

    def render(self, frame: VdbFrame, folder: Path) -> None:
        """Write all files of a frame into a folder.

        Raises:
            DataError: the frame's file cannot be read, or its light does not fit half floats.
            OSError: a file cannot be written.
        """
        medium = self.medium(frame)
        brightest = 0.0
        for c, camera in enumerate(self.cameras):
            rgba = integrate(medium, camera, samples=self.samples, where=self.device)
            peak = float(rgba[..., :3].max().half())  # as it is stored: what half floats round to 0 is no light
            if not np.isfinite(peak):
                raise DataError(
                    f"{frame.path}: a radiance of {float(rgba[..., :3].max()):.3g} does not fit the images' half floats; "
                    "expected at most 65504 (scene.optics.emission, ambient and light set it)"
                )
            brightest = max(brightest, peak)
            write_exr(folder / f"cam_{c:02d}.exr", rgba, half=True)
        largest = medium.values[..., 0].max(initial=0.0)
        np.savez(
            folder / LAST, brightest=np.float32(brightest), largest=np.float32(largest), **_points(medium, frame.number)
        )


def _points(medium: Medium, seed: int) -> dict[str, Any]:
    """Points drawn where the extinction is, in proportion to it, with jitter inside their voxels."""
    generator = np.random.default_rng(seed)
    sigma = medium.values[..., 0]
    total = float(sigma.sum(dtype=np.float64))
    if total <= 0:
        return {"means": np.zeros((0, 3), np.float32), "colors": np.zeros((0, 3), np.float32), "weight": np.float64(0)}
    cumulative = np.cumsum(sigma.ravel(), dtype=np.float64)
    flat = np.searchsorted(cumulative, generator.random(POINTS) * cumulative[-1], side="right").clip(max=sigma.size - 1)
    index = np.stack(np.unravel_index(flat, sigma.shape), -1)
    values = medium.values.reshape(-1, 4)[flat]
    jittered = index + generator.random((POINTS, 3)) - 0.5
    means = jittered @ medium.scene_from_index[:3, :3].T + medium.scene_from_index[:3, 3]
    colors = values[:, 1:] / np.maximum(values[:, :1], 1e-12)
    cell = abs(float(np.linalg.det(medium.scene_from_index[:3, :3])))
    return {"means": means.astype(np.float32), "colors": colors.astype(np.float32), "weight": np.float64(total * cell)}


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)

"""Rendered volume sequences as a data set: 38 cameras to learn from, two held out, every frame a time."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.data import Clip, Dataset, DataSource, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.errors import DataError
from neuprim.core.io import images
from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes.source import Placement
from neuprim.tasks.dynamic.invisible import invisible_fraction
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.compare import compare_with_truth
from neuprim.tasks.dynamic.volume.source import placement_of

__all__ = ["MEMORY", "MEMORY_TEST", "FrameViews", "VolumeDataset"]

MEMORY = 3 * 2**28
"""Bytes of decoded images that the training split keeps, 768 MiB; beyond them the oldest are read again when needed."""

MEMORY_TEST = 2**27
"""The same of the test split, which is gone through in order."""

_MATTER = 1.0 / 255.0  # alpha from which a pixel belongs to the union mask


class FrameViews(ViewSet):
    """Frames of some cameras, camera by camera; half floats, decoded when first used.

    ``every`` = n leaves out all but every n-th frame; times stay those of the whole sequence.
    """

    def __init__(
        self, capture: Capture, folder: Path, cameras: Sequence[int], exposure: float, every: int = 1, memory: int = MEMORY
    ) -> None:
        self.capture, self.folder, self.cameras, self.exposure, self.memory = capture, folder, list(cameras), exposure, memory
        self._kept: OrderedDict[int, Tensor] = OrderedDict()
        self.frames = capture.frames[::every]
        first, last = capture.frames[0].number, capture.frames[-1].number  # numbers are time: a gap in them is one in time
        self.times = [torch.tensor((frame.number - first) / max(last - first, 1)) for frame in self.frames]

    def __len__(self) -> int:
        return len(self.cameras) * len(self.times)

    def view(self, index: int) -> View:
        c, t = divmod(index, len(self.times))
        frame = self.frames[t]
        return View(f"cam_{self.cameras[c]:02d}_frame_{frame.number:04d}", self.capture.cameras[self.cameras[c]], {"time": self.times[t]})

    def pixels(self, index: int) -> Pixels:
        rgba = self._decoded(index).float()
        return Pixels(rgba[..., :3] / self.exposure, rgba[..., 3])

    def _decoded(self, index: int) -> Tensor:
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        c, t = divmod(index, len(self.times))
        camera = self.capture.cameras[self.cameras[c]]
        path = self.capture.image(self.folder, self.frames[t], self.cameras[c])
        try:
            rgba = images.read_image(path, (camera.width, camera.height))
        except DataError as error:
            raise DataError(f"{error}; delete the folder {path.parent} to render the frame again") from error
        self._kept[index] = rgba = rgba.half()
        while len(self._kept) > 1 and len(self._kept) * rgba.numel() * 2 > self.memory:
            self._kept.popitem(last=False)
        return rgba


class VolumeDataset(Dataset):
    """A volume sequence seen by cameras; colours are linear radiance over ``exposure``, the brightest value any camera sees."""

    train: FrameViews
    test: FrameViews
    channels = 3
    color_space = "linear"
    random_background = True

    def __init__(
        self, name: str, source: DataSource, capture: Capture, folder: Path, held_out: Sequence[int], up: Tensor, every: int = 1
    ) -> None:
        self.name, self.data_source = name, source
        self.capture, self.folder, self.every = capture, folder, every
        stored = [_stored(capture.points(folder, frame)) for frame in capture.frames]
        self.exposure = max(float(s["brightest"]) for s in stored)
        if not self.exposure > 0:
            raise DataError(f"{name}: every frame is black from every camera; expected light (check scene.look and scene.grids)")
        self.weights = [float(s["weight"]) for s in stored]
        learned = [c for c in range(len(capture.cameras)) if c not in held_out]
        self.train = FrameViews(capture, folder, learned, self.exposure, every)
        self.test = FrameViews(capture, folder, held_out, self.exposure, memory=MEMORY_TEST)
        self.extent = camera_extent(capture.cameras)
        self.background = torch.zeros(3)
        camera = capture.cameras[0]
        self.downsampling = f"rendered at {camera.width}x{camera.height}, {capture.samples}x{capture.samples} rays per pixel"
        self.up, self.center = up, torch.zeros(3, dtype=torch.float64)
        self.bounds = torch.from_numpy(capture.bounds)
        self._masks: dict[int, Tensor] = {}

    def initial_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """Points where some frame absorbs, as many of a frame as it has of the sequence's extinction, with the frame's time."""
        total = np.array(self.weights)
        total[[t for t in range(len(total)) if t % self.every]] = 0.0  # nothing is known of frames that are not learned from
        if not total.sum() > 0:
            raise DataError(
                f"{self.name}: no frame to learn from absorbs light; expected extinction in one (scene.frames, scene.train_every)"
            )
        share = torch.multinomial(torch.from_numpy(total), count, replacement=True, generator=generator)
        per_frame = torch.bincount(share, minlength=len(total)).tolist()
        means, colors, times = [], [], []
        for t, wanted in enumerate(per_frame):
            if not wanted:
                continue
            stored = _stored(self.capture.points(self.folder, self.capture.frames[t]))
            points = torch.from_numpy(stored["means"])
            rows = torch.randperm(len(points), generator=generator)[torch.arange(wanted) % len(points)]
            place = points[rows]
            if wanted > len(points):  # points used again stand beside themselves, or they would start with no size
                apart = torch.from_numpy(cKDTree(stored["means"]).query(stored["means"], k=2)[0][:, 1]).float()
                place[len(points) :] += (apart[rows, None] * (torch.rand((wanted, 3), generator=generator) - 0.5))[len(points) :]
            means.append(place)
            colors.append(torch.from_numpy(stored["colors"])[rows] / self.exposure)
            times.append(torch.full((wanted,), float(self.test.times[t])))
        return PointCloud(torch.cat(means), torch.cat(colors), {"time": torch.cat(times)})

    def clips(self) -> list[Clip]:
        frames = len(self.capture.frames)
        return [Clip(f"cam_{c:02d}", range(i * frames, (i + 1) * frames), 24.0) for i, c in enumerate(self.test.cameras)]

    def mask(self, index: int) -> Tensor:
        """Pixels that show matter in some frame of the view's camera."""
        frames = len(self.capture.frames)
        camera = index // frames
        if camera not in self._masks:
            alphas = (self.test.pixels(i).alpha for i in range(camera * frames, (camera + 1) * frames))
            union = torch.zeros(self.test.view(index).camera.height, self.test.view(index).camera.width, dtype=torch.bool)
            for alpha in alphas:
                assert alpha is not None
                union |= alpha > _MATTER
            self._masks[camera] = union
        return self._masks[camera]

    def placement(self) -> Placement:
        return placement_of(self.capture)

    def diagnose(self, model: Primitives) -> dict[str, Any]:
        """The model's extinction against the files', and its size against theirs."""
        return {
            "exposure": self.exposure,
            "vdb_bytes": sum(frame.path.stat().st_size for frame in self.capture.frames),
            "normalisation": self.capture.normalisation.to_json(),
            "invisible_fraction": invisible_fraction(model, self.test.times),
            **compare_with_truth(model, self.capture, [float(t) for t in self.test.times]),
        }


def _stored(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in ("means", "colors", "weight", "brightest")}
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise DataError(f"{path}: damaged ({error}); delete its folder to render the frame again") from error

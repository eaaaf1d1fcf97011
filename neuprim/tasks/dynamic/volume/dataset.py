"""Rendered volume sequences as a data set: 38 cameras to learn from, two held out, every frame a time."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset, DataSource, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.errors import DataError
from neuprim.core.io import images
from neuprim.core.io.arrays import read_arrays
from neuprim.core.io.store import Store
from neuprim.core.notices import warn_once
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.source import placement_of
from neuprim.tasks.dynamic.volume.voxels import FrameVoxels

__all__ = ["MEMORY", "TRAINING", "FrameViews", "Recording", "stored_points", "volume_dataset"]

MEMORY = 11 * 2**27
"""Bytes of decoded images and voxels that are kept, 1408 MiB; beyond them those not used for longest are read again
when needed."""

TRAINING, _TEST, _VOXELS = 6 / 11, 1 / 11, 4 / 11
"""Shares of the training images, of the test images, which are gone through in order, and of the voxels."""

_MATTER = 1.0 / 255.0  # alpha from which a pixel belongs to the union mask


class FrameViews(ViewSet):
    """Frames of some cameras, camera by camera; half floats, decoded when first used.

    ``every`` = n leaves out all but every n-th frame; times stay those of the whole sequence.
    """

    def __init__(
        self,
        capture: Capture,
        folder: Store,
        cameras: Sequence[int],
        exposure: float,
        every: int = 1,
        memory: float = MEMORY,
    ) -> None:
        self.capture, self.folder, self.cameras, self.exposure, self.memory = (
            capture,
            folder,
            list(cameras),
            exposure,
            memory,
        )
        self._kept: OrderedDict[int, Tensor] = OrderedDict()
        self.frames = capture.frames[::every]
        self.times = [torch.tensor(capture.time(frame)) for frame in self.frames]

    def __len__(self) -> int:
        return len(self.cameras) * len(self.times)

    def view(self, index: int) -> View:
        c, t = divmod(index, len(self.times))
        frame = self.frames[t]
        return View(
            f"cam_{self.cameras[c]:02d}_frame_{frame.number:04d}",
            self.capture.cameras[self.cameras[c]],
            {"time": self.times[t]},
        )

    def pixels(self, index: int) -> Pixels:
        rgba = self._decoded(index).float()
        return Pixels(rgba[..., :3] / self.exposure, rgba[..., 3])

    def _decoded(self, index: int) -> Tensor:
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        c, t = divmod(index, len(self.times))
        camera = self.capture.cameras[self.cameras[c]]
        frame, number = self.frames[t], self.cameras[c]

        def read() -> Tensor:
            path = self.capture.image(self.folder, frame, number)
            return images.read_image(path, (camera.width, camera.height))

        try:
            rgba = self.folder.retry(read, warn_once)
        except DataError as error:
            raise DataError(
                f"{error}; delete the folder {self.folder.at(self.capture.name(frame)).address} to render the frame again"
            ) from error
        self._kept[index] = rgba = rgba.half()
        while len(self._kept) > 1 and len(self._kept) * rgba.numel() * 2 > self.memory:
            self._kept.popitem(last=False)
        return rgba


@dataclass(frozen=True, eq=False)
class Recording:
    """A volume sequence as cameras saw it: what the dynamic task judges models of it by, a data set's ``extra``.

    Attributes:
        name: of the data set.
        folder: of the rendered images, a folder or a place in an object store.
        exposure: the brightest value that any camera sees.
        weights: per frame, its share of the sequence's extinction.
        every: every n-th frame is learned from.
        test: the held-out views, camera by camera, all frames of each.
    """

    name: str
    capture: Capture
    folder: Store
    exposure: float
    weights: Sequence[float]
    every: int
    test: FrameViews
    _tracks: dict[int, Tensor] = field(default_factory=dict, repr=False)

    def points(self, views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
        """Points where some frame absorbs, as many of a frame as it has of the sequence's extinction, with the frame's
        time."""
        total = np.array(self.weights)
        total[[t for t in range(len(total)) if t % self.every]] = (
            0.0  # nothing is known of frames that are not learned from
        )
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
            stored = stored_points(self.capture.points(self.folder, self.capture.frames[t]), "means", "colors")
            points = torch.from_numpy(stored["means"])
            rows = torch.randperm(len(points), generator=generator)[torch.arange(wanted) % len(points)]
            place = points[rows]
            if wanted > len(points):  # points used again stand beside themselves, or they would start with no size
                apart = torch.from_numpy(cKDTree(stored["means"]).query(stored["means"], k=2)[0][:, 1]).float()
                place[len(points) :] += (apart[rows, None] * (torch.rand((wanted, 3), generator=generator) - 0.5))[
                    len(points) :
                ]
            means.append(place)
            colors.append(torch.from_numpy(stored["colors"])[rows] / self.exposure)
            times.append(torch.full((wanted,), float(self.test.times[t])))
        apart_by = np.diff([float(time) for time in self.test.times][:: self.every])
        steps = {"time": float(np.median(apart_by))} if len(apart_by) else {}
        return PointCloud(torch.cat(means), torch.cat(colors), {"time": torch.cat(times)}, steps=steps)

    def track(self, index: int) -> Tensor:
        """(H, W) bool, the pixels that show matter in some frame of a test view's camera; kept, as all frames of a
        camera share it."""
        frames = len(self.capture.frames)
        camera = index // frames
        if camera not in self._tracks:
            alphas = (self.test.pixels(i).alpha for i in range(camera * frames, (camera + 1) * frames))
            union = torch.zeros(
                self.test.view(index).camera.height, self.test.view(index).camera.width, dtype=torch.bool
            )
            for alpha in alphas:
                assert alpha is not None
                union |= alpha > _MATTER
            self._tracks[camera] = union
        return self._tracks[camera]


def volume_dataset(
    name: str,
    source: DataSource,
    capture: Capture,
    folder: Store,
    held_out: Sequence[int],
    up: Tensor,
    every: int = 1,
    span: tuple[int, int] | None = None,
    memory: float = MEMORY,
) -> Dataset:
    """A volume sequence seen by cameras; colours are linear radiance over the exposure, the brightest value any camera
    sees.

    Args:
        folder: of the images that the capture took.
        held_out: indices of the cameras of the test split.
        span: numbers of the first and the last frame that are learned from and judged; the exposure is that of all.
        None: all. memory: bytes of decoded images and voxels that are kept.

    Raises:
        DataError: every frame is black, or a file is damaged.
    """
    stored = [stored_points(capture.points(folder, frame), "brightest", "largest") for frame in capture.frames]
    exposure = max(float(frame["brightest"]) for frame in stored)
    if not exposure > 0:
        raise DataError(
            f"{name}: every frame is black from every camera; expected light (check scene.look and scene.grids)"
        )
    if span is not None:
        capture = capture.within(*span)
    learned = [c for c in range(len(capture.cameras)) if c not in held_out]
    train = FrameViews(capture, folder, learned, exposure, every, memory * TRAINING)
    test = FrameViews(capture, folder, held_out, exposure, memory=memory * _TEST)
    weights = [float(stored_points(capture.points(folder, frame), "weight")["weight"]) for frame in capture.frames]
    recording = Recording(name, capture, folder, exposure, weights, every, test)
    camera = capture.cameras[0]
    return Dataset(
        name=name,
        train=train,
        test=test,
        start=recording.points,
        extent=camera_extent(capture.cameras),
        background=torch.zeros(3),
        color_space="linear",
        data_source=source,
        random_background=True,
        downsampling=f"rendered at {camera.width}x{camera.height}, {capture.samples}x{capture.samples} rays per pixel",
        up=up,
        center=torch.zeros(3, dtype=torch.float64),
        bounds=torch.from_numpy(capture.bounds),
        exposure=exposure,
        world=World(torch.from_numpy(capture.normalisation.matrix())),
        placement=placement_of(capture),
        largest=max(float(frame["largest"]) for frame in stored),
        points=FrameVoxels(capture, folder, train.frames, train.times, weights[::every], exposure, memory * _VOXELS),
        extra=recording,
    )


_POINTS = {
    "means": (np.float32, (None, 3)),
    "colors": (np.float32, (None, 3)),
    "weight": (np.float64, ()),
    "brightest": (np.float32, ()),
    "largest": (np.float32, ()),
}


def stored_points(path: Path, *names: str) -> dict[str, Any]:
    """What is asked for of a frame's points; of all frames together they would be large."""
    try:
        return read_arrays(path, {name: _POINTS[name] for name in names})
    except DataError as error:
        raise DataError(f"{error}; delete its folder to render the frame again") from error

"""Dataset of a rendered volume sequence: one view per camera and frame; two cameras are held out."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset, DataSource, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.errors import DataError, warn_once
from neuprim.core.io import images
from neuprim.core.io.json_reader import read_npz_arrays
from neuprim.core.io.store import Store
from neuprim.core.io.vdb import VdbFrame
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.capture_voxels import FrameVoxels, RecentFrames
from neuprim.tasks.dynamic.volume.motion import measure_velocity_grid
from neuprim.tasks.dynamic.volume.optics import Light

TRAINING_MEMORY, _TEST_MEMORY, _VOXEL_MEMORY = 6 / 11, 1 / 11, 4 / 11
"""Shares of the setting ``memory`` for training images, for test images (read in order) and for voxels."""

LIGHT_DISTANCE = 1e4
"""Distance from the scene's centre at which directional lights are placed, scene units."""

_MIN_ALPHA = 1.0 / 255.0  # least alpha of a pixel that shows matter


class VdbFrameViews(ViewSet):
    """Views of a rendered volume sequence: all frames of the first camera, then of the next one, and so on.

    Images are decoded to half floats on first use.

    Args:
        folder: store of the images.
        cameras: numbers of the capture's cameras whose views are included.
        exposure: radiance that becomes 1 in the pixels; all radiance is divided by ``exposure``.
        every: use every n-th frame only; times remain relative to the whole sequence.
        memory: limit on the decoded images in memory, bytes.
    """

    def __init__(
        self,
        capture: Capture,
        folder: Store,
        cameras: Sequence[int],
        exposure: float,
        every: int = 1,
        memory: float = math.inf,
    ) -> None:
        self.capture, self.folder, self.cameras, self.exposure = capture, folder, list(cameras), exposure
        self._images = RecentFrames(self._decode, lambda rgba: rgba.numel() * 2, memory)
        self.frames = capture.frames[::every]
        self.times = [torch.tensor(capture.time(frame)) for frame in self.frames]
        self._lights = [capture.frame_lights(frame) for frame in self.frames]  # once, as every step needs a view

    def __len__(self) -> int:
        return len(self.cameras) * len(self.times)

    def _split_index(self, index: int) -> tuple[int, int]:
        """Convert a view's index to the camera number and the index of the frame."""
        camera, frame = divmod(index, len(self.times))
        return self.cameras[camera], frame

    def view(self, index: int) -> View:
        camera, t = self._split_index(index)
        name = f"cam_{camera:02d}_frame_{self.frames[t].number:04d}"
        lit = light_conditions(self.capture, self._lights[t][camera])
        return View(name, self.capture.cameras[camera], {"time": self.times[t], **lit})

    def pixels(self, index: int) -> Pixels:
        rgba = self._images[index].float()
        return Pixels(rgba[..., :3] / self.exposure, rgba[..., 3])

    def _decode(self, index: int) -> Tensor:
        number, t = self._split_index(index)
        camera, frame = self.capture.cameras[number], self.frames[t]
        size = (camera.width, camera.height)

        def read() -> Tensor:
            return images.read_image(self.capture.fetch_image(self.folder, frame, number), size)

        try:
            return self.folder.retry(read, warn_once).half()
        except DataError as error:
            address = self.folder.at(self.capture.frame_folder(frame)).address
            raise DataError(f"{error}; delete the folder {address} to render the frame again") from error


def light_conditions(capture: Capture, light: Light | None) -> dict[str, Tensor]:
    """Return the conditions "light" (position) and "light_intensity" (irradiance) of a view with a light at infinity.

    The position is so far away that the rays of light are practically parallel. If the light is the same in all views,
    the result is empty, because the light is then no input of the model.
    """
    if capture.lights == 1 or light is None:
        return {}
    towards = torch.tensor(light.direction, dtype=torch.float64)
    irradiance = torch.tensor(light.irradiance, dtype=torch.float32)
    return {"light": (LIGHT_DISTANCE * towards / towards.norm()).float(), "light_intensity": irradiance}


@dataclass(frozen=True, eq=False)
class VolumeRecording:
    """Facts about a rendered volume sequence for starting points and evaluation; stored as a dataset's ``extra``.

    Attributes:
        folder: store of the rendered images.
        exposure: the brightest radiance that any camera sees.
        weights: total extinction of each frame.
        every: n; every n-th frame is used for training.
        test: the held-out views: all frames of one camera, then all frames of the next.
    """

    name: str
    capture: Capture
    folder: Store
    exposure: float
    weights: Sequence[float]
    every: int
    test: VdbFrameViews
    _masks: dict[int, Tensor] = field(default_factory=dict, repr=False)

    def points(self, views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
        """Draw starting points with the "time" of their frame; frames are drawn in proportion to their extinction."""
        weights = np.array(self.weights)
        weights[[t for t in range(len(weights)) if t % self.every]] = 0.0
        if not weights.sum() > 0:
            raise DataError(
                f"{self.name}: no training frame absorbs light; "
                "expected extinction in at least one (check scene.frames and scene.train_every)"
            )
        frames = torch.multinomial(torch.from_numpy(weights), count, replacement=True, generator=generator)
        per_frame = torch.bincount(frames, minlength=len(weights)).tolist()
        means, colors, times, velocities = [], [], [], []
        moving = measure_velocity_grid(self.capture.frames, self.capture.reader, self.capture.velocity)
        for t in np.flatnonzero(per_frame).tolist():
            wanted = per_frame[t]
            stored = read_vdb_frame_points(
                self.capture.fetch_points(self.folder, self.capture.frames[t]), "means", "colors"
            )
            points = torch.from_numpy(stored["means"])
            rows = torch.randperm(len(points), generator=generator)[torch.arange(wanted) % len(points)]
            positions = points[rows]
            if wanted > len(points):  # move repeated points, or primitives would start without size
                spacing = torch.from_numpy(cKDTree(stored["means"]).query(stored["means"], k=2)[0][:, 1]).float()
                offsets = spacing[rows, None] * (torch.rand((wanted, 3), generator=generator) - 0.5)
                positions[len(points) :] += offsets[len(points) :]
            means.append(positions)
            colors.append(torch.from_numpy(stored["colors"])[rows] / self.exposure)
            times.append(torch.full((wanted,), float(self.test.times[t])))
            if moving is not None:
                velocities.append(self.capture.read_velocities(moving, self.capture.frames[t], positions))
        intervals = np.diff([float(time) for time in self.test.times][:: self.every])
        steps = {"time": float(np.median(intervals))} if len(intervals) else {}
        cloud = PointCloud(torch.cat(means), torch.cat(colors), {"time": torch.cat(times)}, steps=steps)
        return replace(cloud, velocities=torch.cat(velocities)) if velocities else cloud

    def matter_mask(self, index: int) -> Tensor:
        """Return (H, W) bool: pixels that smoke or fire covers in any frame of the camera of test view ``index``."""
        frames = len(self.capture.frames)
        camera = index // frames
        if camera not in self._masks:
            alphas = (self.test.pixels(i).alpha for i in range(camera * frames, (camera + 1) * frames))
            masks = (alpha > _MIN_ALPHA for alpha in alphas if alpha is not None)
            self._masks[camera] = functools.reduce(torch.logical_or, masks)
        return self._masks[camera]


@dataclass(frozen=True)
class TrainingFrames:
    """The part of a volume sequence that a run uses.

    Attributes:
        every: train on every n-th frame.
        span: numbers of the first and last frame for training and evaluation; None for all frames.
        memory: limit on the decoded images and voxels in memory, bytes.
    """

    every: int = 1
    span: tuple[int, int] | None = None
    memory: float = 1408 * 2.0**20


def volume_dataset(
    name: str,
    source: DataSource,
    capture: Capture,
    folder: Store,
    held_out: Sequence[int],
    up: Tensor,
    used: TrainingFrames = TrainingFrames(),
) -> Dataset:
    """Return the dataset of a rendered volume sequence.

    Colours are linear radiance, divided by the brightest value that any camera sees.

    Raises:
        DataError: every frame is black, or a file is damaged.
    """
    stored = [
        read_vdb_frame_points(capture.fetch_points(folder, frame), "brightest", "largest") for frame in capture.frames
    ]
    exposure = max(float(frame["brightest"]) for frame in stored)
    if not exposure > 0:
        raise DataError(
            f"{name}: every frame is black from every camera; expected light (check scene.look and scene.grids)"
        )
    if used.span is not None:
        capture = capture.select_frames(*used.span)
    training = [c for c in range(len(capture.cameras)) if c not in held_out]
    train = VdbFrameViews(capture, folder, training, exposure, used.every, used.memory * TRAINING_MEMORY)
    test = VdbFrameViews(capture, folder, held_out, exposure, memory=used.memory * _TEST_MEMORY)
    weights = [total_extinction_of_vdb_frame(capture, folder, frame) for frame in capture.frames]
    recording = VolumeRecording(name, capture, folder, exposure, weights, used.every, test)
    frames = list(zip(train.frames, train.times, strict=True))
    memory = used.memory * _VOXEL_MEMORY
    voxels = FrameVoxels(capture, folder, frames, exposure, weights[:: used.every], memory)
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
        placement=capture.placement(),
        largest=max(float(frame["largest"]) for frame in stored),
        points=voxels,
        extra=recording,
    )


_POINTS_FILE = {
    "means": (np.float32, (None, 3)),
    "colors": (np.float32, (None, 3)),
    "weight": (np.float64, ()),
    "brightest": (np.float32, ()),
    "largest": (np.float32, ()),
}


def read_vdb_frame_points(path: Path, *names: str) -> dict[str, Any]:
    """Read the arrays ``names`` of a frame's ``points.npz``; DataError if the file is damaged."""
    try:
        return read_npz_arrays(path, {name: _POINTS_FILE[name] for name in names})
    except DataError as error:
        raise DataError(f"{error}; delete its folder to render the frame again") from error


def total_extinction_of_vdb_frame(capture: Capture, store: Store, frame: VdbFrame) -> float:
    """Read the total extinction of a frame from its ``points.npz``."""
    return float(read_vdb_frame_points(capture.fetch_points(store, frame), "weight")["weight"])

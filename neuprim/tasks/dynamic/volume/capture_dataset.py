"""Dataset of a rendered volume sequence: one view per camera and frame; two cameras are held out."""

from __future__ import annotations

import functools
import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset, DataSource, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.data.dataset import PointSamples, PointSupervision
from neuprim.core.errors import DataError, warn_once
from neuprim.core.io import images
from neuprim.core.io.json_reader import read_npz_arrays
from neuprim.core.io.store import Store
from neuprim.core.io.vdb import VdbFrame
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.lit_medium import light_medium
from neuprim.tasks.dynamic.volume.optics import Light
from neuprim.tasks.dynamic.volume.raymarch import Medium

TRAINING_MEMORY, _TEST_MEMORY, _VOXEL_MEMORY = 6 / 11, 1 / 11, 4 / 11
"""Shares of the memory for training images, test images (read in order) and voxels."""

LIGHT_DISTANCE = 1e4
"""Distance from the scene's centre at which directional lights are placed, scene units."""

_MIN_ALPHA = 1.0 / 255.0  # least alpha of a pixel that shows matter

T = TypeVar("T")


class _RecentFrames(Generic[T]):
    """Cache of items, which ``read`` (index) provides on first use; ``size`` returns an item's bytes.

    If the items exceed ``memory`` bytes, the least recently used ones are dropped.
    """

    def __init__(self, read: Callable[[int], T], size: Callable[[T], int], memory: float) -> None:
        self._read, self._size, self._memory = read, size, memory
        self._items: OrderedDict[int, T] = OrderedDict()
        self._bytes = 0

    def __getitem__(self, index: int) -> T:
        if index in self._items:
            self._items.move_to_end(index)
            return self._items[index]
        self._items[index] = item = self._read(index)
        self._bytes += self._size(item)
        while len(self._items) > 1 and self._bytes > self._memory:
            self._bytes -= self._size(self._items.popitem(last=False)[1])
        return item


class VdbFrameViews(ViewSet):
    """Views of a rendered volume sequence: all frames of the first camera, then of the next one, and so on.

    Images are decoded to half floats on first use.

    Args:
        folder: store of the images.
        cameras: numbers of the capture's cameras whose views are included.
        exposure: radiance that is scaled to 1.
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
        self._images = _RecentFrames(self._decode, lambda rgba: rgba.numel() * 2, memory)
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

    The position is so far away that rays are practically parallel. If all views have the same light, the result is
    empty.
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
        every: n, if every n-th frame is used for training.
        test: the held-out views: all frames of one camera, then of the next.
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
        means, colors, times = [], [], []
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
        intervals = np.diff([float(time) for time in self.test.times][:: self.every])
        steps = {"time": float(np.median(intervals))} if len(intervals) else {}
        return PointCloud(torch.cat(means), torch.cat(colors), {"time": torch.cat(times)}, steps=steps)

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
    voxels = FrameVoxels(capture, folder, train, weights[:: used.every], used.memory * _VOXEL_MEMORY)
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


# ---------------------------------------------------------------- voxels to learn from

_NEAR, _FAR = 0.2, 0.1  # shares of the points around voxels with matter, and anywhere in the box
_ANY_FRAME = 0.1  # share of the draws that take any frame, so that nearly empty frames are learned as well
_MAX_OFFSET = 6  # voxels from one with matter, along each axis
_SPHERE = np.float32(4 * math.pi)  # isotropic smoke scatters this part of the light into each direction
_MARGIN = 0.1  # margin on each side of the sequence's box, as a share of its longest side

_VOXEL_ARRAYS = {
    "index": (np.int64, (None,)),
    "values": (np.float32, (None, None)),
    "shape": (np.int64, (3,)),
    "scene_from_index": (np.float64, (4, 4)),
}

_MAX_VOXEL_BYTES = 4 * 2**30  # of a frame; more than the largest grid that is read


@dataclass(frozen=True)
class MediumVoxels:
    """The voxels of a frame that are not empty.

    Attributes:
        index: (V,) int64 ascending, flat indices (i Y + j) Z + k of a grid of ``shape``.
        values: (V, C) float32: sigma, sigma times RGB radiance; if flames add to sigma, the part of sigma that comes
            from the extinction grid; if the model lights the voxels, this part times the RGB albedo.
        scene_from_index: (4, 4) float64.
    """

    index: np.ndarray
    values: np.ndarray
    shape: tuple[int, int, int]
    scene_from_index: np.ndarray

    @staticmethod
    def of(medium: Medium, lit: bool = False) -> MediumVoxels:
        """Return the voxels of a medium that have a non-zero value; if ``lit``, with their albedo."""
        flat = medium.values.reshape(-1, 4)
        if medium.scattering is not None:
            flat = np.concatenate([flat, medium.scattering.reshape(-1, 1)], 1)
        if lit and medium.scattered is not None:
            flat = np.concatenate([flat, medium.scattered.reshape(-1, 3)], 1)
        index = np.flatnonzero(flat.any(1))
        x, y, z = medium.values.shape[:3]
        return MediumVoxels(
            index.astype(np.int64), np.ascontiguousarray(flat[index]), (x, y, z), medium.scene_from_index
        )

    @property
    def has_part(self) -> bool:
        """Whether the extinction grid's part of sigma is stored, in column 4."""
        return self.values.shape[1] in (5, 8)

    @property
    def has_albedo(self) -> bool:
        """Whether the last three columns are sigma times albedo."""
        return self.values.shape[1] >= 7

    @functools.cached_property
    def rms(self) -> tuple[float, float, float, float]:
        """Root mean squares over the voxels of four values; 0 if there are no voxels or the value is not stored.

        The values are sigma, sigma times radiance, the extinction grid's part of sigma, and this part times albedo.
        """
        squares = np.square(self.values, dtype=np.float64).mean(0) if len(self.index) else np.zeros(8)
        part = squares[4] if self.has_part else 0.0
        scattered = squares[-3:].mean() if self.has_albedo else 0.0
        return tuple(float(np.sqrt(x)) for x in (squares[0], squares[1:4].mean(), part, scattered))  # type: ignore[return-value]

    def write(self, path: Path) -> None:
        """Write the voxels to an .npz file; raises OSError."""
        arrays: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in _VOXEL_ARRAYS}
        with open(path, "wb") as file:
            np.savez(file, **arrays)

    @staticmethod
    def read(path: Path) -> MediumVoxels:
        """Read voxels that :meth:`write` wrote.

        Raises:
            DataError: the file is damaged, or its arrays are not voxels of a grid.
        """
        found = read_npz_arrays(path, _VOXEL_ARRAYS)
        index, values, matrix = found["index"], found["values"], found["scene_from_index"]
        x, y, z = (int(n) for n in found["shape"])
        ascending = not len(index) or (index[0] >= 0 and index[-1] < x * y * z and bool((np.diff(index) > 0).all()))
        inside = min(x, y, z) >= 0 and x * y * z < 2**62 and ascending
        finite = np.isfinite(values).all() and np.isfinite(matrix).all()
        if len(index) != len(values) or values.shape[1] not in (4, 5, 7, 8) or not inside or not finite:
            raise DataError(
                f"{path}: damaged ({len(index)} voxels of a grid of {x}x{y}x{z}; "
                "expected ascending voxel indices in the grid, and finite values)"
            )
        return MediumVoxels(index, values, (x, y, z), matrix)

    def values_at_cells(self, cells: np.ndarray) -> np.ndarray:
        """Return (M, C) values of the voxels with integer indices ``cells`` (M, 3); 0 for empty voxels."""
        values = np.zeros((len(cells), self.values.shape[1]), np.float32)
        inside = ((cells >= 0) & (cells < np.array(self.shape))).all(1)
        if len(self.index) and inside.any():
            flat = np.ravel_multi_index(tuple(cells[inside].T), self.shape)
            place = np.searchsorted(self.index, flat).clip(max=len(self.index) - 1)
            values[inside] = np.where((self.index[place] == flat)[:, None], self.values[place], np.float32(0))
        return values


class FrameVoxels(PointSupervision):
    """Sampler of voxels, for training that compares the model with the extinction of the files.

    The points of one draw are from one frame. The probability of a frame is proportional to its extinction; in one
    draw of ten, it is the same for all frames. 70 % of the points are voxels with matter, 20 % lie up to six voxels
    away from such a voxel, and 10 % anywhere in a box larger than the sequence's box.

    Args:
        folder: store of the images. Lit voxels are stored there, too, since their light takes long to compute.
        views: training views; their frames, times and exposure are used.
        weights: total extinction of each frame of ``views``.
        memory: limit on the voxels in memory, bytes.
    """

    def __init__(
        self, capture: Capture, folder: Store, views: VdbFrameViews, weights: Sequence[float], memory: float
    ) -> None:
        self.capture, self.folder, self.frames, self.times = capture, folder, list(views.frames), list(views.times)
        self.exposure, self.components = views.exposure, capture.components
        shares = torch.tensor(weights, dtype=torch.float64)
        self.chances = (1 - _ANY_FRAME) * shares / shares.sum().clamp_min(1e-300) + _ANY_FRAME / len(self.frames)
        self._voxels = _RecentFrames(self._read_voxels, lambda v: v.index.nbytes + v.values.nbytes, memory)

    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        t = int(torch.multinomial(self.chances, 1, generator=generator))
        voxels = self._voxels[t]
        near, far = round(_NEAR * count), round(_FAR * count)
        if not len(voxels.index):
            near, far = 0, count
        low, high = self.capture.bounds
        margin = _MARGIN * float((high - low).max())
        uniform = torch.rand((far, 3), generator=generator, dtype=torch.float64).numpy()
        places = low - margin + uniform * (high - low + 2 * margin)
        back = np.linalg.inv(voxels.scene_from_index)
        cells = np.rint(places @ back[:3, :3].T + back[:3, 3]).astype(np.int64)
        known = np.zeros((0, voxels.values.shape[1]), np.float32)
        if far < count:
            rows = torch.randint(len(voxels.index), (count - far,), generator=generator).numpy()
            chosen = np.stack(np.unravel_index(voxels.index[rows], voxels.shape), -1)
            chosen[:near] += torch.randint(-_MAX_OFFSET, _MAX_OFFSET + 1, (near, 3), generator=generator).numpy()
            cells, known = np.concatenate([cells, chosen]), voxels.values[rows[near:]]
        values = np.concatenate([voxels.values_at_cells(cells[: count - len(known)]), known])
        points = cells @ voxels.scene_from_index[:3, :3].T + voxels.scene_from_index[:3, 3]
        sigma, light, part, scattered = voxels.rms
        fallback = self.capture.optics.extinction or 1.0  # for empty frames
        # the extinction grid's part of sigma; all of sigma in a frame without flames
        parts = torch.from_numpy(values[:, 4 if voxels.has_part else 0].copy())
        exposure, albedo = np.float32(self.exposure), values[:, -3:] if voxels.has_albedo else None
        light, scattered = self._light_scales(light, scattered)
        return PointSamples(
            name=f"frame_{self.frames[t].number:04d}",
            conditions={"time": self.times[t]},
            points=torch.from_numpy(points).float(),
            sigma=torch.from_numpy(values[:, 0].copy()),
            source=torch.from_numpy(values[:, 1:4] / exposure),
            sigma_scale=sigma or fallback,
            source_scale=(light or fallback) / self.exposure,
            components=dict.fromkeys(self.components, (parts, part or sigma or fallback)),
            scattered=None if albedo is None else torch.from_numpy(albedo / (_SPHERE * exposure)),
            scattered_scale=(scattered or fallback) / self.exposure,
        )

    def _light_scales(self, emitted: float, scattered: float) -> tuple[float, float]:
        """Return the scales of errors of sigma times radiance, and of that which smoke scatters per irradiance.

        If the model lights the voxels, both are relative to all light, emitted and scattered: a weak part of it must
        not count as much as the other.

        Args:
            emitted: root mean square of sigma times radiance.
            scattered: root mean square of the extinction grid's part of sigma times albedo; 0 if it is not stored.
        """
        light = self.capture.optics.light
        if not scattered or light is None:
            return emitted, scattered
        irradiance = sum(light.irradiance) / 3
        total = emitted + scattered * irradiance / (4 * math.pi)
        return total, total / irradiance

    def _read_voxels(self, t: int) -> MediumVoxels:
        return self.folder.retry(lambda: self._read_or_make_voxels(self.frames[t]), warn_once)

    def _supervised_medium(self, frame: VdbFrame) -> Medium:
        """Return the medium whose voxels a model is compared with in training.

        Its radiance includes the scattered light of a single light. If the capture has several lights, their light is
        not included, since the model adds it.
        """
        capture, medium = self.capture, self.capture.medium(frame)
        return medium if capture.lights > 1 else light_medium(medium, capture.frame_lights(frame)[0], capture.optics)

    def _read_or_make_voxels(self, frame: VdbFrame) -> MediumVoxels:
        lit = self.capture.lights > 1
        name = f"{self.capture.frame_folder(frame)}/{'voxels_albedo' if lit else 'voxels'}.npz"
        path = self.folder.fetch_file(name, _MAX_VOXEL_BYTES)
        if not path.is_file():
            made = MediumVoxels.of(self._supervised_medium(frame), lit)
            try:
                self.folder.write_file(name, made.write)
            except OSError as error:
                raise DataError(f"cannot write the voxels of {frame.path} to {path}: {error}") from error
            return made
        try:
            return MediumVoxels.read(path)
        except DataError as error:
            raise DataError(f"{error}; delete it to read the frame again") from error

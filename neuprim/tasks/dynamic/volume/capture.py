"""Render a volume sequence (smoke, fire) from cameras around its unit box; write images and points of every frame.

KEY is a hash of all inputs of the images.

volumes/KEY/scene.json                 inputs of the images, and the map from the files' world to scene units
volumes/KEY/frame_00012/cam_07.exr     linear RGB radiance and alpha, premultiplied, half floats
volumes/KEY/frame_00012/points.npz     points in the frame's matter, for starting points
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data.dataset import ChannelRange, DatasetImages
from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.exr import write_exr
from neuprim.core.io.files import write_json
from neuprim.core.io.store import Store
from neuprim.core.io.vdb import VdbFrame
from neuprim.core.volumes.density_truth import (
    DensityGridPlacement,
    GridExtent,
)
from neuprim.tasks.dynamic.volume.lit_medium import LitMedium, build_medium, draw_lights
from neuprim.tasks.dynamic.volume.medium import Medium
from neuprim.tasks.dynamic.volume.motion import VelocityGrid, sample_vdb_frame
from neuprim.tasks.dynamic.volume.optics import DATA_DEPENDENT, UP_AXES, Light, Optics
from neuprim.tasks.dynamic.volume.survey import CaptureNormalisation, GridReader

RENDERER_VERSION = 3
"""Version of the renderer, a part of the cache's key. Raise the version with every change to the ray marching, the
optics, the cameras or the files' layout."""

POINTS = 8192
"""Starting points stored per frame."""

LAST_FILE = "points.npz"
"""The last file that is written for a frame; its presence marks the frame as complete."""

_SCENE_FILE = "scene.json"
_POINTS_BYTES = 2 * POINTS * 3 * 4 + 2**16


@dataclass(frozen=True)
class Capture:
    """A volume sequence, with all inputs that its images depend on.

    Attributes:
        frames: the .vdb files, in order.
        cameras: training cameras, then ``held_out`` test cameras.
        samples: rays per pixel along each axis of the image.
        lights: number of lights per frame. If there are several, each training camera sees one of these lights; test
            cameras see other lights.
        bounds: (2, 3) box around all matter, scene units.
        ends: numbers of the frames with time 0 and 1; None for the first and the last frame.
        measured: frame number -> extent of its extinction grid; empty if unknown.
        channels: names of the grids that models learn besides the look -> range of their values.
        velocity: name of the grid of velocities with which primitives start; None if there is none.
    """

    frames: Sequence[VdbFrame]
    reader: GridReader
    optics: Optics
    cameras: Sequence[Camera]
    samples: int
    normalisation: CaptureNormalisation
    bounds: np.ndarray
    lights: int = 1
    held_out: int = 0
    ends: tuple[int, int] | None = None
    measured: Mapping[int, GridExtent] = field(default_factory=dict)
    channels: Mapping[str, ChannelRange] = field(default_factory=dict)
    velocity: str | None = None

    @property
    def components(self) -> tuple[str, ...]:
        """Meanings of the grids whose share of the extinction a model stores.

        This is the extinction grid if flames add to the extinction; otherwise, there is none.
        """
        return (self.reader.extinction,) if self.optics.mixes(self.reader.names) else ()

    @property
    def clock(self) -> tuple[int, int]:
        """Numbers of the frames with time 0 and 1."""
        return self.ends or (self.frames[0].number, self.frames[-1].number)

    def time(self, frame: VdbFrame) -> float:
        """Return a frame's time 0..1. Time is linear in the frame number, so missing numbers are gaps in time."""
        first, last = self.clock
        return (frame.number - first) / max(last - first, 1)

    def select_frames(self, first: int, last: int) -> Capture:
        """Return a capture of only the frames numbered ``first`` to ``last``. Frames keep their times."""
        return replace(self, frames=[frame for frame in self.frames if first <= frame.number <= last], ends=self.clock)

    def key(self) -> str:
        """Return a short hash of all inputs; files are identified by path, size and modification time."""
        stats = [(f.number, str(f.path), f.path.stat().st_size, f.path.stat().st_mtime_ns) for f in self.frames]
        cameras = [(c.viewmat.tolist(), c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in self.cameras]
        optics, names, normalisation = asdict(self.optics), dict(self.reader.names), asdict(self.normalisation)
        parts = [RENDERER_VERSION, stats, optics, names, cameras, self.samples, normalisation, self.lights]
        return hashlib.sha256(json.dumps(parts, default=_encode_capture_value).encode()).hexdigest()[:16]

    def frame_lights(self, frame: VdbFrame) -> list[Light | None]:
        """Return the light of each camera in a frame; if :attr:`lights` is 1, it is the light of the optics.

        If there are several lights, the first is the light of the optics and the others are random. The lights of test
        cameras are random, but the same in all frames.
        """
        if self.lights == 1:
            return [self.optics.light] * len(self.cameras)
        lights = [self.optics.light, *draw_lights(self.optics, self.lights - 1, frame.number)]
        training = len(self.cameras) - self.held_out
        return [lights[c % self.lights] for c in range(training)] + draw_lights(self.optics, self.held_out)

    def medium(self, frame: VdbFrame) -> Medium:
        """Build the medium of a frame, without the optics' light; empty if no grid of the file absorbs."""
        grids = self.reader.read(frame.path)
        if self.reader.extinction not in grids and not (self.components and self.optics.flame_grid in grids):
            return Medium.without_voxels()
        optics = replace(self.optics, extinction_grids=(self.reader.extinction,))
        try:
            return build_medium(grids, optics, self.normalisation.matrix())
        except DataError as error:
            raise DataError(f"{frame.path}: {error}") from error

    def read_channels(self, frame: VdbFrame, points: np.ndarray) -> dict[str, np.ndarray]:
        """Return name -> (M, C) float32 values of each channel at ``points`` (M, 3), scene units.

        Values are trilinear between voxels, and the grid's background where it stores none; 0 if the file has no such
        grid. Raises DataError if the file is damaged.
        """
        found = {name: np.zeros((len(points), own.width), np.float32) for name, own in self.channels.items()}
        return found | sample_vdb_frame(frame, self.channels, self._world_points(points))

    def _world_points(self, points: np.ndarray) -> np.ndarray:
        back = np.linalg.inv(self.normalisation.matrix())
        world: np.ndarray = points @ back[:3, :3].T + back[:3, 3]
        return world

    def read_velocities(self, grid: VelocityGrid, frame: VdbFrame, points: torch.Tensor) -> torch.Tensor:
        """Return (M, 3) float32 velocities of a frame at ``points`` (M, 3), scene units per unit of time."""
        matrix, (first, last) = self.normalisation.matrix(), self.clock
        found = grid.sample(frame, self._world_points(points.double().numpy()))
        return torch.from_numpy(found @ matrix[:3, :3].T * max(last - first, 1)).float()

    def placement(self) -> DensityGridPlacement:
        """Return the scene's position in the world of its .vdb files, with frame numbers, times and grid names."""
        optics, names = self.optics, self.reader.names
        flames_absorb = optics.flame_extinction > 0 and optics.flame_grid in names
        return DensityGridPlacement(
            self.normalisation.matrix(),
            [frame.number for frame in self.frames],
            {"time": [self.time(frame) for frame in self.frames]},
            optics.extinction or 1.0,
            names[self.reader.extinction],
            exact=not flames_absorb and optics.extinction > 0,
            component=self.reader.extinction,
            extents=[self.measured[frame.number] for frame in self.frames] if self.measured else (),
        )

    def frame_folder(self, frame: VdbFrame) -> str:
        """Return the name of the folder with a frame's images and points."""
        return f"frame_{frame.number:05d}"

    def fetch_image(self, store: Store, frame: VdbFrame, camera: int) -> Path:
        """Return the local path of a frame's image from one camera; raises DataError if the store cannot be read."""
        pixels = self.cameras[camera].width * self.cameras[camera].height
        return store.fetch_file(f"{self.frame_folder(frame)}/cam_{camera:02d}.exr", pixels * 4 * 4 + 2**16)

    def fetch_points(self, store: Store, frame: VdbFrame) -> Path:
        """Return the local path of a frame's ``points.npz``.

        The file has the ``means`` (M, 3), scene units, and ``colors`` (M, 3), linear radiance, of M points. The file
        also has three numbers: the total extinction ``weight``, the largest extinction ``largest``, and the largest
        radiance in the frame's images, ``brightest``.
        """
        return store.fetch_file(f"{self.frame_folder(frame)}/{LAST_FILE}", _POINTS_BYTES)

    def describe(self) -> dict[str, Any]:
        """Return the content of ``scene.json`` as JSON values."""
        return {
            "renderer_version": RENDERER_VERSION,
            "frames": [{"number": f.number, "file": str(f.path)} for f in self.frames],
            "grids": dict(self.reader.names),
            "look": json.loads(json.dumps(asdict(self.optics), default=_encode_capture_value)),
            "cameras": len(self.cameras),
            "lights": self.lights,
            "size": [self.cameras[0].width, self.cameras[0].height],
            "samples": self.samples,
            "normalisation": asdict(self.normalisation),
        }

    def render(self, frame: VdbFrame, folder: Path) -> None:
        """Render a frame from all cameras; write its images and points into a folder.

        Raises:
            DataError: the frame's file cannot be read, or a radiance is too large for half floats.
            OSError: a file cannot be written.
        """
        medium = self.medium(frame)
        lights = self.frame_lights(frame)
        largest = np.float32(medium.values[..., 0].max(initial=0.0))
        points: dict[str, Any] = {}
        brightest = 0.0
        for light in dict.fromkeys(lights):  # one lit medium at a time is in memory
            lit = LitMedium.of(medium, light, self.optics)
            points = points or _sample_medium_points(lit.mean, frame.number)
            for c in (c for c, own in enumerate(lights) if own == light):
                rgba = lit.render(self.cameras[c], self.samples)
                exact = float(rgba.numpy()[..., :3].max())  # numpy: torch leaves OpenMP threads spinning
                peak = float(torch.tensor(exact).half())  # as stored: values that half floats round to 0 are no light
                if not np.isfinite(peak):
                    found = f"a radiance of {exact:.3g} does not fit the images' half floats"
                    settings = "scene.optics.emission, scene.optics.ambient or scene.optics.light"
                    raise DataError(f"{frame.path}: {found}; expected at most 65504; lower {settings}")
                brightest = max(brightest, peak)
                write_exr(folder / f"cam_{c:02d}.exr", rgba, half=True)
        np.savez(folder / LAST_FILE, brightest=np.float32(brightest), largest=largest, **points)


def _sample_medium_points(medium: Medium, seed: int) -> dict[str, Any]:
    """Draw starting points in a medium, in proportion to the extinction, jittered inside their voxels.

    Return "means" (M, 3), scene units, "colors" (M, 3), radiance, and "weight", the integral of the extinction.
    """
    generator = np.random.default_rng(seed)
    sigma = medium.bricks.without_shared(medium.values[..., 0])
    total = float(sigma.sum(dtype=np.float64))
    if total <= 0:
        return {"means": np.zeros((0, 3), np.float32), "colors": np.zeros((0, 3), np.float32), "weight": np.float64(0)}
    cumulative = np.cumsum(sigma.ravel(), dtype=np.float64)
    flat = np.searchsorted(cumulative, generator.random(POINTS) * cumulative[-1], side="right").clip(max=sigma.size - 1)
    chosen = np.unravel_index(flat, sigma.shape)
    values = medium.values[chosen]
    jittered = medium.bricks.index(chosen) + generator.random((POINTS, 3)) - 0.5
    means = jittered @ medium.scene_from_index[:3, :3].T + medium.scene_from_index[:3, 3]
    colors = values[:, 1:] / np.maximum(values[:, :1], 1e-12)
    cell = abs(float(np.linalg.det(medium.scene_from_index[:3, :3])))
    return {"means": means.astype(np.float32), "colors": colors.astype(np.float32), "weight": np.float64(total * cell)}


def _encode_capture_value(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


# ---------------------------------------------------------------- rendering all frames


class CapturedVdbFrames(DatasetImages):
    """Ground truth of a volume sequence: every frame from every camera, rendered when missing.

    A frame's folder appears only when all files of the frame are written. An interrupted run therefore continues with
    the missing frames. If two runs render the same frame, the files of the first run remain.

    Args:
        store: the store of ground truth; the images are in the store's folder ``volumes/KEY``.
    """

    def __init__(self, capture: Capture, store: Store) -> None:
        self.capture = capture
        self.frames = [capture.frame_folder(frame) for frame in capture.frames]
        self.known = {
            "normalisation": asdict(capture.normalisation),
            "bounds": capture.bounds.tolist(),
            "look": {key: getattr(capture.optics, key) for key in DATA_DEPENDENT},
            "grids": dict(capture.reader.names),
            "samples": capture.samples,
        }
        self._root = store

    @cached_property
    def key(self) -> str:  # type: ignore[override]
        return self.capture.key()

    @cached_property
    def store(self) -> Store:
        return self._root.at("volumes", self.key)

    @property
    def place(self) -> str:  # type: ignore[override]
        return self.store.address

    def missing(self) -> list[int]:
        complete = self.store.complete_folders(LAST_FILE)
        return [i for i, name in enumerate(self.frames) if name not in complete]

    def begin(self) -> None:
        with _describe_capture_write_errors(self.store):
            self.store.prepare()

    def make(self, frame: int, tell: Callable[[str], None] = warn_once) -> None:
        if not self.store.has_file(f"{self.frames[frame]}/{LAST_FILE}"):
            self.write(frame, tell)

    def write(self, frame: int, tell: Callable[[str], None] = warn_once) -> None:
        """Render the frame with index ``frame`` and store it, unless the store already has it."""

        def render(folder: Path) -> None:
            self.capture.render(self.capture.frames[frame], folder)

        with _describe_capture_write_errors(self.store):
            self.store.retry(lambda: self.store.write_folder(self.frames[frame], render, LAST_FILE), tell)

    def complete(self) -> None:
        with _describe_capture_write_errors(self.store):
            if not self.store.has_file(_SCENE_FILE):
                self.store.write_file(_SCENE_FILE, lambda path: write_json(path, self.capture.describe()))

    def render_missing(self, progress: Callable[[str, float], None]) -> Store:
        """Render all missing frames in this process; return the store of the images.

        Raises:
            DataError: a .vdb file cannot be read, or the store cannot be written.
        """
        missing = self.missing()
        if missing:
            self.begin()
        text = f"rendering the ground truth: {len(self.frames)} frames, {len(self.capture.cameras)} cameras"
        for i in missing:
            progress(text, i / len(self.frames))
            self.make(i)
        self.complete()
        return self.store


@contextmanager
def _describe_capture_write_errors(store: Store) -> Iterator[None]:
    """Convert errors of writing files to a DataError that names the store."""
    try:
        yield
    except (OSError, DataError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        if not isinstance(cause, OSError) or (isinstance(error, DataError) and str(store.path) not in str(error)):
            raise
        why = cause.strerror or cause
        raise DataError(
            f"cannot write the rendered images to {store.address}: {why}; finished frames are kept"
        ) from error


# ---------------------------------------------------------------- cameras

_TEST_CAMERAS = (0.4, 0.75)
"""Positions of the two test cameras in the sequence of all cameras, which runs from the rim of the hemisphere (0) to
its pole (1). Both test cameras have neighbours on all sides, and they are 90 degrees apart."""

_DISTANCE = 2.7  # of cameras from the origin, the centre of the box, scene units (box sides)
_ELEVATIONS = (3.0, 80.0)  # degrees above the horizon of the lowest and the highest camera


def hemisphere_capture_cameras(
    size: int, cameras: int = 40, *, up: str = "z", field_of_view: float = 27.0
) -> tuple[list[Camera], list[Camera]]:
    """Return training cameras, then two test cameras, on a Fibonacci lattice over the hemisphere above the unit box.

    Args:
        size: edge of the square images in pixels.
        cameras: total number of cameras, at least 4.
        up: upward axis, 'y' or 'z'.
        field_of_view: full angle, degrees.
    """
    low, high = (math.sin(math.radians(e)) for e in _ELEVATIONS)
    focal = 0.5 * size / math.tan(math.radians(field_of_view) / 2)
    axis = torch.tensor(UP_AXES[up], dtype=torch.float64)
    views = []
    for n in range(cameras):
        height = low + (high - low) * n / (cameras - 1)
        angle = n * math.pi * (3.0 - math.sqrt(5.0))
        around = math.sqrt(1.0 - height * height)
        a, b = around * math.cos(angle), around * math.sin(angle)
        eye = torch.tensor([a, b, height] if up == "z" else [b, height, a], dtype=torch.float64) * _DISTANCE
        viewmat = look_at(eye, torch.zeros(3, dtype=torch.float64), axis)
        views.append(Camera(viewmat, focal, focal, size / 2, size / 2, size, size))
    held_out = {int(cameras * part) for part in _TEST_CAMERAS}
    return [v for n, v in enumerate(views) if n not in held_out], [v for n, v in enumerate(views) if n in held_out]


def choose_rays_per_pixel(camera: Camera, voxel: float) -> int:
    """Return the rays per pixel along each axis: 1 if pixels at the box's centre are narrower than a voxel, else 2.

    ``voxel`` is the edge of a voxel in scene units. One ray is enough for such narrow pixels: images with one ray have
    a PSNR of 67 to 72 dB against many rays (`smoke_fire` at 160×160), and take a third of the time of 2 x 2 rays.
    """
    return 1 if _DISTANCE / camera.fx < voxel else 2

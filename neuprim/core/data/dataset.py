"""Data sets: posed images that load on demand, starting points for primitives, and points with ground truth."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neuprim.core.cameras import Camera, look_at, orbit
from neuprim.core.cameras.world import World
from neuprim.core.compute import device as hardware
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.errors import ConfigError, warn_once
from neuprim.core.model.fields import Conditions

if TYPE_CHECKING:
    from neuprim.core.volumes.density_truth import DensityGridPlacement

DataSource = Literal["real", "generated", "simulated"]
"""Origin of a data set: photographs or captures ("real"), ray-cast scenes of neuprim ("generated"), or simulated data
in place of data that were not available ("simulated")."""


@exact_kernel
def _composite_pixels(rgb, alpha, out, background):  # type: ignore[no-untyped-def]
    for i in range(rgb.shape[0]):
        uncovered = np.float32(1) - alpha[i, 0]
        for c in range(rgb.shape[1]):
            out[i, c] = rgb[i, c] + uncovered * background[c]


Correction = Literal["pose", "offset", "factor"]
"""Correction that training learns for an uncertain input: a camera's pose, an offset added to a position (scene units),
or a factor on a value."""


@dataclass(frozen=True)
class View:
    """A view without its pixels: name, camera and conditions (further inputs of the image, such as the time)."""

    name: str  # unique within its split; used for file names and reports
    camera: Camera
    conditions: Conditions = field(default_factory=dict)  # other inputs of the image: time, light, ...


@dataclass(frozen=True)
class Pixels:
    """The pixels of a view."""

    rgb: Tensor  # (H, W, C) float32 colours, premultiplied if there is alpha
    alpha: Tensor | None = None  # (H, W) float32 coverage 0..1, or None for an opaque photograph
    mask: Tensor | None = None  # (H, W) bool: True for pixels that count; None if all pixels count

    def to(self, device: torch.device) -> Pixels:
        """Return a copy of the pixels on another device; the copy may be asynchronous."""
        alpha, mask = (None if x is None else hardware.copy_to_device(x, device) for x in (self.alpha, self.mask))
        return Pixels(hardware.copy_to_device(self.rgb, device), alpha, mask)

    def strided(self, step: int, column: int, row: int) -> Pixels:
        """Return every ``step``-th pixel in x and y, from (``column``, ``row``) on."""
        chosen = slice(row, None, step), slice(column, None, step)
        alpha, mask = (None if x is None else x[chosen].contiguous() for x in (self.alpha, self.mask))
        return Pixels(self.rgb[chosen].contiguous(), alpha, mask)

    def over(self, background: Tensor) -> Tensor:
        """Return the (H, W, C) image, composited over a (C,) colour; images without alpha are returned unchanged."""
        rgb, alpha = self.rgb, self.alpha  # in this order: stored images convert both at once
        if alpha is None:
            return rgb
        if not hardware.on_numba(rgb, alpha):
            return torch.addcmul(rgb, (1.0 - alpha)[..., None], background.to(rgb))
        out = torch.empty(rgb.shape, dtype=rgb.dtype)
        flat = [x.contiguous().reshape(alpha.numel(), -1).numpy() for x in (rgb, alpha, out)]
        _composite_pixels(*flat, background.to(rgb).numpy())
        return out


class ViewSet(ABC):
    """The posed images of one split; base class for your own views. ``len(views)`` is the number of views."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def view(self, index: int) -> View:
        """Return a view without its pixels."""

    @abstractmethod
    def pixels(self, index: int) -> Pixels:
        """Return the pixels of a view; reads them on demand and may cache them."""


class ViewSubset(ViewSet):
    """The views at ``indices`` of another view set, in the order of ``indices``. The other set caches the pixels."""

    def __init__(self, views: ViewSet, indices: Sequence[int]) -> None:
        self._views, self._indices = views, list(indices)

    def __len__(self) -> int:
        return len(self._indices)

    def view(self, index: int) -> View:
        return self._views.view(self._indices[index])

    def pixels(self, index: int) -> Pixels:
        return self._views.pixels(self._indices[index])

    def source(self, index: int) -> tuple[ViewSet, int]:
        """Return the view set that this subset selects from, and the index of the view in that set."""
        return self._views, self._indices[index]


@dataclass(frozen=True)
class PointCloud:
    """Points where training may place its first primitives (ellipsoids), perhaps with sizes and opacities."""

    means: Tensor  # (N, 3) positions, scene units; float64 world units before within() converts them
    colors: Tensor  # (N, C) in the data set's colour space
    conditions: Mapping[str, Tensor] = field(default_factory=dict)  # "time" -> (N,), at which points were observed
    axes: Tensor | None = None  # (N, 3) semi-axes of ellipsoids
    quats: Tensor | None = None  # (N, 4) rotations wxyz of the ellipsoids
    alphas: Tensor | None = None  # (N,) opacities 0..1 at the centres
    deviations: Tensor | None = None  # (N, 3) standard deviations of Gaussians, instead of axes
    steps: Mapping[str, float] = field(default_factory=dict)  # condition, e.g. "time" -> its step from frame to frame
    velocities: Tensor | None = None  # (N, 3) scene units per unit of the condition "time"

    def rows(self, index: Tensor) -> PointCloud:
        """Return the points that ``index`` selects: (M,) int64 row numbers, or an (N,) bool mask."""
        names = ("means", "colors", "axes", "quats", "alphas", "deviations", "velocities")
        values = {name: getattr(self, name) for name in names}
        chosen = {name: value[index] for name, value in values.items() if value is not None}
        return replace(self, **chosen, conditions={n: value[index] for n, value in self.conditions.items()})

    def within(self, world: World) -> PointCloud:
        """Return the points converted from world to scene coordinates: computed in float64, returned as float32."""
        means = world.scene_points(self.means).float()
        scale, quats = world.scale, self.quats
        axes, deviations = (x if x is None or scale == 1.0 else x * scale for x in (self.axes, self.deviations))
        if quats is not None and world.rotation is not None:
            given = Rotation.from_quat(quats[:, [1, 2, 3, 0]].double().numpy())
            turned = Rotation.from_matrix(world.rotation.numpy()) * given
            quats = torch.from_numpy(turned.as_quat()[:, [3, 0, 1, 2]]).float()
        return replace(self, means=means, axes=axes, deviations=deviations, quats=quats)


@dataclass(frozen=True)
class Clip:
    """A video that shows views of a view set in a given order."""

    name: str
    views: Sequence[int]  # indices into source, in the order of the film
    fps: float = 12.0  # frames per second
    source: ViewSet | None = None  # view set that indices refer to; None for the test split


StartingPoints = Callable[[ViewSet, int, torch.Generator], PointCloud]
"""Function (training views, count, generator) -> at most ``count`` distinct points; random numbers come from the
generator alone."""


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """The data of a scene to train on: views, starting points and properties. Subclassing raises TypeError."""

    name: str  # shown in reports
    train: ViewSet  # training views
    test: ViewSet  # held-out views
    start: StartingPoints  # function that returns the starting points
    extent: float  # size of the scene in scene units (camera_extent), the unit of learning rates and size limits
    background: Tensor  # (C,) colour that evaluation composites over
    channels: int = 3  # C, channels of the images
    color_space: Literal["srgb", "linear"] = "srgb"  # colour space of the images; "srgb" as stored in PNG
    data_source: DataSource = "real"  # origin of the data, for reports
    random_background: bool = False  # whether training composites random colours (needs alpha)
    downsampling: str = "none"  # how images were reduced, for reports: "images_4", "200x200 from 800x800 by area"
    up: Tensor = field(default_factory=lambda: torch.tensor([0.0, 0.0, 1.0]))  # (3,) upward direction, for orbits
    center: Tensor = field(default_factory=lambda: torch.zeros(3))  # (3,) point that the cameras look at, for orbits
    bounds: Tensor | None = None  # (2, 3) lower and upper corner of a box around everything, scene units, if known
    exposure: float = 1.0  # number by which the linear values of the files were divided
    world: World = field(default_factory=World)  # transform between the scene and the user's files
    placement: DensityGridPlacement | None = None  # placement of the scene's voxel files, if it has any
    largest: float | None = None  # largest extinction, 1/scene unit, if known; primitives stay below it
    points: PointSupervision | None = None  # points with ground truth, for train.supervision=voxels and both
    # inputs of training views that are uncertain and learned with the model: "camera", names of conditions
    refine: Mapping[str, Correction] = field(default_factory=dict)
    extra: object = None  # further data in a class of the task, e.g. pixel classes; tasks accept None

    def __init_subclass__(cls) -> None:
        raise TypeError(
            f"class {cls.__name__}(Dataset): Dataset cannot be subclassed. Call neuprim.core.data.Dataset(name=..., "
            "train=..., test=..., ...); the TaskSpec defines metrics, films and headers"
        )

    def initial_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """Return at most ``count`` distinct points where training starts primitives, found by :attr:`start`."""
        return self.start(self.train, count, generator)

    def uniform_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """Return ``count`` mid-grey points, uniform in :attr:`bounds`; raise ConfigError without bounds."""
        if self.bounds is None:
            found = f"data set {self.name} has no bounding box for the points"
            raise ConfigError(f"model.init.points=box: {found}; expected model.init.points=matter")
        low, high = self.bounds.float()
        means = low + torch.rand((count, 3), generator=generator) * (high - low)
        return PointCloud(means, torch.full((count, self.channels), 0.5))

    def orbit(self, frames: int) -> list[View]:
        """Return ``frames`` views on a circle around :attr:`center`, for a video.

        The circle has the mean distance and elevation of the training cameras. The views look outward if the training
        cameras do. Conditions that are one number run from their lowest to their highest training value; other
        conditions keep the value of the first view.
        """
        cameras = [self.train.view(i).camera for i in range(len(self.train))]
        far = find_outliers(torch.stack([c.position for c in cameras]))
        cameras = [c for c, away in zip(cameras, far.tolist(), strict=True) if not away]
        offsets = torch.stack([c.position for c in cameras]) - self.center.double()
        radius = offsets.norm(dim=-1).mean().item()
        up = self.up.double() / self.up.double().norm()
        units = offsets / offsets.norm(dim=-1, keepdim=True).clamp_min(1e-30)
        forward = torch.stack([c.viewmat[2, :3] for c in cameras]).double()
        outward = bool((units * forward).sum(-1).mean() > -0.5)
        elevation = torch.asin(((forward if outward else units) @ up).mean().clamp(-0.9, 0.9)).item()
        if outward:
            circle = orbit(cameras[0], torch.zeros(3), self.up, 1.0, elevation, frames)
            eyes = [(self.center.double() + radius * c.position, c.position) for c in circle]
            views = [replace(cameras[0], viewmat=look_at(eye, eye + d, up)) for eye, d in eyes]
        else:
            views = orbit(cameras[0], self.center, self.up, radius, elevation, frames)
        scalars: dict[str, list[Tensor]] = {}
        for i in range(len(self.train)):
            for name, value in self.train.view(i).conditions.items():
                if value.numel() == 1:
                    scalars.setdefault(name, []).append(value)
        ranges = {name: torch.stack(v).aminmax(dim=0) for name, v in scalars.items()}
        found = []
        for i, camera in enumerate(views):
            share = i / max(frames - 1, 1)
            between = {name: r.min + share * (r.max - r.min) for name, r in ranges.items()}
            found.append(View(f"orbit_{i:03d}", camera, dict(self.train.view(0).conditions) | between))
        return found


@dataclass(frozen=True)
class PointSamples:
    """Ground-truth extinction and source radiance of a volume at M points of one frame."""

    name: str  # name of the frame, for logs
    conditions: Conditions  # conditions of the frame, shared by all points
    points: Tensor  # (M, 3) float32, scene units
    sigma: Tensor  # (M,) float32 extinction, 1/scene unit
    source: Tensor | None  # (M, C) float32 extinction times isotropic source radiance; None trains the extinction only
    sigma_scale: float  # typical sigma inside matter; the loss divides errors of sigma by it
    source_scale: float = 1.0  # typical source inside matter; the loss divides errors of source by it
    # name of a source grid -> the (M,) part of sigma that comes from this grid, and the typical value of this part;
    # name of a channel, after fields.CHANNEL -> (M, C) sigma times the values of the channel, and its typical value
    components: Mapping[str, tuple[Tensor, float]] = field(default_factory=dict)
    # (M, C) float32 extinction times the radiance that is scattered per irradiance of an unoccluded light; None trains
    # scattering on images only
    scattered: Tensor | None = None
    scattered_scale: float = 1.0  # typical ``scattered`` inside matter


class ChannelRange(NamedTuple):
    """Range of a channel (a grid besides the extinction) in all frames. Values that files do not store are 0."""

    largest: float  # largest absolute value
    width: int  # numbers per voxel, 1 or 3
    lowest: float  # smallest value, at most 0: the model's values are limited to it


class PointSupervision(ABC):
    """Base class of objects that draw points of a volume with ground truth, to train on points besides images."""

    components: tuple[str, ...] = ()  # names of the source grids in PointSamples.components
    channels: Mapping[str, ChannelRange] = MappingProxyType({})  # by the channel's name

    @abstractmethod
    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        """Draw ``count`` points, with ground truth, of one frame; random numbers come from ``generator`` alone."""


def hold_out_views(dataset: Dataset, every: int) -> Dataset:
    """Return the data set with one of every ``every`` training views moved to a new test split.

    One view of each group of ``every`` consecutive views is moved. The position of this view in its group advances by
    one from group to group, so that every time step of a multi-camera sequence keeps some training cameras. The old
    test split is dropped. Raises ConfigError if ``every`` < 2, or if there are fewer than two training views.
    """
    count = len(dataset.train)
    if every < 2 or count < 2:
        found = f"cannot hold out 1 of every {every} views from {count} training views"
        raise ConfigError(f"{dataset.name}: {found}; expected at least 2 views, and 1 of every 2 or more")
    test = [i for i in range(count) if i % every == i // every % every]
    train = [i for i in range(count) if i % every != i // every % every]
    return replace(dataset, train=ViewSubset(dataset.train, train), test=ViewSubset(dataset.train, test))


class DatasetImages(ABC):
    """Base class of the images of a data set that neuprim renders itself, frame by frame, in one or more processes."""

    frames: Sequence[str]  # names of the frames, in order
    key: str  # hash of everything the images depend on; all processes must agree on it
    place: str  # folder or URL of the images
    known: Mapping[str, Any]  # results for other processes, so that these need not compute them; see SceneSpec.truth

    @abstractmethod
    def missing(self) -> list[int]:
        """Return the indices of the frames that have no images yet, in order."""

    @abstractmethod
    def begin(self) -> None:
        """Prepare the folder or URL :attr:`place`, before the first frame is rendered."""

    @abstractmethod
    def make(self, frame: int, tell: Callable[[str], None]) -> None:
        """Render and write the images of a frame unless they exist. Writes are atomic, so processes may overlap.

        Raises DataError if the source cannot be read or :attr:`place` cannot be written.

        Args:
            frame: index of the frame.
            tell: function to call with a line of text while :attr:`place` is unavailable.
        """

    @abstractmethod
    def complete(self) -> None:
        """Finish the data set; called when all frames exist."""


@dataclass(frozen=True)
class SceneContext:
    """Input of the function that loads a scene, besides the settings of the scene."""

    seed: int  # seed for generated scenes
    cache_dir: Path  # folder for generated data; a scene stores them under a key of all they depend on
    progress: Callable[[str, float], None] = lambda text, fraction: None  # to call with (text, fraction 0..1)
    world: World | None = None  # transform of the model that the scene is loaded for; None lets the scene choose


def camera_extent(cameras: Sequence[Camera]) -> float:
    """Return 1.1 times the largest distance of a camera from the mean camera centre; 1.0 if the distance is 0.

    Cameras far from all others (:func:`find_outliers`) are ignored.
    """
    positions = torch.stack([c.position.detach().double() for c in cameras])
    positions = positions[~find_outliers(positions)]
    radius = (positions - positions.mean(0)).norm(dim=-1).max().item() * 1.1
    return radius if radius > 0 else 1.0


_OUTLYING = 100.0  # in median distances
_OUTLYING_SHARE = 0.05


def find_outliers(positions: Tensor) -> Tensor:
    """Return (N,) bool: which of the camera centres ``positions`` (N, 3) are outliers.

    Distances are measured from the median of the centres. A centre is an outlier if its distance is more than 100 times
    the median distance. If this holds for more than max(1, N/20) centres, there are no outliers.
    """
    distance = (positions - positions.median(0).values).norm(dim=-1)
    far = (distance > _OUTLYING * distance.median()) & (distance.median() > 0)
    return far if int(far.sum()) <= max(1, _OUTLYING_SHARE * len(far)) else torch.zeros_like(far)


def dataset_focus_point(cameras: Sequence[Camera]) -> Tensor:
    """Return the (3,) float64 point with the least mean squared distance from the cameras' optical axes.

    A weak penalty pulls the point towards the position in front of the mean camera at the distance
    :func:`camera_extent`, so that there is a solution even if all axes are parallel.
    """
    positions, forward = _dataset_optical_axes(cameras)
    eye = torch.eye(3, dtype=torch.float64)
    planes = eye - forward[:, :, None] * forward[:, None, :]
    pull = 1e-4 * len(positions)
    target = positions.mean(0) + forward.mean(0) * camera_extent(cameras)
    right = (planes @ positions[:, :, None]).sum(0)[:, 0] + pull * target
    return torch.linalg.solve(planes.sum(0) + pull * eye, right)


def dataset_axes_meet(cameras: Sequence[Camera]) -> bool:
    """Return whether the cameras look at a common point.

    The common point is :func:`dataset_focus_point`. The RMS distance of the optical axes from this point must be below
    half the RMS distance of the cameras from their mean. The point must be in front of at least 9 of 10 cameras.
    Parallel axes, rings of cameras that look outward, and cameras at one position (tripods) have no common point.
    """
    positions, forward = _dataset_optical_axes(cameras)
    offsets = dataset_focus_point(cameras) - positions
    depths = (offsets * forward).sum(-1)
    miss = (offsets - depths[:, None] * forward).square().sum(-1).mean()
    spread = (positions - positions.mean(0)).square().sum(-1).mean()
    turned = 1.0 - torch.linalg.eigvalsh(forward.T @ forward / len(forward))[-1]  # 0 where all axes are parallel
    return bool((miss < 0.25 * spread) & (turned > 1e-3) & ((depths > 0).double().mean() >= 0.9))


def _dataset_optical_axes(cameras: Sequence[Camera]) -> tuple[Tensor, Tensor]:
    """Return (N, 3) centres and (N, 3) viewing directions of all cameras except outliers; float64."""
    positions = torch.stack([c.position.detach().double() for c in cameras])
    forward = torch.stack([c.viewmat[2, :3].detach().double() for c in cameras])
    usual = ~find_outliers(positions)
    return positions[usual], forward[usual]


FAR = 100.0  # camera extents from the origin, beyond which a scene is moved: float32 holds five digits of it there


def choose_dataset_world(cameras: Sequence[Camera], where: str = "cameras") -> World:
    """Choose the transform between the coordinates of a file (world) and of the scene: identity, or an offset.

    An extent is the :func:`camera_extent`. If the mean camera centre is farther than :data:`FAR` extents from the
    origin, the mean centre becomes the scene's origin, rounded to multiples of a power of ten between one and ten
    extents. Other scenes keep their coordinates exactly. ``where`` names the file in warnings.
    """
    views = [c.viewmat.detach().double() for c in cameras]
    # solved, not transposed: far from the origin a transpose turns the rounding of a file's rotations into metres
    centers = torch.stack([-torch.linalg.solve(v[:3, :3], v[:3, 3]) for v in views])
    far = find_outliers(centers)
    if far.any():
        row = int(far.nonzero()[0])
        place = ", ".join(f"{x + 0.0:.6g}" for x in centers[row].tolist())
        found = f"{int(far.sum())} of {len(views)} cameras lie far from all others, the first at {place}"
        warn_once(f"{where}: {found}; the size of the scene is computed without these cameras")
    center = centers[~far].mean(0)
    there = World.at(center.tolist())
    extent = camera_extent([there.scene_camera(c) for c in cameras])
    if float(center.norm()) <= FAR * extent:
        return World()
    digits = -math.ceil(math.log10(extent))
    return World.at([round(x, digits) + 0.0 for x in center.tolist()])

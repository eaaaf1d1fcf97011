"""Data sets: posed images that load on demand, starting points, and points to learn from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neuprim.core.cameras import Camera, look_at, orbit
from neuprim.core.cameras.world import World
from neuprim.core.compute import device as hardware
from neuprim.core.compute.device import HOST
from neuprim.core.data.scene_frame import find_outliers
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import Conditions

if TYPE_CHECKING:
    from neuprim.core.volumes.density_truth import DensityGridPlacement

DataSource = Literal["real", "generated", "simulated"]
"""Photographs or captures ("real"), our own ray-cast scenes ("generated"), stand-ins for data not given
("simulated")."""


@dataclass(frozen=True)
class View:
    """One frame without its pixels."""

    name: str  # unique within its split; used for file names and reports
    camera: Camera
    conditions: Conditions = field(default_factory=dict)  # what else it depends on: time, light, ...


@dataclass(frozen=True)
class Pixels:
    """One frame's pixels."""

    rgb: Tensor  # (H, W, C) float32; with alpha it is premultiplied
    alpha: Tensor | None = None  # (H, W) float32 coverage 0..1, or None for an opaque photograph
    mask: Tensor | None = None  # (H, W) bool of pixels that count, or None for all

    def to(self, device: torch.device) -> Pixels:
        """Copy to another device without waiting for it."""
        alpha, mask = (None if x is None else hardware.copy_to_device(x, device) for x in (self.alpha, self.mask))
        return Pixels(hardware.copy_to_device(self.rgb, device), alpha, mask)

    def over(self, background: Tensor) -> Tensor:
        """Composite over a (C,) colour: (H, W, C). Opaque pixels are returned unchanged."""
        if self.alpha is None:
            return self.rgb
        uncovered, channels = (1.0 - self.alpha).reshape(-1), self.rgb.shape[-1]
        return torch.addr(self.rgb.reshape(-1, channels), uncovered, background.to(self.rgb)).reshape(self.rgb.shape)


class ViewSet(ABC):
    """Posed images of one split. ``pixels`` reads on demand and caches compact (uint8 or half) copies."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def view(self, index: int) -> View: ...

    @abstractmethod
    def pixels(self, index: int) -> Pixels: ...


class ViewSubset(ViewSet):
    """The views of another set at ``indices``, in that order. The other set caches their pixels."""

    def __init__(self, views: ViewSet, indices: Sequence[int]) -> None:
        self._views, self._indices = views, list(indices)

    def __len__(self) -> int:
        return len(self._indices)

    def view(self, index: int) -> View:
        return self._views.view(self._indices[index])

    def pixels(self, index: int) -> Pixels:
        return self._views.pixels(self._indices[index])


@dataclass(frozen=True)
class PointCloud:
    """Points where matter probably is."""

    means: Tensor  # (N, 3) scene units; right after reading a file, float64 world units (see within)
    colors: Tensor  # (N, C) in the data set's colour space
    conditions: Mapping[str, Tensor] = field(default_factory=dict)  # (N,) values of observation, e.g. "time" -> 0..1
    axes: Tensor | None = None  # (N, 3) semi-axes of ellipsoids
    quats: Tensor | None = None  # (N, 4) their rotations wxyz
    alphas: Tensor | None = None  # (N,) opacities 0..1 at the centres
    deviations: Tensor | None = None  # (N, 3) standard deviations of Gaussians, instead of axes
    steps: Mapping[str, float] = field(default_factory=dict)  # condition -> distance of neighbouring frames, if known

    def rows(self, index: Tensor) -> PointCloud:
        """Select points by (M,) int64 or (N,) bool ``index``."""
        values = {name: getattr(self, name) for name in ("means", "colors", "axes", "quats", "alphas", "deviations")}
        chosen = {name: value[index] for name, value in values.items() if value is not None}
        return replace(self, **chosen, conditions={n: value[index] for n, value in self.conditions.items()})

    def within(self, world: World) -> PointCloud:
        """Convert world to scene coordinates; positions are subtracted in float64."""
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
    """Views that make a film in this order."""

    name: str
    views: Sequence[int]  # indices into source
    fps: float = 12.0
    source: ViewSet | None = None  # None for the test split


StartingPoints = Callable[[ViewSet, int, torch.Generator], PointCloud]
"""(training views, count, generator) -> at most ``count`` distinct starting points; the only randomness is the
generator's."""


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """A scene to fit. Create instances; subclasses are refused."""

    name: str  # shown in reports
    train: ViewSet
    test: ViewSet
    start: StartingPoints
    extent: float  # size in scene units (scene_frame.camera_extent), the unit of learning rates and size limits
    background: Tensor  # (C,) colour that evaluation composites over
    channels: int = 3
    color_space: Literal["srgb", "linear"] = "srgb"  # "srgb" as stored in PNG
    data_source: DataSource = "real"
    random_background: bool = False  # whether training composites random colours (needs alpha)
    downsampling: str = "none"  # for reports, e.g. "images_4" or "200x200 from 800x800 by area"
    up: Tensor = field(default_factory=lambda: torch.tensor([0.0, 0.0, 1.0]))  # (3,) for orbits
    center: Tensor = field(default_factory=lambda: torch.zeros(3))  # (3,) that the cameras look at, for orbits
    bounds: Tensor | None = None  # (2, 3) lower and upper corner of a box around everything, scene units, if known
    exposure: float = 1.0  # divisor that was applied to the linear values of the files
    world: World = field(default_factory=World)  # transform between the scene and the user's files
    placement: DensityGridPlacement | None = None  # the voxel files the scene was made from, if any
    largest: float | None = None  # largest extinction, 1/scene unit, if known; primitives stay below it
    points: PointSupervision | None = None  # for ``train.supervision=voxels`` and ``both``
    extra: object = None  # further knowledge in a class of the task, e.g. pixel classes; tasks accept None

    def __init_subclass__(cls) -> None:
        raise TypeError(
            f"class {cls.__name__}(Dataset): a data set is made by calling neuprim.core.data.Dataset(name=..., "
            "train=..., test=..., ...); metrics, films and headers are the task's"
        )

    def initial_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """Return at most ``count`` distinct starting points."""
        return self.start(self.train, count, generator)

    def uniform_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """Draw ``count`` mid-grey points, uniform in :attr:`bounds`; raise ConfigError without bounds."""
        if self.bounds is None:
            found = f"{self.name} does not say which box its matter fills"
            raise ConfigError(f"model.init.points=box: {found}; expected matter")
        low, high = self.bounds.float()
        means = low + torch.rand((count, 3), generator=generator) * (high - low)
        return PointCloud(means, torch.full((count, self.channels), 0.5))

    def orbit(self, frames: int) -> list[View]:
        """Make views on a circle at the mean distance and elevation of the training cameras.

        The views look outward where the training cameras do. Scalar conditions run from their least to their greatest
        training value; others keep the value of the first view.
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
    """True values at M points of one frame."""

    name: str  # of the frame, for logs
    conditions: Conditions  # of the frame, shared by all points
    points: Tensor  # (M, 3) float32, scene units
    sigma: Tensor  # (M,) float32 extinction, 1/scene unit
    source: Tensor | None  # (M, C) float32 extinction times isotropic source radiance; None trains the extinction only
    sigma_scale: float  # typical value inside matter, by which errors are divided
    source_scale: float = 1.0
    components: Mapping[str, tuple[Tensor, float]] = field(default_factory=dict)  # grid -> (M,) part of sigma, scale


class PointSupervision(ABC):
    """Points to learn from, see :attr:`Dataset.points`."""

    components: tuple[str, ...] = ()  # names of the source grids in PointSamples.components

    @abstractmethod
    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        """Draw ``count`` points of one frame; the only randomness is ``generator``."""


def hold_out_views(dataset: Dataset, every: int) -> Dataset:
    """Replace the test split by every ``every``-th training view, which is no longer trained on.

    The position within each group of ``every`` views advances by one from group to group. So no single moment of a
    multi-camera sequence is missing from all cameras. Raises ConfigError: ``every`` < 2, or fewer than two training
    views.
    """
    count = len(dataset.train)
    if every < 2 or count < 2:
        found = f"every {every}. of {count} training views held out"
        raise ConfigError(f"{dataset.name}: {found}; expected 2 or more of 2 views or more")
    test = [i for i in range(count) if i % every == i // every % every]
    train = [i for i in range(count) if i % every != i // every % every]
    return replace(dataset, train=ViewSubset(dataset.train, train), test=ViewSubset(dataset.train, test))


class DatasetImages(ABC):
    """Images of a scene that are rendered frame by frame, possibly by several processes."""

    frames: Sequence[str]  # names, in order
    key: str  # hash of everything the images depend on; all processes must agree on it
    place: str  # folder or URL of the images
    known: Mapping[str, Any]  # plain values that save other processes repeated work; passed to the scene's ``truth``

    @abstractmethod
    def missing(self) -> list[int]:
        """Return the indices of missing frames, in order."""

    @abstractmethod
    def begin(self) -> None:
        """Prepare the place, before the first frame is made."""

    @abstractmethod
    def make(self, frame: int, tell: Callable[[str], None]) -> None:
        """Make a frame unless it exists. Writes are atomic, so processes may overlap.

        Raises DataError: the source cannot be read, or the place cannot be written.

        Args:
            tell: receives a line while the place is unavailable.
        """

    @abstractmethod
    def complete(self) -> None:
        """Write what is due when all frames exist."""


@dataclass(frozen=True)
class SceneContext:
    """What a loader gets besides the settings of its scene."""

    seed: int  # for generated scenes
    cache_dir: Path  # for generated data, keyed by everything they depend on
    progress: Callable[[str, float], None] = lambda text, fraction: None  # of long work: text, fraction 0..1
    device: torch.device = HOST  # where ground truth may be computed; data sets are on the CPU
    world: World | None = None  # of the model that the scene is loaded for again; None lets the scene choose

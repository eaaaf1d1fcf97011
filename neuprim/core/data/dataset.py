"""Data sets: posed images that load on demand, starting points, and points to learn from.

A :class:`Dataset` only describes data. Metrics, films and headers are the task's
(:class:`~neuprim.core.task.TaskSpec`).
"""

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
    from neuprim.core.volumes.source import Placement

__all__ = [
    "Clip",
    "DataSource",
    "Dataset",
    "GroundTruth",
    "Pixels",
    "PointCloud",
    "PointSamples",
    "PointSupervision",
    "SceneContext",
    "ViewSubset",
    "StartingPoints",
    "View",
    "ViewSet",
    "hold_out_views",
]

DataSource = Literal["real", "generated", "simulated"]
"""Photographs or captures ("real"), our own ray-cast scenes ("generated"), stand-ins for data not given
("simulated")."""


@dataclass(frozen=True)
class View:
    """One frame without its pixels.

    Attributes:
        name: unique within its split; used for file names and reports.
        conditions: what the frame depends on besides its camera (time, light, ...); empty for static scenes.
    """

    name: str
    camera: Camera
    conditions: Conditions = field(default_factory=dict)


@dataclass(frozen=True)
class Pixels:
    """One frame's pixels.

    Attributes:
        rgb: (H, W, C) float32. With ``alpha`` it is premultiplied.
        alpha: (H, W) float32 coverage 0..1, or None for an opaque photograph.
        mask: (H, W) bool of pixels that count, or None for all.
    """

    rgb: Tensor
    alpha: Tensor | None = None
    mask: Tensor | None = None

    def to(self, device: torch.device) -> Pixels:
        """Copy to another device without waiting for it."""
        alpha, mask = (None if x is None else hardware.copy_from_host(x, device) for x in (self.alpha, self.mask))
        return Pixels(hardware.copy_from_host(self.rgb, device), alpha, mask)

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
    """Points where matter probably is.

    Attributes:
        means: (N, 3) scene units; right after reading a file, float64 world units (:meth:`within`).
        colors: (N, C) in the data set's colour space.
        conditions: name -> (N,) values under which the points were observed, e.g. "time" -> 0..1.
        axes, quats: (N, 3) semi-axes and (N, 4) rotations wxyz of ellipsoids.
        alphas: (N,) opacities 0..1 at the centres.
        deviations: (N, 3) standard deviations, instead of ``axes``, of Gaussians.
        steps: condition name -> distance of neighbouring frames, where it is known.
    """

    means: Tensor
    colors: Tensor
    conditions: Mapping[str, Tensor] = field(default_factory=dict)
    axes: Tensor | None = None
    quats: Tensor | None = None
    alphas: Tensor | None = None
    deviations: Tensor | None = None
    steps: Mapping[str, float] = field(default_factory=dict)

    def rows(self, index: Tensor) -> PointCloud:
        """Select points by (M,) int64 or (N,) bool ``index``."""
        axes, quats, alphas, deviations = (
            None if value is None else value[index] for value in (self.axes, self.quats, self.alphas, self.deviations)
        )
        found = {n: value[index] for n, value in self.conditions.items()}
        return PointCloud(self.means[index], self.colors[index], found, axes, quats, alphas, deviations, self.steps)

    def within(self, world: World) -> PointCloud:
        """Convert world to scene coordinates; positions are subtracted in float64."""
        means = world.scene_points(self.means).float()
        axes, deviations = (
            x if x is None or world.scale == 1.0 else x * world.scale for x in (self.axes, self.deviations)
        )
        quats = self.quats
        if quats is not None and world.rotation is not None:
            turned = Rotation.from_matrix(world.rotation.numpy()) * Rotation.from_quat(
                quats[:, [1, 2, 3, 0]].double().numpy()
            )
            quats = torch.from_numpy(turned.as_quat()[:, [3, 0, 1, 2]]).float()
        return replace(self, means=means, axes=axes, deviations=deviations, quats=quats)


@dataclass(frozen=True)
class Clip:
    """Views that make a film in this order.

    Attributes:
        views: indices into ``source``, or into the test split.
        source: views outside of the test split; None for the test split.
    """

    name: str
    views: Sequence[int]
    fps: float = 12.0
    source: ViewSet | None = None


StartingPoints = Callable[[ViewSet, int, torch.Generator], PointCloud]
"""(training views, count, generator) -> at most ``count`` distinct starting points; the only randomness is the
generator's."""


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """A scene to fit. Create instances; subclasses are refused.

    Attributes:
        name: shown in reports.
        train, test: the splits.
        start: rule for starting points, see :data:`StartingPoints`.
        extent: scene extent in scene units (:func:`~neuprim.core.data.scene_frame.camera_extent`), the unit of learning
            rates and size limits.
        background: (C,) colour that evaluation composites over.
        channels: number of colour channels C.
        color_space: "srgb" (as stored in PNG) or "linear".
        random_background: whether training composites random colours (needs alpha).
        downsampling: text for reports, e.g. "none", "images_4" or "200x200 from 800x800 by area".
        up: (3,) upward direction, for orbits.
        center: (3,) point that the cameras look at, for orbits.
        bounds: (2, 3) lower and upper corner of a box around everything, scene units, if known.
        exposure: divisor that was applied to the linear values of the files.
        world: transform between the scene and the user's files.
        placement: the voxel files the scene was made from, if any.
        largest: largest extinction in the scene, 1/scene unit, if known; primitives stay below it.
        points: points of known extinction and radiance, for ``train.supervision=voxels`` and ``both``.
        extra: further knowledge in a class of the task, e.g. pixel classes. Tasks accept None.
    """

    name: str
    train: ViewSet
    test: ViewSet
    start: StartingPoints
    extent: float
    background: Tensor
    channels: int = 3
    color_space: Literal["srgb", "linear"] = "srgb"
    data_source: DataSource = "real"
    random_background: bool = False
    downsampling: str = "none"
    up: Tensor = field(default_factory=lambda: torch.tensor([0.0, 0.0, 1.0]))
    center: Tensor = field(default_factory=lambda: torch.zeros(3))
    bounds: Tensor | None = None
    exposure: float = 1.0
    world: World = field(default_factory=World)
    placement: Placement | None = None
    largest: float | None = None
    points: PointSupervision | None = None
    extra: object = None

    def __init_subclass__(cls) -> None:
        raise TypeError(
            f"class {cls.__name__}(Dataset): a data set is made by calling neuprim.core.data.Dataset(name=..., "
            "train=..., test=..., ...); "
            "what a class of its own would judge, film or tell is the task's"
        )

    def initial_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """Return at most ``count`` distinct starting points."""
        return self.start(self.train, count, generator)

    def uniform_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """Draw ``count`` mid-grey points, uniform in :attr:`bounds`.

        Raises:
            ConfigError: the data set has no bounds.
        """
        if self.bounds is None:
            raise ConfigError(
                f"model.init.points=box: {self.name} does not say which box its matter fills; expected matter"
            )
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
        sine = ((forward if outward else units) @ up).mean().clamp(-0.9, 0.9)
        if outward:
            directions = [
                c.position for c in orbit(cameras[0], torch.zeros(3), self.up, 1.0, torch.asin(sine).item(), frames)
            ]
            eyes = [self.center.double() + radius * d for d in directions]
            views = [replace(cameras[0], viewmat=look_at(e, e + d, up)) for e, d in zip(eyes, directions, strict=True)]
        else:
            views = orbit(cameras[0], self.center, self.up, radius, torch.asin(sine).item(), frames)
        between = self._scalar_conditions()
        held = {name: value for name, value in self.train.view(0).conditions.items() if name not in between}
        return [
            View(
                f"orbit_{i:03d}",
                c,
                {**held, **{n: low + i / max(frames - 1, 1) * (high - low) for n, (low, high) in between.items()}},
            )
            for i, c in enumerate(views)
        ]

    def _scalar_conditions(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Least and greatest training value of each condition that is a single number."""
        found: dict[str, list[Tensor]] = {}
        for i in range(len(self.train)):
            for name, value in self.train.view(i).conditions.items():
                if value.numel() == 1:
                    found.setdefault(name, []).append(value)
        return {
            name: (torch.stack(values).min(0).values, torch.stack(values).max(0).values)
            for name, values in found.items()
        }


@dataclass(frozen=True)
class PointSamples:
    """True values at M points of one frame.

    Attributes:
        name: of the frame, for logs.
        conditions: of the frame, shared by all points.
        points: (M, 3) float32, scene units.
        sigma: (M,) float32 extinction, 1/scene unit.
        source: (M, C) float32 extinction times isotropic source radiance; None trains the extinction only.
        sigma_scale, source_scale: typical values inside matter, by which errors are divided.
        components: source grid name -> its (M,) part of ``sigma``, and the typical value.
    """

    name: str
    conditions: Conditions
    points: Tensor
    sigma: Tensor
    source: Tensor | None
    sigma_scale: float
    source_scale: float = 1.0
    components: Mapping[str, tuple[Tensor, float]] = field(default_factory=dict)


class PointSupervision(ABC):
    """Points to learn from, see :attr:`Dataset.points`.

    Attributes:
        components: names of the source grids in :attr:`PointSamples.components`.
    """

    components: tuple[str, ...] = ()

    @abstractmethod
    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        """Draw ``count`` points of one frame; the only randomness is ``generator``."""


def hold_out_views(dataset: Dataset, every: int) -> Dataset:
    """Replace the test split by every ``every``-th training view, which is no longer trained on.

    The position within each group of ``every`` views advances by one from group to group. So no single moment of a
    multi-camera sequence is missing from all cameras.

    Raises:
        ConfigError: ``every`` < 2, or fewer than two training views.
    """
    count = len(dataset.train)
    if every < 2 or count < 2:
        raise ConfigError(
            f"{dataset.name}: every {every}. of {count} training views held out; expected 2 or more of 2 views or more"
        )
    test = [i for i in range(count) if i % every == i // every % every]
    train = [i for i in range(count) if i % every != i // every % every]
    return replace(dataset, train=ViewSubset(dataset.train, train), test=ViewSubset(dataset.train, test))


class GroundTruth(ABC):
    """Images of a scene that are rendered frame by frame, possibly by several processes.

    Attributes:
        frames: names, in order.
        key: hash of everything the images depend on; all processes must agree on it.
        place: folder or URL of the images.
        known: plain values that save other processes repeated work; passed to the scene's ``truth``.
    """

    frames: Sequence[str]
    key: str
    place: str
    known: Mapping[str, Any]

    @abstractmethod
    def missing(self) -> list[int]:
        """Return the indices of missing frames, in order."""

    @abstractmethod
    def begin(self) -> None:
        """Prepare the place, before the first frame is made."""

    @abstractmethod
    def make(self, frame: int, tell: Callable[[str], None]) -> None:
        """Make a frame unless it exists. Writes are atomic, so processes may overlap.

        Args:
            tell: receives a line while the place is unavailable.

        Raises:
            DataError: the source cannot be read, or the place cannot be written.
        """

    @abstractmethod
    def complete(self) -> None:
        """Write what is due when all frames exist."""


@dataclass(frozen=True)
class SceneContext:
    """What a loader gets besides the settings of its scene.

    Attributes:
        seed: for generated scenes.
        cache_dir: for generated data, keyed by everything they depend on.
        progress: called with (text, fraction 0..1) during long work.
        device: where ground truth may be computed; data sets are on the CPU.
        world: of the model that the scene is loaded for again; None lets the scene choose.
    """

    seed: int
    cache_dir: Path
    progress: Callable[[str, float], None] = lambda text, fraction: None
    device: torch.device = HOST
    world: World | None = None

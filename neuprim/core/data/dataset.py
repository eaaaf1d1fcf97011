"""What a loader hands over: two sets of posed images that load lazily, what is known of them, and where matter may be
at the start.

A :class:`Dataset` describes and decides nothing: what a model is judged by, which films are made and what its file says
about the data is the task's, see :class:`~neuprim.core.task.TaskSpec`.
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
        """The same on another device; copies to a card do not wait for it."""
        alpha, mask = (None if x is None else hardware.copy_from_host(x, device) for x in (self.alpha, self.mask))
        return Pixels(hardware.copy_from_host(self.rgb, device), alpha, mask)

    def over(self, background: Tensor) -> Tensor:
        """(H, W, C) composited over a (C,) colour; opaque pixels are returned as they are."""
        if self.alpha is None:
            return self.rgb
        uncovered, channels = (1.0 - self.alpha).reshape(-1), self.rgb.shape[-1]
        return torch.addr(self.rgb.reshape(-1, channels), uncovered, background.to(self.rgb)).reshape(self.rgb.shape)


class ViewSet(ABC):
    """Posed images of one split. ``pixels`` reads on demand and keeps at most compact (uint8 or half) copies."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def view(self, index: int) -> View: ...

    @abstractmethod
    def pixels(self, index: int) -> Pixels: ...


class ViewSubset(ViewSet):
    """Some views of another set, which keeps their pixels; e.g. those of one moment.

    Args:
        views: the whole set.
        indices: of the chosen views, in the order they get here.
    """

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
        means: (N, 3) scene units; of a file that was just read, float64 world units (:meth:`within`).
        colors: (N, C) in the data set's colour space.
        conditions: condition name -> (N,) the value under which matter was found at each point, e.g. "time" -> times
        0..1;
            empty for scenes without conditions.
        axes, quats: (N, 3) semi-axes and (N, 4) orientations wxyz, where the points are ellipsoids.
        alphas: (N,) opacities 0..1 through their middles.
        deviations: (N, 3) standard deviations along the axes in place of ``axes``, where the points are Gaussians: the
        density says how large
            an ellipsoid looks like each.
        steps: condition name -> from one value at which views show the scene from many sides to the next, where that is
        known: a sequence's frames.
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
        """The points at ``index``, (M,) int64 or (N,) bool, with all that belongs to them."""
        axes, quats, alphas, deviations = (
            None if value is None else value[index] for value in (self.axes, self.quats, self.alphas, self.deviations)
        )
        found = {n: value[index] for n, value in self.conditions.items()}
        return PointCloud(self.means[index], self.colors[index], found, axes, quats, alphas, deviations, self.steps)

    def within(self, world: World) -> PointCloud:
        """The points of a file, in the scene's coordinates as float32; subtracted in float64, so ``means`` should be of
        a file in doubles."""
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
    """Views that make a film in their order (one camera over time, a light going round).

    Attributes:
        views: indices into the test split, or into ``source``.
        source: views beside the test split, which do not count in its means; None: the test split.
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
    """A scene to fit: a description of its images and the images themselves. There is no class to derive from it.

    Attributes:
        name: shown in reports.
        train, test: the splits.
        start: where primitives start, see :data:`StartingPoints`.
        extent: scene extent in scene units (see :func:`camera_extent`), the unit of position rates and size limits
        unless matter is a hundred times
            as far.
        background: (C,) the colour that evaluation composites over.
        channels: colour channels C.
        color_space: "srgb" (display-referred values as stored in PNG) or "linear".
        data_source: see :data:`DataSource`; printed in every output.
        random_background: whether training composites a random colour instead (needs alpha).
        downsampling: text for reports, e.g. "none", "images_4" or "200x200 from 800x800 by area".
        up: (3,) the scene's upward direction, for orbits; +z unless said.
        center: (3,) what the cameras look at, for orbits; the origin unless said.
        bounds: (2, 3) lower and upper corner of a box around everything, scene units; None if the data do not say.
        exposure: what the linear values of the files were divided by.
        world: how all these coordinates follow from those of the user's files; the same unless said.
        placement: which voxel files the scene was made from, in the same world; None without such files.
        largest: the largest extinction anywhere, 1/scene unit, that no primitive goes beyond; None where it is not
        known. points: points at which extinction and source radiance are known, for ``train.supervision=voxels`` and
        ``both``; None where they
            are not.
        extra: what else the scene's own task likes to know, of the class that this task names, e.g. what pixels show or
        what the images
            were made from. None is always enough: a task judges by images, cameras and conditions then.
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
            f"class {cls.__name__}(Dataset): a data set is made by calling neuprim.core.data.Dataset(name=..., train=..., test=..., ...); "
            "what a class of its own would judge, film or tell is the task's"
        )

    def initial_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """At most ``count`` distinct starting points, by the data set's own rule."""
        return self.start(self.train, count, generator)

    def uniform_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """``count`` mid-grey points, uniform in the box of the data set.

        Raises:
            ConfigError: the data set has none.
        """
        if self.bounds is None:
            raise ConfigError(
                f"model.init.points=box: {self.name} does not say which box its matter fills; expected matter"
            )
        low, high = self.bounds.float()
        means = low + torch.rand((count, 3), generator=generator) * (high - low)
        return PointCloud(means, torch.full((count, self.channels), 0.5))

    def orbit(self, frames: int) -> list[View]:
        """Views circling the scene at the training cameras' mean distance and elevation; outward where these do not
        look at its centre.

        Conditions that are one number go from their least to their greatest value over the training views; others stay
        as in the first.
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
        """Least and greatest value over the training views of every condition that is one number; an orbit goes from
        one to the other."""
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
    """What is true at M points of one frame.

    Attributes:
        name: of the frame, for logs.
        conditions: of the frame, the same for all points.
        points: (M, 3) float32, scene units.
        sigma: (M,) float32 extinction, 1/scene unit.
        source: (M, C) float32 extinction times source radiance in the data set's colour space, where it is the same
        towards all directions;
            None where it is not, or not known: then the extinction alone is learned from points.
        sigma_scale, source_scale: typical sizes of both where there is matter, what errors are divided by.
        components: name -> (M,) float32, the part of ``sigma`` that comes from the source grid of that name, and its
        typical size.
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
    """Points to learn from; a data set's ``points``.

    Attributes:
        components: names of the source grids whose part of the extinction is known (:attr:`PointSamples.components`).
    """

    components: tuple[str, ...] = ()

    @abstractmethod
    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        """``count`` points of one frame, both drawn by ``generator`` alone, so that a resumed run draws the same."""


def hold_out_views(dataset: Dataset, every: int) -> Dataset:
    """The same without its test views: one of every ``every`` training views takes their place, and is not learned
    from.

    Which one moves on by one from each group to the next: of cameras with as many frames as a multiple of ``every``, it
    is not always the same moment that nobody learns from.

    Args:
        every: 2 or more.

    Raises:
        ConfigError: that leaves nothing to learn from, or nothing to judge by.
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
    """The images of a scene, as they will be when all frames are made. Any process that has the scene's settings can
    make any frame.

    Attributes:
        frames: their names, in order.
        key: of everything that the images depend on; another process must come to the same one, or it sees other files.
        place: folder or URL where they are kept.
        known: plain values that spare another process work that was done here; given to the scene's ``truth`` there.
    """

    frames: Sequence[str]
    key: str
    place: str
    known: Mapping[str, Any]

    @abstractmethod
    def missing(self) -> list[int]:
        """Places in ``frames`` of those that are not there, in order."""

    @abstractmethod
    def begin(self) -> None:
        """Make the place ready; before the first frame is made, by whoever hands them out."""

    @abstractmethod
    def make(self, frame: int, tell: Callable[[str], None]) -> None:
        """Make a frame, unless it is there by now. Whole or not at all; two that make the same one do no harm.

        Args:
            tell: told that the place is gone and waited for.

        Raises:
            DataError: its file cannot be read, or the place cannot be written.
        """

    @abstractmethod
    def complete(self) -> None:
        """What is to be written when all frames are there, if anything."""


@dataclass(frozen=True)
class SceneContext:
    """What a scene's loader gets beside its own settings.

    Attributes:
        seed: for generated scenes.
        cache_dir: where generated data may be kept between runs (keyed by everything that matters).
        progress: called with (text, fraction 0..1) during long work.
        device: what may compute the ground truth where a loader has to; data sets are on the processor either way.
        world: of the model that the scene is loaded for again, whose coordinates it keeps; None: the scene's own
        choice.
    """

    seed: int
    cache_dir: Path
    progress: Callable[[str, float], None] = lambda text, fraction: None
    device: torch.device = HOST
    world: World | None = None

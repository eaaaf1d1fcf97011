"""What a data set hands to the trainer: posed images that load lazily, and where matter may be at the start."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, orbit
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import Conditions

if TYPE_CHECKING:
    from neuprim.core.model.primitives import Primitives
    from neuprim.core.volumes.source import Placement

__all__ = ["Clip", "DataSource", "Dataset", "Pixels", "PointCloud", "View", "ViewSet", "camera_extent"]

DataSource = Literal["real", "generated", "simulated"]
"""Photographs or captures ("real"), our own ray-cast scenes ("generated"), stand-ins for data not given ("simulated")."""


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


@dataclass(frozen=True)
class PointCloud:
    """Points where matter probably is.

    Attributes:
        means: (N, 3) scene units.
        colors: (N, C) in the data set's colour space.
        conditions: condition name -> (N,) the value under which matter was found at each point, e.g. "time" -> times 0..1;
            empty for scenes without conditions.
        axes, quats: (N, 3) semi-axes and (N, 4) orientations wxyz, where the points are ellipsoids.
        alphas: (N,) opacities 0..1 through their middles.
    """

    means: Tensor
    colors: Tensor
    conditions: Mapping[str, Tensor] = field(default_factory=dict)
    axes: Tensor | None = None
    quats: Tensor | None = None
    alphas: Tensor | None = None

    def rows(self, index: Tensor) -> PointCloud:
        """The points at ``index``, (M,) int64 or (N,) bool, with all that belongs to them."""
        ellipsoids = (None if value is None else value[index] for value in (self.axes, self.quats, self.alphas))
        return PointCloud(self.means[index], self.colors[index], {n: value[index] for n, value in self.conditions.items()}, *ellipsoids)


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


class Dataset(ABC):
    """A scene to fit.

    Attributes:
        name: shown in reports.
        train, test: the splits.
        channels: colour channels C.
        color_space: "srgb" (display-referred values as stored in PNG) or "linear".
        data_source: see :data:`DataSource`; printed in every output.
        extent: scene extent in scene units (see :func:`camera_extent`), the unit of position rates and size limits.
        background: (C,) the colour that evaluation composites over.
        random_background: whether training composites a random colour instead (needs alpha).
        downsampling: text for reports, e.g. "none", "images_4" or "200x200 from 800x800 by area".
        up: (3,) the scene's upward direction, for orbits.
        center: (3,) what the cameras look at, for orbits.
        bounds: (2, 3) lower and upper corner of a box around everything, scene units; None if the data do not say.
    """

    name: str
    train: ViewSet
    test: ViewSet
    channels: int
    color_space: Literal["srgb", "linear"]
    data_source: DataSource
    extent: float
    background: Tensor
    random_background: bool
    downsampling: str
    up: Tensor
    center: Tensor
    bounds: Tensor | None = None

    @abstractmethod
    def initial_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """At most ``count`` distinct starting points; the only randomness is ``generator``'s."""

    def uniform_points(self, count: int, generator: torch.Generator) -> PointCloud:
        """``count`` mid-grey points, uniform in the box of the data set.

        Raises:
            ConfigError: the data set has none.
        """
        if self.bounds is None:
            raise ConfigError(f"model.init.points=box: {self.name} does not say which box its matter fills; expected matter")
        low, high = self.bounds.float()
        means = low + torch.rand((count, 3), generator=generator) * (high - low)
        return PointCloud(means, torch.full((count, self.channels), 0.5))

    def clips(self) -> list[Clip]:
        """Films to make of the test views, or of views kept for films; none by default."""
        return []

    def mask(self, index: int) -> Tensor | None:
        """(H, W) bool, the part of a test view whose error is worth reporting on its own; None: no such part."""
        return None

    def judge(self, index: int, rendered: Tensor, truth: Tensor) -> dict[str, float]:
        """Further numbers of one test view, by name, which ``metrics.json`` gives per view and as means over the views that have them.

        Means are plain, but ``mse_NAME`` becomes ``psnr_pooled_NAME``, the PSNR of the mean over views, each of which counts by its
        ``pixels_NAME`` where it says so; ``pixels_NAME`` becomes a sum.

        Args:
            index: of the test split.
            rendered, truth: (H, W, C) in the data set's colour space, over its background.
        """
        return {}

    def diagnose(self, model: Primitives) -> dict[str, Any]:
        """Further JSON-able numbers for ``metrics.json`` that only this kind of data can tell."""
        return {}

    def placement(self) -> Placement | None:
        """How scene units follow from the world of the voxel files that the scene was made from; None without such files."""
        return None

    def facts(self) -> dict[str, Any]:
        """JSON-able facts that drawing the model may need when the data are gone; kept in the model's header under "data"."""
        return {"up": [float(x) for x in self.up], "center": [float(x) for x in self.center]}

    def orbit(self, frames: int) -> list[View]:
        """Views circling the scene at the training cameras' mean distance and elevation."""
        cameras = [self.train.view(i).camera for i in range(len(self.train))]
        offsets = torch.stack([c.position for c in cameras]) - self.center.double()
        radius = offsets.norm(dim=-1).mean().item()
        up = self.up.double() / self.up.double().norm()
        sine = ((offsets @ up) / offsets.norm(dim=-1).clamp_min(1e-12)).mean().clamp(-0.9, 0.9)
        views = orbit(cameras[0], self.center, self.up, radius, torch.asin(sine).item(), frames)
        between = self._scalar_conditions()
        return [
            View(f"orbit_{i:03d}", c, {name: low + i / max(frames - 1, 1) * (high - low) for name, (low, high) in between.items()})
            for i, c in enumerate(views)
        ]

    def _scalar_conditions(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Least and greatest value over the training views of every condition that is one number; an orbit goes from one to the other."""
        found: dict[str, list[Tensor]] = {}
        for i in range(len(self.train)):
            for name, value in self.train.view(i).conditions.items():
                if value.numel() == 1:
                    found.setdefault(name, []).append(value)
        return {name: (torch.stack(values).min(0).values, torch.stack(values).max(0).values) for name, values in found.items()}


def camera_extent(cameras: Sequence[Camera]) -> float:
    """Radius of the cameras' bounding sphere about their mean x 1.1 (the convention of 3D Gaussian splatting); 1.0 if zero."""
    positions = torch.stack([c.position.detach().double() for c in cameras])
    radius = (positions - positions.mean(0)).norm(dim=-1).max().item() * 1.1
    return radius if radius > 0 else 1.0

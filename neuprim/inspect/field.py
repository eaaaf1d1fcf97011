"""What an inspector looks at: one frame of a model's density, on a grid, beside the truth where there is one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.channels import Channels
from neuprim.core.compute.device import HOST
from neuprim.core.conditions import flag
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import Conditions
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import ActiveSet, Primitives
from neuprim.core.volumes.grid import density_grid
from neuprim.inspect.layers import Scale

__all__ = ["FieldFrame", "ViewOptions", "absorbed"]


@dataclass(frozen=True)
class ViewOptions:
    """What the user may say about the views.

    Attributes:
        levels: of isosurfaces, 1/scene unit; empty for a tenth, a third and two thirds of the largest value shown.
        primitive: row to look into; None for the one that absorbs most.
        limit: ellipsoids that are drawn, those that absorb most.
    """

    levels: tuple[float, ...] = ()
    primitive: int | None = None
    limit: int = 20_000


@dataclass(frozen=True)
class FieldFrame:
    """One frame. The extinction on its grid is computed when first asked for.

    Attributes:
        title: the conditions in words, e.g. "time 0.5".
        scene_from_index, shape: of the grid; its axes are the scene's.
        top: largest extinction shown, 1/scene unit; the same for all frames, so that colours mean the same.
        focus: (3,) middle of the matter of all frames, scene units.
        channels: of the model's colours.
        gain: by which a volume's opacity is stronger than the density's own, for the same reason the same for all
        frames. needed: names of the conditions of the model's task.
        truth: (X, Y, Z) float32 ground truth on the grid, or None; computed when called.
        device: what computes the extinction on the grid.
        side: "model", or "truth" in the panel that shows the ground truth in the model's place.
    """

    model: Primitives
    conditions: Conditions
    title: str
    scene_from_index: Tensor
    shape: tuple[int, int, int]
    top: float
    gain: float
    focus: tuple[float, ...] = (0.0, 0.0, 0.0)
    channels: Channels = field(default_factory=Channels)
    needed: tuple[str, ...] = ()
    options: ViewOptions = field(default_factory=ViewOptions)
    truth: Callable[[], np.ndarray] | None = None
    truth_name: str = ""
    numbers: Mapping[str, float] | None = None
    device: torch.device = HOST
    side: str = "model"
    _kept: dict[str, np.ndarray] = field(default_factory=dict)  # shared by the panels of a frame

    def of_side(self, side: str) -> FieldFrame:
        """The same frame with its "model" or its "truth" in the model's place; what was computed is shared."""
        return replace(self, side=side)

    @property
    def step(self) -> float:
        """Distance of grid points, scene units."""
        return float(self.scene_from_index[0, 0])

    @property
    def origin(self) -> np.ndarray:
        """(3,) the first grid point."""
        return np.asarray(self.scene_from_index[:3, 3].numpy())

    @property
    def box(self) -> np.ndarray:
        """(2, 3) box that the grid's cells fill, scene units."""
        low = self.origin - self.step / 2
        return np.stack([low, low + self.step * np.array(self.shape)])

    @property
    def scale(self) -> Scale:
        """Colours of extinctions, the same for all frames."""
        return Scale(0.0, self.top, title="extinction", unit="1/scene unit")

    @property
    def sigma(self) -> np.ndarray:
        """(X, Y, Z) float32 extinction of the model, each primitive clamped at 0 from below; or of the truth in its
        panel."""
        if self.side not in self._kept:
            if self.side == "truth":
                if self.truth is None:
                    raise ConfigError("there is no ground truth to show; give --against")
                self._kept["truth"] = self.truth()
            else:
                self._kept["model"] = density_grid(
                    self.model, self.conditions, self.scene_from_index, self.shape, where=self.device
                ).numpy()
        return self._kept[self.side]

    @property
    def difference(self) -> np.ndarray:
        """(X, Y, Z) float32 model minus truth.

        Raises:
            ConfigError: there is no truth.
        """
        if self.truth is None:
            raise ConfigError("--show difference: there is no ground truth; give --against")
        return self.of_side("model").sigma - self.of_side("truth").sigma

    @cached_property
    def active(self) -> ActiveSet:
        """The primitives that live in this frame, without gradients."""
        with torch.no_grad():
            return self.model.active(self.conditions)

    @cached_property
    def alive(self) -> np.ndarray:
        """(M,) int64 rows of the model that live in this frame, in the order of :attr:`geometry`."""
        return np.arange(self.model.count) if self.active.rows is None else self.active.rows.numpy()

    @property
    def geometry(self) -> Geometry:
        """Where the M primitives of :attr:`alive` are, float32."""
        return self.active.geometry

    def density(self, row: int, points: Tensor) -> np.ndarray:
        """(P,) float64 unclamped extinction of one primitive of the model at (P, 3) points inside it."""
        params = {name: value.detach()[row : row + 1].double() for name, value in self.model.params.items()}
        own = {s.name: params[s.name] for s in self.model.density.parameters()}
        wide = {name: value.double() for name, value in self.conditions.items()}
        stored = Geometry(params["means"], params["log_scales"], params["quats"])
        with torch.no_grad():
            prim = torch.zeros(len(points), dtype=torch.int64)
            return np.asarray(self.model.density.density(own, stored, prim, points.double(), wide).numpy())

    @cached_property
    def masses(self) -> np.ndarray:
        """(M,) float64 what each active primitive absorbs in all, see :func:`absorbed`."""
        return absorbed(self.active)

    @cached_property
    def colours(self) -> np.ndarray:
        """(M, 3) float32 display-referred colours at the primitives' centres, as seen from the view's first direction.

        Raises:
            ConfigError: a condition that the colours depend on was not given.
        """
        missing = [name for name in self.needed if name not in self.conditions]
        if missing:
            raise ConfigError(f"the primitives' colours depend on the {missing[0]}; give {flag(missing[0])}")
        low, high = self.box
        center = torch.from_numpy((low + high) / 2).float()
        eye = center + torch.tensor([1.0, -1.6, 0.7]) * float(np.linalg.norm(high - low))
        camera = Camera(look_at(eye, center, torch.tensor([0.0, 0.0, 1.0])), 64.0, 64.0, 32.0, 32.0, 64, 64)
        with torch.no_grad():
            rgb = self.model.lower(camera, self.conditions).center_colors(eye)
        return np.asarray(self.channels.display_rows(rgb.float().clamp_min(0)).numpy())

    def row(self) -> int:
        """Position in :attr:`alive` of the primitive to look into.

        Raises:
            ConfigError: there is no such primitive, or it does not live in this frame.
        """
        wanted = self.options.primitive
        if wanted is None:
            return int(self.masses.argmax())
        if wanted >= self.model.count:
            raise ConfigError(
                f"--primitive {wanted}: the model has {self.model.count} primitives, 0 to {self.model.count - 1}"
            )
        found = np.flatnonzero(self.alive == wanted)
        if not len(found):
            raise ConfigError(
                f"--primitive {wanted}: it absorbs nothing at {self.title}; choose another one or another frame"
            )
        return int(found[0])


def absorbed(active: ActiveSet) -> np.ndarray:
    """(M,) float64 what each active primitive absorbs in all: its clamped extinction times its volume, from 33 points
    inside."""
    geometry = active.geometry
    every = torch.arange(geometry.count)
    total = torch.zeros(len(every))
    with torch.no_grad():
        for u in _ball():
            x = geometry.means + (geometry.rotations @ (geometry.scales * u)[..., None])[..., 0]
            total += active.sigma(every, x).clamp_min(0)
    return np.asarray((total / len(_ball()) * geometry.scales.prod(1) * 4.18879).double().numpy())


def _ball() -> Tensor:
    """(33, 3) points spread evenly over the unit ball."""
    i = torch.arange(33)
    radius, height, angle = ((i + 0.5) / 33) ** (1 / 3), 1 - 2 * ((i * 0.618034 * 7 + 0.5) % 1), i * 2.399963
    ring = (1 - height**2).clamp_min(0).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), height], 1) * radius[:, None]

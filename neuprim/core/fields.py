"""The two interfaces of the design: a density field and a colour field, and the closed forms they lower to.

A *field* owns some per-primitive parameters. Before a frame is drawn it *lowers*: conditions such as time or light are
folded into one of a few closed forms that the renderer knows. The renderer never sees a task.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from neuprim.core.geometry import Geometry
from neuprim.core.ray_cameras import AnyCamera
from neuprim.core.schema import ParameterSpec, Params

if TYPE_CHECKING:
    from neuprim.core.settings import RenderSettings

__all__ = [
    "MOST_UNITS",
    "ColourField",
    "ConditionSpec",
    "Conditions",
    "Constant",
    "Cosine",
    "DensityField",
    "Field",
    "LoweredColour",
    "LoweredDensity",
    "Opaque",
    "OpaqueColour",
    "RayNet",
    "Shade",
    "Shading",
]

Conditions = Mapping[str, Tensor]
"""Condition name ("time", "light", a plugin's "wavelength") -> value for one frame."""


@dataclass(frozen=True)
class ConditionSpec:
    """A quantity a frame depends on besides its camera; command-line flags derive from these.

    Attributes:
        name: of the flag, and the key in a frame's conditions.
        range: lowest and highest value of every element. Numbers that are not finite are refused by every command; for numbers beyond
            the range there is a warning.
        parse: the text of ``--NAME TEXT`` -> one tensor of ``shape`` per frame of an animation; raises
            :class:`~neuprim.core.errors.ConfigError`. Where ``shape`` is ``()`` it is asked for each element of a list ``A,B,C``, and
            need not know ranges ``A:B:COUNT`` (:mod:`neuprim.core.conditions`).
        strict: whether numbers beyond the range are refused, a data set's among them.
        sweep: a text of ``--NAME TEXT`` that animates the condition, for the commands a report offers; empty: none.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    range: tuple[float, float]
    parse: Callable[[str], list[Tensor]]
    strict: bool = False
    sweep: str = ""


# ---------------------------------------------------------------- closed forms of density


MOST_UNITS = 256
"""Most neurons of a density and units of a colour network: the fast kernels number a primitive's neurons in a byte."""


@dataclass(frozen=True)
class Cosine:
    """f(x~) = sum_k w2_k cos(omega0 (W1_k . x~ + b1_k)) + b2, world density f/m (method: equation 10 of the paper).

    Attributes:
        W1: (N, K, 3), b1: (N, K), w2: (N, K), b2: (N,) or (N, 1); K = 0 to :data:`MOST_UNITS`, and K = 0 is a constant density.
        omega0: multiplies the whole phase.

    ``first + second`` is the sum of two densities of the same primitives, see :meth:`__add__`.
    """

    W1: Tensor
    b1: Tensor
    w2: Tensor
    b2: Tensor
    omega0: float = 30.0

    def __add__(self, other: Cosine) -> Cosine:
        """f + g, exactly: the neurons of both side by side. Differentiable.

        Both have the first one's omega0 (the second one's if that is 0); frequencies and phases of the other are scaled to it.

        Raises:
            FormError: they are not of the same primitives, or have more than :data:`MOST_UNITS` neurons together.
        """
        if not isinstance(other, Cosine):
            return NotImplemented
        from neuprim.core.forms import check_sum  # which knows the forms of this file

        check_sum(self, other)
        omega0 = self.omega0 or other.omega0
        parts = [(f, f.omega0 / omega0 if f.omega0 != omega0 else 1.0) for f in (self, other)]
        W1 = torch.cat([f.W1 * scale for f, scale in parts], 1)
        b1 = torch.cat([f.b1 * scale for f, scale in parts], 1)
        return Cosine(W1, b1, torch.cat([self.w2, other.w2], 1), self.b2 + other.b2.reshape(self.b2.shape), omega0)

    def rows(self, index: Tensor) -> Cosine:
        """Those of some primitives, (M,) int64, without gradient."""
        W1, b1, w2, b2 = (x.detach()[index] for x in (self.W1, self.b1, self.w2, self.b2))
        return Cosine(W1, b1, w2, b2, self.omega0)


@dataclass(frozen=True)
class Opaque:
    """Any other density, as torch code per ray-primitive pair; the reference backend renders it.

    ``line_integral(prim, origin, direction, t0, t1)`` takes (M,) primitive rows, (M, 3) ray origins and unit directions
    in scene units and the (M,) chord ends in scene units, and returns the (M,) optical depths, the integral of sigma.
    """

    line_integral: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]

    def rows(self, index: Tensor) -> Opaque:
        """That of some primitives, (M,) int64."""
        return Opaque(lambda prim, *ray: self.line_integral(index[prim], *ray))


LoweredDensity = Cosine | Opaque


# ---------------------------------------------------------------- closed forms of colour


@dataclass(frozen=True)
class Constant:
    """One colour per primitive and view: rgb (N, C), any channel count."""

    rgb: Tensor

    def scaled(self, factors: Tensor) -> Constant:
        """The same times (N,) factors, at least 0."""
        return Constant(self.rgb * factors.to(self.rgb)[:, None])


@dataclass(frozen=True)
class OpaqueColour:
    """Any other colour, as torch code per ray-primitive pair; the reference backend renders it.

    ``radiance(prim, x, d)`` takes (M,) primitive rows, (M, 3) chord middles in scene units and (M, 3) unit directions,
    and returns (M, C).
    """

    radiance: Callable[[Tensor, Tensor, Tensor], Tensor]
    channels: int

    def scaled(self, factors: Tensor) -> OpaqueColour:
        """The same times (N,) factors, at least 0."""

        def radiance(prim: Tensor, x: Tensor, d: Tensor) -> Tensor:
            found = self.radiance(prim, x, d)
            return found * factors.to(found)[prim, None]

        return OpaqueColour(radiance, self.channels)


@dataclass(frozen=True)
class RayNet:
    """A colour network per primitive, evaluated where each pixel's ray passes through it.

        c(pixel) = max(0, base + Wout cos(Wx . x~_m + bias)),   x~_m = (x_m - mu)/m

    with x_m the middle of the ray's chord, after the cut by the near plane if there is one: the point that the closed form of the
    density is anchored at. One hidden layer of H cosine units, H = 0 to :data:`MOST_UNITS`, phases in radians; H = 0 is the constant colour
    max(0, base). Whatever does not change within a primitive (view direction at its centre, light) a field folds into ``bias``,
    ``Wout`` and ``base``. A colour of exactly 0 still passes its gradient, as ``clamp_min`` does.

    Attributes:
        Wx: (N, H, 3) on scene axes, radians per m; bias: (N, H), radians.
        Wout: (N, C, H), base: (N, C), any channel count C.
    """

    Wx: Tensor
    bias: Tensor
    Wout: Tensor
    base: Tensor

    @property
    def channels(self) -> int:
        return int(self.base.shape[1])

    @property
    def hidden(self) -> int:
        return int(self.Wx.shape[1])

    def scaled(self, factors: Tensor) -> RayNet:
        """The same times (N,) factors, at least 0, which max(0, .) lets through."""
        factors = factors.to(self.base)
        return RayNet(self.Wx, self.bias, self.Wout * factors[:, None, None], self.base * factors[:, None])

    def radiance(self, prim: Tensor, local: Tensor) -> Tensor:
        """(M, C) float64 colours of primitives ``prim`` (M,) at local chord middles ``local`` = x~_m (M, 3) float64; differentiable."""
        phase = (self.Wx.double()[prim] * local[:, None, :]).sum(-1) + self.bias.double()[prim]
        mixed = (self.Wout.double()[prim] * phase.cos()[:, None, :]).sum(-1)
        return (self.base.double()[prim] + mixed).clamp_min(0)


LoweredColour = Constant | RayNet | OpaqueColour

Shade = Callable[[Tensor], Tensor]
"""(M, 3) float64 scene points that pixels show -> (M,) factors on the light that they send to the camera, without gradient."""


@dataclass(frozen=True)
class Shading:
    """Factors on a frame's colours that follow from the primitives themselves, such as shadows; without gradient.

    Attributes:
        primitives: (M,) at least 0, one for each primitive of the frame; None: 1.
        pixels: a factor that varies faster than primitives do, such as a shadow's edge: the renderer asks for it once per pixel, at the
            mean depth of what the pixel shows (deferred shading). None: 1 everywhere, and no depth image is drawn for it.
    """

    primitives: Tensor | None = None
    pixels: Shade | None = None


# ---------------------------------------------------------------- fields


class Field(ABC):
    """Per-primitive parameters with a meaning. Subclasses are final: no field inherits from another.

    ``init_settings`` names the keys of ``model.init`` that the field's initialisers read.
    """

    init_settings: tuple[str, ...] = ()

    @abstractmethod
    def parameters(self) -> list[ParameterSpec]:
        """The field's tensors, in storage order."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """JSON-able constructor arguments; ``type(self)(**settings)`` rebuilds the field from a checkpoint header."""

    @classmethod
    def every_parameter(cls) -> list[ParameterSpec]:
        """The parameters that it has at any settings; a preset may give rates for all of them."""
        return cls().parameters()

    def set_progress(self, progress: float) -> None:  # noqa: B027 - a hook most fields do not need
        """Called before every training step with the used fraction of the budget, 0..1; e.g. to unlock SH bands."""

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        """Rows for children created inside their parents.

        Args:
            params: this field's tensors, one row per child, gathered from the parents.
            old: the parents' geometry, one row per child.
            new: the children's geometry.

        Returns:
            tensors of the same shapes, such that each child continues its parent's field inside its own support.
        """
        return dict(params)


class DensityField(Field):
    """How much light a point absorbs.

    ``exact_split`` says that children continue their parent's sigma inside their own support (see :meth:`on_split`). A family of
    densities that is too small for that, such as Gaussians, sets it to False; its children must then hold their parent's mass, the
    integral of sigma over space.
    """

    exact_split: bool = True

    @abstractmethod
    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> LoweredDensity:
        """The frame's closed form."""

    @abstractmethod
    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        """World density sigma (M,), 1/scene unit, unclamped, of primitives ``prim`` (M,) at points ``x`` (M, 3) inside them."""

    @abstractmethod
    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        """Rows whose density is ``factor`` (rows,) times as large everywhere (a clone in place halves both copies)."""

    def alive(self, params: Params, conditions: Conditions) -> Tensor | None:
        """(M,) int64 ascending rows that can absorb anything under these conditions; None for all of them.

        The others are left out before anything else is computed, so they cost nothing in such a frame.
        """
        return None

    def move(self, params: Params, geometry: Geometry, conditions: Conditions) -> Geometry:
        """Where the ellipsoids are under these conditions; differentiable."""
        return geometry

    def divide(self, params: Params, geometry: Geometry) -> tuple[Tensor, dict[str, Tensor], Geometry] | None:
        """A split along a condition instead of in space, for densities that live for a part of its range.

        Args:
            params: this field's tensors, one row per parent (P rows).
            geometry: the parents'.

        Returns:
            (P,) bool of the parents that are better divided this way; this field's tensors and the geometry of 2 P rows, all
            first halves then all second halves (rows of other parents are ignored). None: never.
        """
        return None


class ColourField(Field):
    """What colour a primitive sends towards the camera."""

    channels: int

    def harmonics(self, params: Params, conditions: Conditions) -> tuple[Tensor, Tensor | None] | None:
        """The colour as :func:`neuprim.core.sh.colors` takes it under these conditions, for fields that are that: zero-order
        coefficients (N, C) and those of the higher bands (N, B, C) or None. None for other fields.
        """
        return None

    @abstractmethod
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> LoweredColour:
        """The frame's closed form."""

    def shade(self, geometry: Geometry, density: LoweredDensity, conditions: Conditions, settings: RenderSettings) -> Shading | None:
        """What else the frame's colours are multiplied by. Images drawn for it take their backend and threads from ``settings``, those
        of the frame.
        """
        return None

"""The closed forms that fields lower to: what a renderer draws, with its task's conditions folded in.

Each knows its tensors' shapes and its mathematics along chords (:class:`PrimitiveChords`); kernels know a few by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neuprim.core.errors import FormError
from neuprim.core.model.edge import EDGES, sinc, soft_edge_chord_integral
from neuprim.core.model.geometry import Geometry, PrimitiveChords
from neuprim.core.model.tensors import (
    MOST_UNITS,
    PrimitiveTensors,
    Shapes,
    Sizes,
    field_number_fault,
    function_fault,
    labelled_fault,
)

# ---------------------------------------------------------------- closed forms of density


@dataclass(frozen=True)
class Cosine(PrimitiveTensors):
    """f(x~) = sum_k w2_k cos(omega0 (W1_k . x~ + b1_k)) + b2, density (1 - |y|^2)^p f/m inside the ellipsoid |y| < 1.

    p = 0 is the paper's; 1 and 2 have a soft edge (:mod:`neuprim.core.model.edge`). ``first + second`` is a sum of
    densities.

    Attributes:
        W1: (N, K, 3), b1: (N, K), w2: (N, K), b2: (N,) or (N, 1); K = 0 to :data:`MOST_UNITS`.
        omega0: multiplies the whole phase.
        edge: p, 0, 1 or 2.
    """

    shapes: ClassVar[Shapes] = {
        "W1": (("N", "K", 3),),
        "b1": (("N", "K"),),
        "w2": (("N", "K"),),
        "b2": (("N", 1), ("N",)),
    }

    W1: Tensor
    b1: Tensor
    w2: Tensor
    b2: Tensor
    omega0: float = 30.0
    edge: int = 0

    def fault(self, sizes: Sizes) -> str | None:
        if type(self.edge) is not int or self.edge not in EDGES:
            return f"edge has value {self.edge!r}; expected 0, 1 or 2"
        return super().fault(sizes) or labelled_fault("omega0", field_number_fault(self.omega0))

    def __add__(self, other: Cosine) -> Cosine:
        """f + g, exactly: the neurons of both side by side, with the first omega0 (the second if that is 0).

        Raises FormError for other primitives, different edges, or more than :data:`MOST_UNITS` neurons together.
        """
        if not isinstance(other, Cosine):
            return NotImplemented
        sizes: Sizes = {}
        for word, form in (("first", self), ("second", other)):
            sizes.pop("K", None)
            fault = form.fault(sizes)
            if fault is not None:
                raise FormError(f"sum of two Cosine forms: the {word}: {fault}")
        neurons = (self.W1.shape[1], other.W1.shape[1])
        if sum(neurons) > MOST_UNITS:
            raise FormError(
                f"sum of two Cosine forms: {neurons[0]} + {neurons[1]} neurons; expected at most {MOST_UNITS}"
            )
        if self.edge != other.edge:
            raise FormError(f"sum of two Cosine forms: edges {self.edge} and {other.edge}; expected the same of both")
        omega0 = self.omega0 or other.omega0
        parts = [(f, f.omega0 / omega0 if f.omega0 != omega0 else 1.0) for f in (self, other)]
        W1 = torch.cat([f.W1 * scale for f, scale in parts], 1)
        b1 = torch.cat([f.b1 * scale for f, scale in parts], 1)
        return Cosine(
            W1, b1, torch.cat([self.w2, other.w2], 1), self.b2 + other.b2.reshape(self.b2.shape), omega0, self.edge
        )

    def primitive_rows(self, index: Tensor | slice) -> Cosine:
        """Those of some primitives, (M,) int64 or first:end, without gradient."""
        W1, b1, w2, b2 = (x.detach()[index] for x in (self.W1, self.b1, self.w2, self.b2))
        return Cosine(W1, b1, w2, b2, self.omega0, self.edge)

    def scaled(self, factors: Tensor) -> Cosine:
        """sigma times (N,) factors, at least 0."""
        factors = factors.to(self.b2)
        w2, b2 = self.w2 * factors[:, None], self.b2 * factors.reshape(self.b2.shape)
        return Cosine(self.W1, self.b1, w2, b2, self.omega0, self.edge)

    def optical_depth(self, pairs: PrimitiveChords) -> Tensor:
        """(M,) float64 integrals of sigma along chords: one (cos, sinc) pair per neuron, whatever their length."""
        prim = pairs.prim
        W1 = self.W1.double()[prim]
        phase = self.omega0 * ((W1 * pairs.local[:, None, :]).sum(-1) + self.b1.double()[prim])
        rate = self.omega0 * (W1 * pairs.direction[:, None, :]).sum(-1)
        w2, b2, z = self.w2.double()[prim], self.b2.double().reshape(-1)[prim], rate * pairs.half[:, None]
        if self.edge:
            return 2 * pairs.half * soft_edge_chord_integral(pairs.support, self.edge, phase, z, w2, b2)
        waves = (w2 * phase.cos() * sinc(z)).sum(-1)
        return 2 * pairs.half * (b2 + waves)


@dataclass(frozen=True)
class CustomDensity(PrimitiveTensors):
    """Any other density, as torch code per ray-primitive pair; the reference backend renders it.

    ``line_integral(prim, origin, direction, t0, t1)`` takes (M,) rows, (M, 3) ray origins and unit directions and (M,)
    chord ends in scene units, and returns the (M,) optical depths.
    """

    edge: ClassVar[int] = 0
    line_integral: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]

    def fault(self, sizes: Sizes) -> str | None:
        return labelled_fault("line_integral", function_fault(self.line_integral))

    def primitive_rows(self, index: Tensor | slice) -> CustomDensity:
        """That of some primitives, (M,) int64 or first:end."""
        if isinstance(index, slice):
            return CustomDensity(lambda prim, *ray: self.line_integral(prim + (index.start or 0), *ray))
        return CustomDensity(lambda prim, *ray: self.line_integral(index[prim], *ray))

    def scaled(self, factors: Tensor) -> CustomDensity:
        """sigma times (N,) factors, at least 0."""

        def line_integral(prim: Tensor, *ray: Tensor) -> Tensor:
            found = self.line_integral(prim, *ray)
            return found * factors.to(found)[prim]

        return CustomDensity(line_integral)

    def optical_depth(self, pairs: PrimitiveChords) -> Tensor:
        """Integrals of sigma along chords as the code returns them, unchecked."""
        return self.line_integral(pairs.prim, pairs.origins, pairs.direction, *pairs.ends)


LoweredDensity = Cosine | CustomDensity


# ---------------------------------------------------------------- closed forms of colour


@dataclass(frozen=True)
class Constant(PrimitiveTensors):
    """One colour per primitive and view: rgb (N, C), any channel count.

    ``ambient`` (N, C), if given, is added once the factors per primitive of :class:`Shading` have multiplied ``rgb``.
    """

    per_primitive: ClassVar[bool] = True
    shapes: ClassVar[Shapes] = {"rgb": (("N", "C"),)}

    rgb: Tensor
    ambient: Tensor | None = None

    @property
    def channels(self) -> int:
        return int(self.rgb.shape[1])

    def tensors(self) -> dict[str, Tensor]:
        return {"colors": self.rgb}  # as users know it

    def shaded(self, factors: Tensor | None) -> Constant:
        """``rgb`` times (N,) factors, at least 0, and ``ambient``; None: 1."""
        rgb = self.rgb if factors is None else self.rgb * factors.to(self.rgb)[:, None]
        return Constant(rgb if self.ambient is None else rgb + self.ambient)

    def chord_colours(self, pairs: PrimitiveChords) -> Tensor:
        """(M, C) float64 colours that are seen along chords."""
        return self.rgb.double()[pairs.prim]

    def at_primitive_centers(self, geometry: Geometry, position: Tensor) -> Tensor:
        """(N, C) colours at the centres of the primitives, seen from ``position`` (3,)."""
        return self.rgb

    @property
    def flat(self) -> Tensor:
        """(N, C) colours, as they are the same all over a primitive."""
        return self.rgb


@dataclass(frozen=True)
class CustomColour(PrimitiveTensors):
    """Any other colour, as torch code per ray-primitive pair; the reference backend renders it.

    ``radiance(prim, x, d)`` takes (M,) rows, (M, 3) chord middles in scene units and unit directions, returns (M, C).
    """

    per_primitive: ClassVar[bool] = False
    flat: ClassVar[None] = None
    radiance: Callable[[Tensor, Tensor, Tensor], Tensor]
    channels: int

    def fault(self, sizes: Sizes) -> str | None:
        if isinstance(self.channels, bool) or not isinstance(self.channels, int) or self.channels < 1:
            return f"channels has value {self.channels!r}; expected a whole number of at least 1"
        sizes["C"] = (self.channels, "channels")
        return labelled_fault("radiance", function_fault(self.radiance))

    def shaded(self, factors: Tensor | None) -> CustomColour:
        """The same times (N,) factors, at least 0; None: 1."""
        if factors is None:
            return self

        def radiance(prim: Tensor, x: Tensor, d: Tensor) -> Tensor:
            found = self.radiance(prim, x, d)
            return found * factors.to(found)[prim, None]

        return CustomColour(radiance, self.channels)

    def chord_colours(self, pairs: PrimitiveChords) -> Tensor:
        """Colours seen along chords as the code returns them, unchecked."""
        return self.radiance(pairs.prim, pairs.points, pairs.direction)

    def at_primitive_centers(self, geometry: Geometry, position: Tensor) -> Tensor:
        """Colours at the centres of the primitives, seen from ``position`` (3,), unchecked."""
        means = geometry.means
        directions = torch.nn.functional.normalize(means - position.to(means), dim=1)
        return self.radiance(torch.arange(geometry.count, device=means.device), means, directions)


@dataclass(frozen=True)
class RayNet(PrimitiveTensors):
    """A colour network per primitive, evaluated where each pixel's ray passes through it.

        c(pixel) = max(0, base + Wout cos(Wx . x~_m + bias)),   x~_m = (x_m - mu)/m

    with x_m the middle of the ray's chord, after the near plane's cut. One hidden layer of H cosine units, H = 0 to
    :data:`MOST_UNITS`. What does not change within a primitive (view direction, light) a field folds into ``bias``,
    ``Wout`` and ``base``. A colour of exactly 0 still passes its gradient, as ``clamp_min`` does.

    Attributes:
        Wx: (N, H, 3) on scene axes, radians per m; bias: (N, H), radians.
        Wout: (N, C, H), base: (N, C), any channel count C.
    """

    per_primitive: ClassVar[bool] = True
    flat: ClassVar[None] = None
    shapes: ClassVar[Shapes] = {
        "Wx": (("N", "H", 3),),
        "bias": (("N", "H"),),
        "base": (("N", "C"),),
        "Wout": (("N", "C", "H"),),
    }

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

    def shaded(self, factors: Tensor | None) -> RayNet:
        """The same times (N,) factors, at least 0, which max(0, .) lets through; None: 1."""
        if factors is None:
            return self
        factors = factors.to(self.base)
        return RayNet(self.Wx, self.bias, self.Wout * factors[:, None, None], self.base * factors[:, None])

    def primitive_radiance(self, prim: Tensor, local: Tensor) -> Tensor:
        """(M, C) float64 colours of primitives ``prim`` (M,) at ``local`` = x~_m (M, 3) float64; differentiable."""
        phase = (self.Wx.double()[prim] * local[:, None, :]).sum(-1) + self.bias.double()[prim]
        mixed = (self.Wout.double()[prim] * phase.cos()[:, None, :]).sum(-1)
        return (self.base.double()[prim] + mixed).clamp_min(0)

    def chord_colours(self, pairs: PrimitiveChords) -> Tensor:
        """(M, C) float64 colours that are seen along chords; differentiable."""
        return self.primitive_radiance(pairs.prim, pairs.local)

    def at_primitive_centers(self, geometry: Geometry, position: Tensor) -> Tensor:
        """(N, C) float64 colours at the centres of the primitives; the same from everywhere."""
        middles = torch.zeros_like(geometry.means, dtype=torch.float64)
        return self.primitive_radiance(torch.arange(geometry.count, device=middles.device), middles)


LoweredColour = Constant | RayNet | CustomColour
"""Of each: ``channels``, and ``per_primitive``, whether a colour at its centre says what a primitive looks like from a
direction."""

Shade = Callable[[Tensor], Tensor]
"""(M, 3) float64 scene points that pixels show -> (M,) factors on the light that they send to the camera, without
gradient."""


@dataclass(frozen=True)
class Shading:
    """Factors on a frame's colours that follow from the primitives themselves, such as shadows; without gradient.

    Attributes:
        primitives: (M,) at least 0, one for each primitive of the frame; None: 1.
        pixels: a factor asked for once per pixel, at the mean depth of what it shows (deferred shading); None: 1.
    """

    primitives: Tensor | None = None
    pixels: Shade | None = None

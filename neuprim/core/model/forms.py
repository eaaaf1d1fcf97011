"""Closed forms: the density and the colour of all primitives in one frame, as the renderer reads them.

Fields apply a frame's conditions, such as the time, to their parameters and return one of these forms. Each form checks
its tensors and computes its values along chords (:class:`PrimitiveChords`), the parts of rays inside ellipsoids. Fast
kernels implement only some of the forms.
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
    """Density of a cosine network: sigma(x) = (1 - |y|^2)^p f(x~) / m inside the ellipsoid |y| < 1, 0 outside.

    f(x~) = sum_k w2_k cos(omega0 (W1_k . x~ + b1_k)) + b2 with x~ = (x - mu) / m, where mu is the ellipsoid's centre
    and m its longest semi-axis. y is x in coordinates in which the ellipsoid is the unit ball. p = 0 is the hard edge
    of the paper. With p = 1 or 2, density fades to 0 at the boundary (:mod:`neuprim.core.model.edge`).
    ``first + second`` adds two densities.
    """

    shapes: ClassVar[Shapes] = {
        "W1": (("N", "K", 3),),
        "b1": (("N", "K"),),
        "w2": (("N", "K"),),
        "b2": (("N", 1), ("N",)),
    }

    W1: Tensor  # (N, K, 3) frequencies, K from 0 to 256
    b1: Tensor  # (N, K) phases
    w2: Tensor  # (N, K) amplitudes
    b2: Tensor  # (N,) or (N, 1) offsets
    omega0: float = 30.0  # factor on the whole phase
    edge: int = 0  # p: 0, 1 or 2

    def fault(self, sizes: Sizes) -> str | None:
        if type(self.edge) is not int or self.edge not in EDGES:
            return f"edge has value {self.edge!r}; expected 0, 1 or 2"
        return super().fault(sizes) or labelled_fault("omega0", field_number_fault(self.omega0))

    def __add__(self, other: Cosine) -> Cosine:
        """Return the exact sum of two densities of the same primitives, with the neurons of both.

        The result has the omega0 of the first density, or of the second density if the first omega0 is 0. Raises
        FormError for different primitives or edges, or more than :data:`MOST_UNITS` neurons together.
        """
        if not isinstance(other, Cosine):
            return NotImplemented
        sizes: Sizes = {}
        for word, form in (("first", self), ("second", other)):
            sizes.pop("K", None)
            fault = form.fault(sizes)
            if fault is not None:
                raise FormError(f"sum of two Cosine forms: the {word} form: {fault}")
        neurons = (self.W1.shape[1], other.W1.shape[1])
        if sum(neurons) > MOST_UNITS:
            raise FormError(
                f"sum of two Cosine forms: {neurons[0]} + {neurons[1]} neurons; expected at most {MOST_UNITS}"
            )
        if self.edge != other.edge:
            raise FormError(f"sum of two Cosine forms: edges {self.edge} and {other.edge}; expected equal edges")
        omega0 = self.omega0 or other.omega0
        parts = [(f, f.omega0 / omega0 if f.omega0 != omega0 else 1.0) for f in (self, other)]
        W1 = torch.cat([f.W1 * scale for f, scale in parts], 1)
        b1 = torch.cat([f.b1 * scale for f, scale in parts], 1)
        return Cosine(
            W1, b1, torch.cat([self.w2, other.w2], 1), self.b2 + other.b2.reshape(self.b2.shape), omega0, self.edge
        )

    def primitive_rows(self, index: Tensor | slice) -> Cosine:
        """Return the density of the primitives ``index`` only, (M,) int64 or a slice, without gradient."""
        W1, b1, w2, b2 = (x.detach()[index] for x in (self.W1, self.b1, self.w2, self.b2))
        return Cosine(W1, b1, w2, b2, self.omega0, self.edge)

    def scaled(self, factors: Tensor) -> Cosine:
        """Return this density multiplied by ``factors`` (N,), one per primitive, at least 0."""
        factors = factors.to(self.b2)
        w2, b2 = self.w2 * factors[:, None], self.b2 * factors.reshape(self.b2.shape)
        return Cosine(self.W1, self.b1, w2, b2, self.omega0, self.edge)

    def optical_depth(self, pairs: PrimitiveChords) -> Tensor:
        """Return the (M,) float64 integrals of sigma along M chords, in closed form.

        With a hard edge, the integral needs one cosine and one sinc per neuron.
        """
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
    """A density given by PyTorch code for pairs of ray and primitive; only the reference backend renders it.

    Attributes:
        line_integral: function (prim, origin, direction, t0, t1) -> (M,) optical depths. Its arguments are indices
            of primitives (M,), ray origins and unit directions (M, 3), and ray distances of the chords' ends (M,), in
            scene units.
    """

    edge: ClassVar[int] = 0
    line_integral: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]

    def fault(self, sizes: Sizes) -> str | None:
        return labelled_fault("line_integral", function_fault(self.line_integral))

    def primitive_rows(self, index: Tensor | slice) -> CustomDensity:
        """Return the density of the primitives ``index`` only, (M,) int64 or a slice."""
        if isinstance(index, slice):
            return CustomDensity(lambda prim, *ray: self.line_integral(prim + (index.start or 0), *ray))
        return CustomDensity(lambda prim, *ray: self.line_integral(index[prim], *ray))

    def scaled(self, factors: Tensor) -> CustomDensity:
        """Return this density multiplied by ``factors`` (N,), one per primitive, at least 0."""

        def line_integral(prim: Tensor, *ray: Tensor) -> Tensor:
            found = self.line_integral(prim, *ray)
            return found * factors.to(found)[prim]

        return CustomDensity(line_integral)

    def optical_depth(self, pairs: PrimitiveChords) -> Tensor:
        """Return the (M,) integrals of sigma along M chords as ``line_integral`` returns them, without a check."""
        return self.line_integral(pairs.prim, pairs.origins, pairs.direction, *pairs.ends)


LoweredDensity = Cosine | CustomDensity
"""Density in closed form: the result type of :meth:`DensityField.lower`."""


# ---------------------------------------------------------------- closed forms of colour


@dataclass(frozen=True)
class Constant(PrimitiveTensors):
    """A colour that is constant inside each primitive, for one view; any number of channels C."""

    per_primitive: ClassVar[bool] = True
    shapes: ClassVar[Shapes] = {"rgb": (("N", "C"),)}

    rgb: Tensor  # (N, C) colours
    ambient: Tensor | None = None  # (N, C) colours to add after the factors of Shading have multiplied rgb; None for 0

    @property
    def channels(self) -> int:
        return int(self.rgb.shape[1])

    def tensors(self) -> dict[str, Tensor]:
        return {"colors": self.rgb}  # the name that users know

    def shaded(self, factors: Tensor | None) -> Constant:
        """Return the colours ``rgb`` times ``factors`` (N,), at least 0, plus ``ambient``; ``factors`` None means 1."""
        rgb = self.rgb if factors is None else self.rgb * factors.to(self.rgb)[:, None]
        return Constant(rgb if self.ambient is None else rgb + self.ambient)

    def chord_colours(self, pairs: PrimitiveChords) -> Tensor:
        """Return the (M, C) float64 colours of M chords; a chord has the colour of its primitive."""
        return self.rgb.double()[pairs.prim]

    def at_primitive_centers(self, geometry: Geometry, position: Tensor) -> Tensor:
        """Return the (N, C) colours at the centres of the primitives; the colours do not depend on the arguments."""
        return self.rgb

    @property
    def flat(self) -> Tensor:
        """Colours (N, C) that are constant inside each primitive; None in forms whose colours vary in a primitive."""
        return self.rgb


@dataclass(frozen=True)
class CustomColour(PrimitiveTensors):
    """A colour given by PyTorch code for pairs of ray and primitive; only the reference backend renders it.

    Attributes:
        radiance: function (prim, x, d) -> (M, C) colours, for primitive indices (M,), chord middles (M, 3), scene
            units, and ray directions (M, 3).
    """

    per_primitive: ClassVar[bool] = False
    flat: ClassVar[None] = None
    radiance: Callable[[Tensor, Tensor, Tensor], Tensor]
    channels: int  # C

    def fault(self, sizes: Sizes) -> str | None:
        if isinstance(self.channels, bool) or not isinstance(self.channels, int) or self.channels < 1:
            return f"channels has value {self.channels!r}; expected a whole number of at least 1"
        sizes["C"] = (self.channels, "channels")
        return labelled_fault("radiance", function_fault(self.radiance))

    def shaded(self, factors: Tensor | None) -> CustomColour:
        """Return these colours multiplied by ``factors`` (N,), at least 0, or unchanged if ``factors`` is None."""
        if factors is None:
            return self

        def radiance(prim: Tensor, x: Tensor, d: Tensor) -> Tensor:
            found = self.radiance(prim, x, d)
            return found * factors.to(found)[prim, None]

        return CustomColour(radiance, self.channels)

    def chord_colours(self, pairs: PrimitiveChords) -> Tensor:
        """Return the (M, C) colours of M chords as ``radiance`` returns them, without a check."""
        return self.radiance(pairs.prim, pairs.points, pairs.direction)

    def at_primitive_centers(self, geometry: Geometry, position: Tensor) -> Tensor:
        """Return the (N, C) colours at the centres of primitives for a camera at ``position`` (3,), without a check."""
        means = geometry.means
        directions = torch.nn.functional.normalize(means - position.to(means), dim=1)
        return self.radiance(torch.arange(geometry.count, device=means.device), means, directions)


@dataclass(frozen=True)
class RayNet(PrimitiveTensors):
    """A colour network per primitive, evaluated at the middle of each ray's chord.

        c(pixel) = max(0, base + Wout cos(Wx . x~_m + bias)),   x~_m = (x_m - mu)/m

    x_m is the middle of the part of the chord behind the near plane, mu the primitive's centre and m its longest
    semi-axis. The network has one hidden layer of H cosine units, H = 0 to 256. Inputs that are constant in a primitive
    (view direction, light) are already part of ``bias``, ``Wout`` and ``base``. A colour of exactly 0 still passes its
    gradient, as with ``clamp_min``.
    """

    per_primitive: ClassVar[bool] = True
    flat: ClassVar[None] = None
    shapes: ClassVar[Shapes] = {
        "Wx": (("N", "H", 3),),
        "bias": (("N", "H"),),
        "base": (("N", "C"),),
        "Wout": (("N", "C", "H"),),
    }

    Wx: Tensor  # (N, H, 3) frequencies on scene axes, radians per m
    bias: Tensor  # (N, H) phases, radians
    Wout: Tensor  # (N, C, H) amplitudes, any number of channels C
    base: Tensor  # (N, C) offsets

    @property
    def channels(self) -> int:
        return int(self.base.shape[1])

    @property
    def hidden(self) -> int:
        return int(self.Wx.shape[1])

    def shaded(self, factors: Tensor | None) -> RayNet:
        """Return these colours multiplied by ``factors`` (N,), at least 0, or unchanged if ``factors`` is None."""
        if factors is None:
            return self
        factors = factors.to(self.base)
        return RayNet(self.Wx, self.bias, self.Wout * factors[:, None, None], self.base * factors[:, None])

    def primitive_radiance(self, prim: Tensor, local: Tensor) -> Tensor:
        """Return the (M, C) float64 colours of primitives ``prim`` (M,) at one point each; differentiable.

        ``local`` (M, 3) has the points relative to the primitives, (x - mu)/m.
        """
        phase = (self.Wx.double()[prim] * local[:, None, :]).sum(-1) + self.bias.double()[prim]
        mixed = (self.Wout.double()[prim] * phase.cos()[:, None, :]).sum(-1)
        return (self.base.double()[prim] + mixed).clamp_min(0)

    def chord_colours(self, pairs: PrimitiveChords) -> Tensor:
        """Return the (M, C) float64 colours of M chords, evaluated at their middles; differentiable."""
        return self.primitive_radiance(pairs.prim, pairs.local)

    def at_primitive_centers(self, geometry: Geometry, position: Tensor) -> Tensor:
        """Return the (N, C) float64 colours at the primitives' centres; the colours do not depend on ``position``."""
        middles = torch.zeros_like(geometry.means, dtype=torch.float64)
        return self.primitive_radiance(torch.arange(geometry.count, device=middles.device), middles)


LoweredColour = Constant | RayNet | CustomColour
"""Colour in closed form: the result type of :meth:`ColourField.lower`.

The attribute ``per_primitive`` states whether, in one view, the colour at a primitive's centre may replace the colour
of the whole primitive, exactly (:class:`Constant`) or approximately (:class:`RayNet`).
"""

Shade = Callable[[Tensor], Tensor]
"""Function that maps the scene points (M, 3), float64, seen in M pixels to (M,) factors on the pixels' light.

The factors have no gradient.
"""


@dataclass(frozen=True)
class Shading:
    """Factors on the colours of a frame, such as shadows, that depend on all primitives; without gradient.

    Attributes:
        primitives: (M,) factors of at least 0, one per primitive of the frame; None: all factors are 1.
        pixels: function that returns one factor per pixel, from the scene point at the pixel's mean depth (deferred
            shading); None: all factors are 1.
    """

    primitives: Tensor | None = None
    pixels: Shade | None = None

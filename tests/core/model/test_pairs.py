"""Closed forms know their mathematics: what is asked along chords, against quadrature and against what the forms'
tensors say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neuprim.core.model.cosine import cosine_density
from neuprim.core.model.fields import Constant, Cosine, CustomColour, CustomDensity, RayNet
from neuprim.core.model.geometry import PrimitiveChords
from neuprim.core.model.primitives import LoweredPrimitives
from tests import scenes

M = 40


def model(hidden: int | None = None) -> LoweredPrimitives:
    return scenes.lowered(scenes.tensors(12, 5, seed=2, dtype=torch.float64, hidden=hidden))


def chords(low: LoweredPrimitives) -> tuple[PrimitiveChords, Tensor, Tensor, Tensor, Tensor]:
    """M pieces of rays inside primitives, and how they were made: origins, directions, t0, t1."""
    g = torch.Generator().manual_seed(3)
    prim = torch.randint(0, low.geometry.count, (M,), generator=g)
    reach = low.geometry.scales.amin(-1)[prim]
    d = torch.nn.functional.normalize(torch.randn(M, 3, generator=g, dtype=torch.float64), dim=-1)
    a, b = torch.rand(2, M, generator=g, dtype=torch.float64) * reach * 0.9
    o = low.geometry.means[prim] - 2.0 * d
    t0, t1 = 2.0 - a, 2.0 + b
    return PrimitiveChords.of(low.geometry, prim, o, d, t0, t1), o, d, t0, t1


def test_pairs_are_measured_in_the_primitive_and_given_back_in_the_scene() -> None:
    low = model()
    pairs, o, d, t0, t1 = chords(low)
    m = low.geometry.length_scale[pairs.prim]
    middle = o + ((t0 + t1) / 2)[:, None] * d
    assert len(pairs) == M and torch.allclose(pairs.half * m, (t1 - t0) / 2)
    assert torch.allclose(pairs.local, (middle - low.geometry.means[pairs.prim]) / m[:, None])
    assert torch.allclose(pairs.points, middle) and torch.equal(pairs.origins, o)
    assert all(torch.allclose(x, y) for x, y in zip(pairs.ends, (t0, t1), strict=True))


def test_optical_depths_are_integrals() -> None:
    low = model()
    pairs, o, d, t0, t1 = chords(low)
    nodes, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(40))
    t = (t0 + t1)[:, None] / 2 + (t1 - t0)[:, None] / 2 * nodes
    x = (o[:, None] + t[..., None] * d[:, None]).reshape(-1, 3)
    assert isinstance(low.density, Cosine)
    sigma = cosine_density(low.density, low.geometry, pairs.prim.repeat_interleave(40), x).reshape(M, 40)
    expected = (sigma * weights).sum(-1) * (t1 - t0) / 2
    assert expected.abs().max() > 0.05
    assert torch.allclose(low.optical_depth(pairs), expected, rtol=1e-9, atol=1e-12)


def test_code_is_asked_in_scene_units() -> None:
    low = model()
    pairs, o, d, t0, t1 = chords(low)
    asked: list[Tensor] = []

    def line_integral(*given: Tensor) -> Tensor:
        asked.extend(given)
        return (given[4] - given[3]).float()

    found = replace(low, density=CustomDensity(line_integral)).optical_depth(pairs)
    assert found.dtype == torch.float64 and torch.allclose(found, t1 - t0, rtol=1e-6)
    for x, y in zip(asked, (pairs.prim, o, d, t0, t1), strict=True):
        assert torch.allclose(x, y)


def test_colours_along_chords_and_at_centres() -> None:
    low, net = model(), model(hidden=4)
    pairs, _, d, _, _ = chords(low)
    position = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    flat = low.colour
    assert isinstance(flat, Constant) and flat.flat is flat.rgb and flat.per_primitive
    assert torch.equal(low.chord_colours(pairs), flat.rgb[pairs.prim]) and low.center_colors(position) is flat.rgb
    varies = net.colour
    assert isinstance(varies, RayNet) and varies.flat is None and varies.per_primitive
    phase = (varies.Wx[pairs.prim] * pairs.local[:, None]).sum(-1) + varies.bias[pairs.prim]
    expected = (varies.base[pairs.prim] + (varies.Wout[pairs.prim] * phase.cos()[:, None]).sum(-1)).clamp_min(0)
    assert torch.allclose(net.chord_colours(pairs), expected)
    assert (net.chord_colours(pairs) - net.center_colors(position)[pairs.prim]).abs().max() > 0.01
    code = CustomColour(lambda prim, x, d: torch.cat([x, d[:, :1]], 1), 4)
    opaque = replace(low, colour=code)
    assert code.flat is None and not code.per_primitive
    assert torch.allclose(opaque.chord_colours(pairs), torch.cat([pairs.points, d[:, :1]], 1))
    towards = torch.nn.functional.normalize(low.geometry.means - position, dim=1)
    assert torch.allclose(opaque.center_colors(position), torch.cat([low.geometry.means, towards[:, :1]], 1))

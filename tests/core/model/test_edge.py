"""Soft edges: integrals along chords and over balls against quadrature, thin chords, far phases, gains."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import special
from torch import Tensor

from neuprim.config import compose
from neuprim.core.model.cosine import CosineDensity, cosine_density
from neuprim.core.model.edge import EDGES, NORMS, edge_profile, soft_edge_chord_integral, spherical_bessel
from neuprim.core.model.fields import Cosine
from neuprim.core.model.geometry import Geometry, PrimitiveChords
from neuprim.core.model.schema import InitContext
from tests import scenes

F64 = torch.float64
WIDE = torch.cat([torch.logspace(-8, 3, 3000, dtype=F64), torch.tensor([0.0, 1.999999, 2.0, 2.000001], dtype=F64)])


def test_bessel_functions_are_scipy_s() -> None:
    for z in (WIDE, -WIDE):
        for n, found in enumerate(spherical_bessel(z, 5)):
            sign = 1 if n % 2 == 0 else torch.sign(z).where(z != 0, torch.ones_like(z)).numpy()
            assert np.abs(found.numpy() - sign * special.spherical_jn(n, z.abs().numpy())).max() <= 1e-14


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_profiles_are_those_of_the_formulas(order: int) -> None:
    """Against the integral that defines them, whose integrand is (1 - u^2)^order cos(z u)."""
    x, w = np.polynomial.legendre.leggauss(1200)
    weight = w * (1 - x * x) ** order
    z = np.concatenate([np.logspace(-7, 3, 400), [0.0]])
    exact = (weight * np.cos(z[:, None] * x)).sum(1) / weight.sum()
    assert np.abs(edge_profile(torch.from_numpy(z), order).numpy() - exact).max() <= 2e-13


@pytest.mark.parametrize("edge", [1, 2])
@pytest.mark.parametrize("reach", [1e-4, 0.5, 3.0, 40.0, 1000.0])
def test_any_part_of_a_chord(edge: int, reach: float) -> None:
    """Any quadratic, as a near plane leaves it, any phase, rates up to ``reach``; relative to the largest that the
    integral could be."""
    g = torch.Generator().manual_seed(edge)
    count, neurons = 60, 3
    middle, half = torch.rand(count, generator=g, dtype=F64) * 1.8 - 0.9, torch.rand(count, generator=g, dtype=F64)
    half = half * (1 - middle.abs())  # parts [middle - half, middle + half] of the whole chord [-1, 1] of a ball
    quadratic = (1 - middle**2, -2 * middle * half, -(half**2))
    phase, z, amplitude = (torch.randn(count, neurons, generator=g, dtype=F64) for _ in range(3))
    z, offset = z.clamp(-1, 1) * reach, torch.randn(count, generator=g, dtype=F64)
    found = soft_edge_chord_integral(quadratic, edge, phase, z, amplitude, offset)
    u, w = (torch.from_numpy(q) for q in np.polynomial.legendre.leggauss(1400))
    f = offset[:, None] + (amplitude[..., None] * (phase[..., None] + z[..., None] * u).cos()).sum(1)
    weight = (quadratic[0][:, None] + quadratic[1][:, None] * u + quadratic[2][:, None] * u**2) ** edge
    exact = (w * weight * f).sum(-1) / 2
    largest = (w * weight).sum(-1) / 2 * (offset.abs() + amplitude.abs().sum(-1))
    assert ((found - exact).abs() / largest).max() <= 1e-12


def test_gradients_of_a_part_of_a_chord() -> None:
    g = torch.Generator().manual_seed(0)

    def leaf(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=F64).requires_grad_()

    for edge in (1, 2):
        parts = [leaf(5) for _ in range(3)]
        rest = [leaf(5, 2), leaf(5, 2), leaf(5, 2), leaf(5)]
        rest[1].data[0, 0], rest[1].data[1, 0] = 0.0, 2.0  # where series and recursion meet
        assert torch.autograd.gradcheck(
            lambda a, b, c, *more, p=edge: soft_edge_chord_integral((a, b, c), p, *more),
            (*parts, *rest),
            atol=1e-7,
            rtol=1e-5,
        )


@pytest.mark.parametrize("edge", EDGES)
def test_a_chord_is_the_integral_of_the_density(edge: int) -> None:
    """Whole chords and parts of them, of a lowered form, against quadrature of the density at points."""
    t = scenes.tensors(8, 4, seed=2, dtype=F64)
    geometry = Geometry(t["means"], t["log_scales"], t["quats"])
    form = Cosine(t["W1"], t["b1"], t["w2"], t["b2"], 20.0, edge)
    g = torch.Generator().manual_seed(3)
    prim = torch.arange(8).repeat(10)
    d, y = (torch.nn.functional.normalize(torch.randn(80, 3, generator=g, dtype=F64), dim=-1) for _ in range(2))
    y = y * torch.rand(80, 1, generator=g, dtype=F64)
    start = geometry.means[prim] + (geometry.rotations[prim] @ (geometry.scales[prim] * y)[:, :, None])[..., 0]
    v = (geometry.rotations[prim].transpose(1, 2) @ d[:, :, None])[..., 0] / geometry.scales[prim]
    a, b = v.square().sum(-1), (y * v).sum(-1)
    root = (b * b + a * (1 - y.square().sum(-1))).sqrt()
    t0, t1 = (-b - root) / a, (-b + root) / a
    t0[40:] = torch.lerp(t0[40:], t1[40:], torch.rand(40, generator=g, dtype=F64))  # as a near plane cuts
    found = form.optical_depth(PrimitiveChords.of(geometry, prim, start, d, t0, t1))
    x, w = (torch.from_numpy(q) for q in np.polynomial.legendre.leggauss(200))
    at = t0[:, None] + (t1 - t0)[:, None] * (x + 1) / 2
    points = (start[:, None] + at[..., None] * d[:, None]).reshape(-1, 3)
    sigma = cosine_density(form, geometry, prim.repeat_interleave(200), points)
    exact = (sigma.reshape(80, 200) * w).sum(-1) * (t1 - t0) / 2
    largest = (t1 - t0) * (t["b2"].abs()[:, 0] + t["w2"].abs().sum(-1))[prim] / geometry.length_scale[prim]
    assert ((found - exact).abs() / largest).max() <= 1e-12


def test_a_sphere_starts_as_opaque_whatever_its_edge() -> None:
    for edge in EDGES:
        spec = next(s for s in CosineDensity(0, edge=edge).parameters() if s.name == "b2")
        context = InitContext(torch.zeros(3, 3), torch.ones(3), torch.full((3, 3), 0.5), torch.Generator())
        offset = spec.init(context).double()
        assert torch.allclose(1 - (-NORMS[edge] * offset).exp(), torch.full_like(offset, 0.8), atol=1e-6)


def test_another_form_takes_none_of_the_presets_settings() -> None:
    for words, density in (
        ([], {"form": "cosine", "edge": 2, "gain": True}),
        (["model.density.form=gaussian"], {"form": "gaussian"}),
        (["model.density={form: gaussian}"], {"form": "gaussian"}),
        (["model.density.form=cosine", "model.density.edge=1"], {"form": "cosine", "edge": 1, "gain": True}),
    ):
        assert compose(["task=static", *words], check_output=False).model.density == density

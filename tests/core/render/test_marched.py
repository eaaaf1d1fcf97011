"""Sampled chords come to the closed form as the midpoint rule does: four times closer for twice the samples, sixteen
times where the density fades to nothing with its slope."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import Constant, Cosine, CustomDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.quadrature import compare_quadrature

EXACT = RenderSettings(backend="reference", alpha_min=0.0, transmittance_min=0.0)


def scene(edge: int = 0, neurons: int = 4, count: int = 12) -> Lowered:
    g = torch.Generator().manual_seed(edge + 1)

    def uniform(*shape: int) -> torch.Tensor:
        return 2 * torch.rand(shape, generator=g, dtype=torch.float64) - 1

    geometry = Geometry(0.6 * uniform(count, 3), 0.4 * uniform(count, 3) - 0.9, uniform(count, 4))
    density = Cosine(
        0.25 * uniform(count, neurons, 3),
        uniform(count, neurons),
        uniform(count, neurons),
        2 + 0.5 * uniform(count, 1),
        12.0,
        edge,
    )
    return Lowered(geometry, density, Constant(uniform(count, 3).abs()))


def camera(size: int = 20) -> Camera:
    view = look_at(torch.tensor([0.3, -3.0, 0.8]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(view, 1.1 * size, 1.1 * size, size / 2, size / 2, size, size)


@pytest.mark.parametrize(("edge", "order"), [(0, 2), (1, 2), (2, 4)])
def test_sampling_converges_to_the_closed_form(edge: int, order: int) -> None:
    found = compare_quadrature(scene(edge), camera(), EXACT, rounds=2)
    assert [way.samples for way in found] == [0, 1, 2, 4, 8, 16, 32, 64]
    assert math.isinf(found[0].psnr) and found[0].max_abs == 0 and found[1].max_abs > 1e-3
    assert len({way.chords for way in found}) == 1 and found[0].chords > 200 and all(way.seconds > 0 for way in found)
    psnrs = [way.psnr for way in found[1:]]
    assert psnrs == sorted(psnrs)
    assert psnrs[-1] - psnrs[-3] == pytest.approx(order * 20 * math.log10(4), abs=1)


def test_the_near_plane_cuts_chords_of_both_alike() -> None:
    cut = replace(EXACT, near=2.8)
    found = compare_quadrature(scene(2), camera(), cut, samples=(64, 256), rounds=1)
    assert found[2].max_abs < 1e-5 and found[2].max_abs < 0.2 * found[1].max_abs


def test_the_closed_form_is_the_oracle_itself() -> None:
    """Both images that are compared come out of the reference backend; many samples are its image."""
    lowered = scene(0)
    oracle = render_lowered(lowered, camera(), EXACT).rgb
    (closed, fine) = compare_quadrature(lowered, camera(), EXACT, samples=(512,), rounds=1)
    assert closed.samples == 0 and fine.max_abs < 1e-6 and oracle.abs().max() > 0.1


def test_a_density_without_a_closed_form_is_refused() -> None:
    opaque = replace(scene(), density=CustomDensity(lambda prim, *ray: torch.zeros(len(prim))))
    with pytest.raises(ConfigError, match="density CustomDensity has no closed form"):
        compare_quadrature(opaque, camera(), EXACT)

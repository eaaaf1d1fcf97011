"""Sampled chords converge to the closed form as the midpoint rule does: four times closer for twice the samples,
sixteen times where the density fades to nothing with its slope."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import Constant, Cosine, CustomDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings
from neuprim.core.render.quadrature import compare_quadrature
from tests import scenes

EXACT = RenderSettings(backend="reference", alpha_min=0.0, transmittance_min=0.0)
CAMERA = scenes.camera(20, 20)


def scene(edge: int = 0, neurons: int = 4, count: int = 12) -> Lowered:
    g = torch.Generator().manual_seed(edge + 1)

    def uniform(*shape: int) -> torch.Tensor:
        return 2 * torch.rand(shape, generator=g, dtype=torch.float64) - 1

    geometry = Geometry(0.6 * uniform(count, 3), 0.4 * uniform(count, 3) - 0.9, uniform(count, 4))
    waves = (0.25 * uniform(count, neurons, 3), uniform(count, neurons), uniform(count, neurons))
    density = Cosine(*waves, 2 + 0.5 * uniform(count, 1), 12.0, edge)
    return Lowered(geometry, density, Constant(uniform(count, 3).abs()))


@pytest.mark.parametrize(("edge", "order"), [(0, 2), (1, 2), (2, 4)])
def test_sampling_converges_to_the_closed_form(edge: int, order: int) -> None:
    found = compare_quadrature(scene(edge), CAMERA, EXACT, rounds=2)
    assert [way.samples for way in found] == [0, 1, 2, 4, 8, 16, 32, 64]
    assert math.isinf(found[0].psnr) and found[0].max_abs == 0 and found[1].max_abs > 1e-3
    assert len({way.chords for way in found}) == 1 and found[0].chords > 200 and all(way.seconds > 0 for way in found)
    psnrs = [way.psnr for way in found[1:]]
    assert psnrs == sorted(psnrs)
    assert psnrs[-1] - psnrs[-3] == pytest.approx(order * 20 * math.log10(4), abs=1)


def test_the_near_plane_cuts_chords_of_both_alike() -> None:
    found = compare_quadrature(scene(2), CAMERA, replace(EXACT, near=2.8), samples=(64, 256), rounds=1)
    assert found[2].max_abs < 1e-5 and found[2].max_abs < 0.2 * found[1].max_abs


def test_a_density_without_a_closed_form_is_refused() -> None:
    custom = replace(scene(), density=CustomDensity(lambda prim, *ray: torch.zeros(len(prim))))
    with pytest.raises(ConfigError, match="density CustomDensity has no closed form"):
        compare_quadrature(custom, CAMERA, EXACT)

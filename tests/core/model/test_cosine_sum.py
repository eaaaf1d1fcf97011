"""The sum of two cosine forms is the sum of their densities, of their line integrals and of their gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from neuprim.conformance.field_checks import conformance_points_inside, random_chords
from neuprim.core.errors import FormError
from neuprim.core.model.cosine import cosine_density
from neuprim.core.model.fields import Cosine
from neuprim.core.model.geometry import Geometry, PrimitiveChords
from neuprim.core.model.tensors import MOST_UNITS
from tests import scenes

COUNT = 12


def form(neurons: int, omega0: float, seed: int, flat: bool = False, dtype: torch.dtype = torch.float64) -> Cosine:
    t = scenes.tensors(COUNT, neurons, seed=seed, dtype=dtype)
    return Cosine(t["W1"], t["b1"], t["w2"], t["b2"][:, 0] if flat else t["b2"], omega0)


def where() -> Geometry:
    t = scenes.tensors(COUNT, seed=5, dtype=torch.float64)
    return Geometry(t["means"], t["log_scales"], t["quats"])


PAIRS = {
    "one omega0": (form(3, 30.0, 1), form(5, 30.0, 2)),
    "two of them": (form(3, 30.0, 1), form(5, 4.5, 2)),
    "of other signs": (form(3, -2.0, 1), form(2, 30.0, 2)),
    "the first is constant": (form(3, 0.0, 1), form(5, 4.5, 2)),
    "the second is constant": (form(3, 7.0, 1), form(5, 0.0, 2)),
    "both are": (form(3, 0.0, 1), form(2, 0.0, 2)),
    "no neurons": (form(0, 30.0, 1), form(2, 4.5, 2)),
    "flat offsets": (form(3, 30.0, 1, flat=True), form(5, 4.5, 2)),
    "more flat offsets": (form(3, 30.0, 1), form(5, 4.5, 2, flat=True)),
}


@pytest.mark.parametrize("name", PAIRS)
def test_densities_and_line_integrals_add_up(name: str) -> None:
    first, second = PAIRS[name]
    both, geometry = first + second, where()
    assert both.W1.shape == (COUNT, first.W1.shape[1] + second.W1.shape[1], 3) and both.b2.shape == first.b2.shape
    generator = torch.Generator().manual_seed(1)
    prim = torch.arange(COUNT).repeat(8)
    x = conformance_points_inside(geometry, prim, generator)
    found, a, b = (cosine_density(f, geometry, prim, x) for f in (both, first, second))
    assert (found - a - b).abs().max() <= 1e-12 * a.abs().max() and b.abs().max() > 0.1
    ray = random_chords(geometry, prim, generator)
    whole, a, b = (f.optical_depth(PrimitiveChords.of(geometry, prim, *ray)) for f in (both, first, second))
    assert (whole - a - b).abs().max() <= 1e-12 * a.abs().max() and b.abs().max() > 0.01


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (
            replace(form(3, 30.0, 2), W1=torch.ones(11, 3, 3)),
            r"the second form: W1 has shape \(11, 3, 3\); expected .*N=12 ",
        ),
        (
            replace(form(3, 30.0, 2), w2=torch.ones(COUNT, 1)),
            r"the second form: w2 has shape \(12, 1\); expected \(12, 3\)",
        ),
        (form(MOST_UNITS, 30.0, 2), r"3 \+ 256 neurons; expected at most 256"),
    ],
)
def test_what_cannot_be_added_is_refused(second: Cosine, message: str) -> None:
    with pytest.raises(FormError, match=f"^sum of two Cosine forms: {message}"):
        form(3, 30.0, 1) + second

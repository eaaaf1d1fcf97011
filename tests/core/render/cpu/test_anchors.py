"""Where a primitive is anchored: at its centre as soon as that is 1.5 radii in front of the camera, however far off the
near plane is."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from neuprim.core.render import RenderSettings
from neuprim.core.render import layout as L
from tests import scenes
from tests.core.render.cpu.frames import frame_of
from tests.numerics.cases import along_z
from tests.numerics.equivalence import assert_same_frame

RADIUS = 0.4
NEAR = 0.01  # of RenderSettings


def needle(thin: float = 0.03, slant: float = 0.0) -> dict[str, Tensor]:
    """One primitive across the view, ``thin`` radii thick, with four neurons; ``slant`` turns it about every axis."""
    t = scenes.tensors(1, 4, seed=11)
    t["means"][:] = 0.0
    t["log_scales"] = (RADIUS * torch.tensor([[1.0, thin, thin]])).log()
    t["quats"] = torch.tensor([[1.0, 0.5 * slant, slant, -2.0 * slant]])
    t["b2"] *= 0.3
    return t


@pytest.mark.parametrize(
    ("radii", "at_centre"),
    [(1.49, False), (1.51, True), (1.5 + 0.5 * NEAR / RADIUS, True), (1.51 + NEAR / RADIUS, True)],
)
def test_the_anchor_is_the_centre_from_one_and_a_half_radii(radii: float, at_centre: bool) -> None:
    camera = along_z(40, 50.0, distance=radii * RADIUS)
    frame = frame_of(needle(), camera)
    assert (frame.projected.rows[0, L.TC] > 0) == at_centre
    assert frame.request.stats.extra["float64"] == (0 if at_centre else 1), (
        "thin primitives that are anchored at the camera are drawn in float64"
    )


@pytest.mark.parametrize("near", [NEAR, 0.3, 0.62, 0.9])
@pytest.mark.parametrize("radii", [1.4, 1.51, 1.6, 1.9])
def test_it_equals_the_reference_on_either_side(radii: float, near: float) -> None:
    """The near plane far in front of the primitive, through it, and beyond its centre."""
    _, slow = assert_same_frame(
        needle(0.2, 0.1), along_z(40, 50.0, distance=radii * RADIUS), RenderSettings(depth=True, near=near)
    )
    assert slow.output.alpha.max() > 0.05 or near == 0.9

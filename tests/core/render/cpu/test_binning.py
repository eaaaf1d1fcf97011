"""The tile lists of a frame: every pixel that a ray through it meets is in a tile that lists the primitive, front to
back."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render import layout as L
from neuprim.core.render.cpu.backend import _PreparedFrame
from neuprim.core.render.layout import TILE
from tests import scenes
from tests.numerics.cases import along_z
from tests.numerics.equivalence import assert_same_frame


def test_lists_hold_every_hit_once_and_front_to_back() -> None:
    t, camera = scenes.tensors(700, 2, seed=3, radius=0.07), scenes.camera(75, 50)
    lists = frame_of(t, camera).lists
    depth = (t["means"].double() @ camera.viewmat[2, :3].double() + camera.viewmat[2, 3]).numpy()
    across = -(-75 // TILE)
    listed = [set(lists.ids[lists.starts[k] : lists.starts[k + 1]].tolist()) for k in range(len(lists.starts) - 1)]
    assert sum(len(tile) for tile in listed) == lists.pairs, "no primitive is twice in a tile"
    for k in range(len(listed)):
        ids = lists.ids[lists.starts[k] : lists.starts[k + 1]]
        assert (depth[ids][1:] >= depth[ids][:-1] - 1e-6).all()
    for i in range(0, 700, 23):  # alone in the image, each shows where it is
        one = {name: value[i : i + 1] for name, value in t.items()}
        alone = render_lowered(scenes.lowered(one), camera, RenderSettings(backend="cpu", alpha_min=0.0)).alpha
        for y, x in alone.nonzero().tolist():
            assert i in listed[y // TILE * across + x // TILE]


def test_slots_lead_from_every_primitive_to_its_pairs() -> None:
    lists = frame_of(scenes.tensors(700, 2, seed=3, radius=0.07), scenes.camera(75, 50)).lists
    assert sorted(lists.slots.tolist()) == list(range(lists.pairs))
    for i in range(700):
        assert (lists.ids[lists.slots[lists.first[i] : lists.first[i + 1]]] == i).all()


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


def frame_of(t: dict[str, torch.Tensor], camera: Camera, threads: int = 1) -> _PreparedFrame:
    leaves = {k: v.clone().requires_grad_() for k, v in t.items()}
    node = render_lowered(scenes.lowered(leaves), camera, RenderSettings(backend="cpu", threads=threads)).rgb.grad_fn
    while not hasattr(node, "frame"):
        assert node is not None
        node = node.next_functions[0][0]
    frame: _PreparedFrame = node.frame
    return frame

"""The tile lists of a frame: every pixel that a ray through it meets is in a tile that lists the primitive, front to
back."""

from __future__ import annotations

from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.layout import TILE
from tests import scenes
from tests.core.render.cpu.frames import frame_of


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

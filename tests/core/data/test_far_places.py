"""Which data sets are moved to the origin, and that all that has positions moves with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.cameras.world import World
from neuprim.core.data import PointCloud, camera_extent
from neuprim.core.data.dataset import choose_dataset_world, dataset_focus_point
from neuprim.core.data.points_file import read_points
from neuprim.core.errors import NeuprimWarning
from neuprim.core.io.ply import write_ply


def ring(offset: tuple[float, ...], radius: float = 4.0) -> list[Camera]:
    there, up = torch.tensor(offset, dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0])
    eyes = [torch.tensor([radius * np.cos(a), radius * np.sin(a), 0.2 * radius], dtype=torch.float64) for a in range(6)]
    return [Camera(look_at(eye + there, there, up), 50.0, 50.0, 16.0, 16.0, 32, 32) for eye in eyes]


@pytest.mark.parametrize("offset", [(0, 0, 0), (1, -2, 400), (-300, 0, 0)])
def test_what_is_near_stays(offset: tuple[float, ...]) -> None:
    assert choose_dataset_world(ring(offset)).identity


@pytest.mark.parametrize(
    ("offset", "radius", "origin"),
    [
        ((448251.0, 5411932.0, 210.0), 4.0, (448250, 5411930, 210)),
        ((-5e6, 0, 0), 4.0, (-5e6, 0, 0)),
        ((0, 1e3, 0), 1.0, (0, 1e3, 0)),
        ((7.123456, 0, 0), 4e-3, (7.12, 0, 0)),
        ((1e9, 0, 12345.0), 4e3, (1e9, 0, 10000)),
    ],
)
def test_what_is_far_moves_by_a_round_number(
    offset: tuple[float, ...], radius: float, origin: tuple[float, ...]
) -> None:
    world = choose_dataset_world(ring(offset, radius))
    assert world.world_points(torch.zeros(3, dtype=torch.float64)).tolist() == [
        pytest.approx(x, rel=1e-12) for x in origin
    ]
    moved = world.scene_camera(ring(offset, radius)[0])
    assert torch.equal(moved.viewmat[:3, :3], ring(offset, radius)[0].viewmat[:3, :3])
    assert float(moved.position.norm()) < 20 * radius


def test_rotations_of_few_digits_do_not_move_cameras_far_away() -> None:
    """A file's rotation with an error of 1e-4 would put a transposed camera 500 m beside its place in UTM."""
    near, offset = ring((0, 0, 0)), torch.tensor([4e5, 5e6, 0.0], dtype=torch.float64)
    far = []
    for camera in near:
        turn = (camera.viewmat[:3, :3] * 1e4).round() / 1e4
        view = torch.eye(4, dtype=torch.float64)
        view[:3, :3], view[:3, 3] = turn, -turn @ (camera.position + offset)  # as opengl_to_viewmat makes it
        far.append(replace(camera, viewmat=view))
    world = choose_dataset_world(far)
    assert world.world_points(torch.zeros(3, dtype=torch.float64)).tolist() == offset.tolist()
    for before, after in zip(near, (world.scene_camera(c) for c in far), strict=True):
        assert torch.allclose(before.position, after.position, atol=2e-3)


def test_points_in_doubles_keep_their_digits(tmp_path) -> None:  # type: ignore[no-untyped-def]
    rows = np.zeros(2, [("x", "<f8"), ("y", "<f8"), ("z", "<f8")])
    rows["x"], rows["y"] = [448251.0123, 448249.5], 5411932.25
    write_ply(tmp_path / "p.ply", rows)
    found = read_points(tmp_path / "p.ply", 3, "srgb").within(World.at([448250.0, 5411930.0, 0.0]))
    assert found.means.dtype == torch.float32
    assert torch.allclose(found.means, torch.tensor([[1.0123, 2.25, 0.0], [-0.5, 2.25, 0.0]]), atol=1e-6)


def test_gaussians_turn_and_grow_with_their_places() -> None:
    """World x is scene y, and a world unit is two scene units."""
    world = World(torch.tensor([[0, -2, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]], dtype=torch.float64))
    cloud = PointCloud(
        torch.ones(1, 3), torch.ones(1, 3), quats=torch.tensor([[1.0, 0, 0, 0]]), deviations=torch.tensor([[1.0, 2, 3]])
    )
    found = cloud.within(world)
    assert (
        found.means.tolist() == [[3, 8, 9]]
        and found.deviations is not None
        and found.deviations.tolist() == [[2, 4, 6]]
    )
    assert found.quats is not None and torch.allclose(found.quats.abs(), torch.tensor([[0.5**0.5, 0, 0, 0.5**0.5]]))


def test_a_camera_far_from_all_others_says_nothing_about_place_and_scale() -> None:
    lost = replace(ring((0, 0, 0))[0], viewmat=ring((3e6, 0, 0), 4e6)[0].viewmat)
    with pytest.warns(NeuprimWarning, match=r"1 of 7 cameras lie far from all others, the first at 7e\+06"):
        assert choose_dataset_world([*ring((0, 0, 0)), lost]).identity
    assert camera_extent([*ring((0, 0, 0)), lost]) == camera_extent(ring((0, 0, 0)))
    assert torch.equal(dataset_focus_point([*ring((0, 0, 0)), lost]), dataset_focus_point(ring((0, 0, 0))))

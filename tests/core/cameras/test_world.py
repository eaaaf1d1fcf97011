"""The transform between a scene and the world of the user's files."""

from __future__ import annotations

import math

import pytest
import torch

from neuprim.core.cameras import Camera, check_viewmat, look_at
from neuprim.core.cameras.world import World
from neuprim.core.errors import DataError

POINTS = torch.tensor([[0.0, 0.0, 0.0], [1.0, -2.0, 0.5], [-0.3, 0.4, 3.0]], dtype=torch.float64)


def turned(scale: float = 0.25, angle: float = 0.7) -> World:
    c, s = scale * math.cos(angle), scale * math.sin(angle)
    return World(torch.tensor([[c, -s, 0, 3e5], [s, c, 0, -20], [0, 0, scale, 0.5], [0, 0, 0, 1]], dtype=torch.float64))


@pytest.mark.parametrize("world", [World.at([448250.0, 5411930.0, 210.0]), turned()])
def test_a_camera_sees_the_same_in_both(world: World) -> None:
    scene = Camera(
        look_at(torch.tensor([3.0, -4, 2]), POINTS[1], torch.tensor([0.0, 0, 1])), 90.0, 80.0, 33.0, 20.0, 64, 48
    )
    other = world.world_camera(scene)
    check_viewmat(other.viewmat, "it")
    there = world.world_points(POINTS)
    pixels, depth = other.project(there)
    expected, z = scene.project(POINTS)
    assert torch.allclose(pixels, expected, atol=1e-5) and torch.allclose(depth * world.scale, z, rtol=1e-7)
    assert torch.allclose(world.scene_points(there), POINTS, atol=1e-9)
    assert torch.allclose(world.scene_camera(other).viewmat, scene.viewmat, atol=1e-8)
    assert torch.equal(World.of({"world": world.to_json()}, "it").scene_from_world, world.scene_from_world)


def test_an_identity_changes_nothing() -> None:
    camera = Camera(torch.eye(4), 1.0, 1.0, 0.5, 0.5, 1, 1)
    assert (
        World().scene_camera(camera) is camera
        and World().world_points(POINTS) is POINTS
        and World.of({}, "it").identity
    )


@pytest.mark.parametrize("diagonal", [(1.0, 1, 2), (1, 1, -1), (0, 0, 0), (math.nan, 1, 1)])
def test_only_similarities_are_taken(diagonal: tuple[float, ...]) -> None:
    with pytest.raises(DataError, match=r"expected a .* rotation, one scale and an offset"):
        World(torch.diag(torch.tensor([*diagonal, 1.0], dtype=torch.float64))).validate("it")

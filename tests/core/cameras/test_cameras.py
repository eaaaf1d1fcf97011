"""Cameras: axes, half-pixel convention, refusals, attributes of OpenEXR files, and the transform to the world."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, check_viewmat, look_at, orbit
from neuprim.core.cameras.pinhole import camera_exr_attributes
from neuprim.core.cameras.world import World
from neuprim.core.errors import DataError
from tests import scenes

EYE = torch.eye(4, dtype=torch.float64)
Z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def camera(view: Tensor = EYE) -> Camera:
    return Camera(view, 50.0, 60.0, 21.0, 14.0, 40, 30)


def project(camera: Camera, point: Tensor) -> Tensor:
    p = camera.K @ (camera.viewmat[:3, :3] @ point.double() + camera.viewmat[:3, 3])
    return p[:2] / p[2]


def test_resizing_keeps_pixel_edges() -> None:
    # halves of an image stay halves: pixel centres are at +0.5, so coordinates scale without an offset
    point = torch.tensor([0.3, -0.2, 2.0])
    small = camera().resized(20, 10)
    assert torch.allclose(
        project(small, point), project(camera(), point) * torch.tensor([0.5, 1 / 3], dtype=torch.float64)
    )
    assert (small.width, small.height) == (20, 10)


@pytest.mark.parametrize("up", [Z, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)])
def test_look_at(up: Tensor) -> None:
    eye, target = torch.tensor([3.0, 1.0, 2.0]), torch.tensor([0.5, 0.0, -1.0])
    view = camera(look_at(eye, target, up)).validate("here")
    assert torch.allclose(view.position, eye.double())
    assert torch.allclose(project(view, target), torch.tensor([21.0, 14.0], dtype=torch.float64))
    assert project(view, target + 0.1 * up)[1] < 14.0, "up is towards smaller rows"
    assert (view.viewmat[:3, :3] @ (target.double() - view.position) + 0)[2] > 0


def test_orbit() -> None:
    center = torch.tensor([1.0, 2.0, 3.0])
    views = orbit(camera(), center, 2.0 * Z, 4.0, 0.5, 6)
    for view in views:
        view.validate("orbit")
        offset = view.position - center.double()
        assert offset.norm().item() == pytest.approx(4.0)
        assert offset[2].item() == pytest.approx(4.0 * math.sin(0.5))
        assert torch.allclose(project(view, center), torch.tensor([21.0, 14.0], dtype=torch.float64))
    assert len({tuple(v.position.round(decimals=6).tolist()) for v in views}) == 6


def changed(row: int, column: int, value: float) -> Tensor:
    view = EYE.clone()
    view[row, column] = value
    return view


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (replace(camera(), fx=0.0), "fx=0.0"),
        (replace(camera(), fy=-1.0), "focal lengths above 0"),
        (replace(camera(), cx=float("nan")), "cx=nan"),
        (replace(camera(), fx=float("inf")), "fx=inf"),
        (replace(camera(), width=0), "0x30"),
        (camera(EYE[:3]), "shape"),
        (camera(changed(0, 3, float("nan"))), "non-finite"),
        (camera(changed(0, 0, 0.0)), "singular"),
        (camera(EYE * 2.0), "scaled"),
        (camera(changed(0, 0, -1.0)), "mirrored"),
    ],
)
def test_refusals(bad: Camera, words: str) -> None:
    with pytest.raises(DataError, match=r"file\.json: frame 3") as caught:
        bad.validate("file.json: frame 3")
    assert words in str(caught.value)


EXR_CAMERA = scenes.camera(64, 48, shift=(5.0, -3.0))
EXR_POINTS = torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [-0.4, 0.5, 0.2]], dtype=torch.float64)


def test_points_through_the_matrices_land_where_the_camera_projects_them() -> None:
    found = camera_exr_attributes(EXR_CAMERA, 0.25)
    rows = np.concatenate([EXR_POINTS.numpy(), np.ones((3, 1))], 1) @ found["worldToNDC"]  # row vectors, as Imath
    pixels, z = EXR_CAMERA.project(EXR_POINTS)
    assert np.abs(rows[:, :2] / rows[:, 3:] * (64, 48) - pixels.numpy()).max() < 1e-3
    assert np.abs(rows[:, 3] - z.numpy()).max() < 1e-5 and np.abs(rows[:, 2] - (z.numpy() - 0.25)).max() < 1e-5


def test_camera_space_is_left_handed_with_y_up_and_z_ahead() -> None:
    matrix = camera_exr_attributes(EXR_CAMERA, 0.25)["worldToCamera"]
    view = EXR_CAMERA.viewmat
    ahead = EXR_CAMERA.position - view[1, :3] + 2 * view[2, :3]  # up in the image is against the second row
    assert np.abs(np.append(ahead.numpy(), 1.0) @ matrix - (0.0, 1.0, 2.0, 1.0)).max() < 1e-5
    assert np.linalg.det(matrix[:3, :3].astype(float)) < 0
    assert matrix.dtype == np.float32 and matrix.shape == (4, 4) and matrix.flags.c_contiguous, (
        "it is written as it lies"
    )


POINTS = torch.tensor([[0.0, 0.0, 0.0], [1.0, -2.0, 0.5], [-0.3, 0.4, 3.0]], dtype=torch.float64)


def turned_world(scale: float = 0.25, angle: float = 0.7) -> World:
    c, s = scale * math.cos(angle), scale * math.sin(angle)
    return World(torch.tensor([[c, -s, 0, 3e5], [s, c, 0, -20], [0, 0, scale, 0.5], [0, 0, 0, 1]], dtype=torch.float64))


@pytest.mark.parametrize("world", [World.at([448250.0, 5411930.0, 210.0]), turned_world()])
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
    with pytest.raises(DataError, match=r"expected a .* rotation, uniform scale and offset"):
        World(torch.diag(torch.tensor([*diagonal, 1.0], dtype=torch.float64))).validate("it")

"""Cameras: axes, half-pixel convention, refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at, opengl_to_viewmat, orbit
from neuprim.core.errors import DataError

EYE = torch.eye(4, dtype=torch.float64)
Z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def camera(view: Tensor = EYE) -> Camera:
    return Camera(view, 50.0, 60.0, 21.0, 14.0, 40, 30)


def project(camera: Camera, point: Tensor) -> Tensor:
    p = camera.K @ (camera.viewmat[:3, :3] @ point.double() + camera.viewmat[:3, 3])
    return p[:2] / p[2]


def test_opengl_axes() -> None:
    # an OpenGL camera at (1, 2, 3) without rotation looks along -z, +y up
    c2w = EYE.clone()
    c2w[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    view = camera(opengl_to_viewmat(c2w)).validate("here")
    assert torch.allclose(view.position, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    assert torch.allclose(project(view, torch.tensor([1.0, 2.0, 0.0])), torch.tensor([21.0, 14.0], dtype=torch.float64))
    right_and_up = project(view, torch.tensor([1.3, 2.3, 0.0]))
    assert torch.allclose(right_and_up, torch.tensor([21.0 + 5.0, 14.0 - 6.0], dtype=torch.float64))


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
        (replace(camera(), fy=-1.0), "focal lengths > 0"),
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

"""The near plane that ``auto`` stands for, and the extent of cameras that hardly move."""

from __future__ import annotations

import pytest
import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.cameras.pinhole import RayCamera
from neuprim.core.render.near_plane import nearest_and_median_depth, resolve_near
from neuprim.core.settings import RenderSettings

AUTO = RenderSettings(near="auto")


def cameras(distance: float) -> list[Camera]:
    eyes = distance * torch.tensor([[1.0, 0, 0.2], [0, 1, 0.1], [-1, 0, 0]], dtype=torch.float64)
    return [Camera(look_at(e, torch.zeros(3), torch.tensor([0.0, 0, 1])), 60.0, 60.0, 32.0, 32.0, 64, 64) for e in eyes]


def points(scale: float) -> torch.Tensor:
    return scale * (torch.rand((500, 3), generator=torch.Generator().manual_seed(0)) - 0.5)


@pytest.mark.parametrize("power", [-13, 0, 13])
def test_auto_is_a_part_of_the_depth_in_any_unit(power: int) -> None:
    scale = 2.0**power
    near = resolve_near(AUTO, points(scale), cameras(4 * scale)).near_plane
    assert near == resolve_near(AUTO, points(1.0), cameras(4.0)).near_plane * scale
    assert near == pytest.approx(0.01 * scale, rel=0.05)


def test_what_is_near_is_not_cut() -> None:
    close = torch.cat([points(1.0), torch.tensor([[3.99, 0.0, 0.797]])])
    nearest, typical = nearest_and_median_depth(close, cameras(4.0))
    assert nearest < 0.1 and resolve_near(AUTO, close, cameras(4.0)).near_plane == pytest.approx(0.1 * nearest)
    behind = torch.cat([points(1.0), torch.tensor([[4.1, 0.0, 0.9]])])  # seen by others, from afar
    assert resolve_near(AUTO, behind, cameras(4.0)).near_plane == pytest.approx(typical / 400, rel=0.1)


def test_a_number_wins_and_there_is_always_a_plane() -> None:
    assert resolve_near(RenderSettings(near=0.3), points(1.0), cameras(4.0)).near_plane == 0.3
    assert resolve_near(AUTO, points(1.0)[:0], cameras(4.0)).near_plane > 0
    fisheye = RayCamera.fisheye(8, 8, cameras(4.0)[0].viewmat)
    assert resolve_near(AUTO, points(1.0), [fisheye]).near_plane == pytest.approx(0.01, rel=0.1)

"""What a camera cannot see is found without drawing, and nothing that it sees is lost."""

from __future__ import annotations

import math

import pytest
import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.cameras.projections import RayCamera
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings, frustum, render_lowered
from neuprim.core.render.frustum import in_sight

COUNT, NEAR = 300, 0.1


def ellipsoids(seed: int) -> Geometry:
    """Needles, plates and balls on all sides of the origin."""
    g = torch.Generator().manual_seed(seed)
    return Geometry(
        4 * torch.rand(COUNT, 3, generator=g) - 2,
        torch.randn(COUNT, 3, generator=g) - 2,
        torch.randn(COUNT, 4, generator=g),
    )


def camera(seed: int) -> Camera:
    """Among them, its principal point off centre."""
    g = torch.Generator().manual_seed(100 + seed)
    eye = torch.rand(3, generator=g, dtype=torch.float64) - 0.5
    towards = torch.randn(3, generator=g, dtype=torch.float64)
    return Camera(
        look_at(eye, eye + towards, torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64)), 30.0, 26.0, 9.0, 22.0, 32, 24
    )


def on_surface(geometry: Geometry, count: int = 2000) -> torch.Tensor:
    """(N, count, 3) float64 points of each ellipsoid's surface."""
    unit = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64), dim=1
    )
    g = Geometry(*(x.double() for x in (geometry.means, geometry.log_scales, geometry.quats)))
    return g.means[:, None] + (unit[None] * g.scales[:, None]) @ g.rotations.transpose(1, 2)


@pytest.mark.parametrize("seed", range(6))
def test_what_has_a_point_in_view_is_in_sight_and_what_is_clearly_beyond_is_not(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frustum, "_AT_ONCE", 70)
    geometry, view = ellipsoids(seed), camera(seed)
    found = in_sight(geometry, view, NEAR)
    assert found is not None and found.dtype == torch.int64 and bool((found[1:] > found[:-1]).all())
    seen = torch.zeros(COUNT, dtype=torch.bool)
    seen[found] = True
    pixels, depth = view.project(on_surface(geometry).reshape(-1, 3))
    within = (depth > NEAR) & (pixels >= 0).all(1) & (pixels[:, 0] <= view.width) & (pixels[:, 1] <= view.height)
    assert bool(seen[within.reshape(COUNT, -1).any(1)].all())
    # by the same points no plane of the frustum has all of an ellipsoid behind it
    points = on_surface(geometry) @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    x, y, z = points.unbind(-1)
    sides = (view.fx * x + view.cx * z, (view.width - view.cx) * z - view.fx * x, view.fy * y + view.cy * z, (view.height - view.cy) * z - view.fy * y, z - NEAR)  # fmt: skip
    beyond = torch.stack([(side < -0.05 * side.abs().amax(1, keepdim=True)).all(1) for side in sides]).any(0)
    assert not bool(seen[beyond].any()) and 20 < int(beyond.sum()) and int(seen.sum()) > 10


@pytest.mark.parametrize("seed", range(3))
def test_an_image_of_what_is_in_sight_has_the_same_bits(seed: int) -> None:
    geometry, view = ellipsoids(seed), camera(seed)
    g = torch.Generator().manual_seed(seed)
    density = Cosine(
        torch.zeros(COUNT, 0, 3), torch.zeros(COUNT, 0), torch.zeros(COUNT, 0), 3 * torch.rand(COUNT, 1, generator=g)
    )
    colours = torch.rand(COUNT, 3, generator=g)
    found = in_sight(geometry, view, NEAR)
    assert found is not None and len(found) < COUNT
    settings = RenderSettings(near=NEAR)
    whole = render_lowered(Lowered(geometry, density, Constant(colours)), view, settings)
    part = render_lowered(Lowered(geometry[found], density.rows(found), Constant(colours[found])), view, settings)
    assert torch.equal(whole.rgb, part.rgb) and float(whole.alpha.max()) > 0.5


@pytest.mark.parametrize("name", ["means", "log_scales", "quats"])
def test_numbers_that_are_not_finite_stay_in(name: str) -> None:
    geometry, view = ellipsoids(0), camera(0)
    found = in_sight(geometry, view, NEAR)
    assert found is not None
    (gone, *_) = sorted(set(range(COUNT)) - set(found.tolist()))
    getattr(geometry, name)[gone] = math.nan
    again = in_sight(geometry, view, NEAR)
    assert again is not None and gone in again.tolist()


def test_other_cameras_may_look_anywhere() -> None:
    view = RayCamera.equirectangular(16, 8, torch.eye(4, dtype=torch.float64))
    assert isinstance(view, RayCamera) and in_sight(ellipsoids(0), view, NEAR) is None
    nothing = Geometry(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4))
    assert len(in_sight(nothing, camera(0), NEAR)) == 0  # type: ignore[arg-type]

"""Screen bounds and tile lists: nothing that a ray hits may be left out."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.geometry import Geometry, quaternion_to_matrix
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.reference import pixel_ray_directions, screen_boxes
from tests import scenes
from tests.backends import FAST, by

NEAR = 0.01


def hits(g: Geometry, row: int, camera: Camera, near: float = NEAR) -> Tensor:
    """(H, W) whether the ray through each pixel centre meets ellipsoid ``row`` in front of the near plane, float64."""
    d = pixel_ray_directions(camera)
    world = d @ camera.viewmat[:3, :3]
    to_sphere = (quaternion_to_matrix(g.quats[row]) / g.scales[row]).T
    p, v = to_sphere @ (camera.position - g.means[row]), world @ to_sphere.T
    a = (v * v).sum(-1)
    tm = -(v @ p) / a
    x = p + tm[..., None] * v
    D = 1 - (x * x).sum(-1)
    return (D > 0) & (tm + (D.clamp_min(0) / a).sqrt() > near / d[..., 2])


def extent(mask: Tensor, pixel: float) -> tuple[float, float, float, float]:
    """(x0, y0, x1, y1) of the outermost hit pixel centres, in units of ``pixel`` fine pixels."""
    ys, xs = mask.nonzero(as_tuple=True)
    return tuple((float(v) + 0.5) / pixel for v in (xs.min(), ys.min(), xs.max(), ys.max()))  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("distance", "fov", "shift"), [(3.0, 40.0, (0.0, 0.0)), (1.6, 100.0, (9.0, -6.0)), (30.0, 4.0, (-25.0, 3.0))]
)
def test_boxes_hold_every_hit_and_are_tight(distance: float, fov: float, shift: tuple[float, float]) -> None:
    fine = 5
    t = scenes.tensors(12, 0, seed=31, radius=0.2, dtype=torch.float64)
    g = scenes.lowered(t).geometry
    camera = scenes.camera(40, 30, distance=distance, fov=fov, shift=shift)
    boxes = screen_boxes(g, camera, NEAR)
    # the fine grid reaches beyond the image, so that boxes across its edge are judged whole
    pad = 20
    wide = replace(camera.resized(40 * fine, 30 * fine), width=(40 + 2 * pad) * fine, height=(30 + 2 * pad) * fine)
    wide = replace(wide, cx=wide.cx + pad * fine, cy=wide.cy + pad * fine)
    checked = 0
    for row in range(g.count):
        mask = hits(g, row, wide)
        edge = mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()
        if not mask.any() or edge:
            continue
        found = [v - pad for v in extent(mask, fine)]
        x0, y0, x1, y1 = boxes[row].tolist()
        assert x0 <= found[0] and y0 <= found[1] and x1 >= found[2] and y1 >= found[3], row
        # tight to a fine pixel and the sag of the ellipse between two fine lines
        slack = 1.5 / fine
        assert found[0] - x0 < slack and found[1] - y0 < slack and x1 - found[2] < slack and y1 - found[3] < slack, row
        checked += 1
    assert checked >= 5


def test_boxes_across_the_near_plane_are_the_whole_screen() -> None:
    t = scenes.tensors(1, 0, dtype=torch.float64)
    t["means"] *= 0
    camera = scenes.camera(40, 30, distance=0.1)
    g = scenes.lowered(t).geometry
    assert screen_boxes(g, camera, NEAR).tolist() == [[0.0, 0.0, 40.0, 30.0]]
    behind = replace(g, means=camera.position[None] * 40)
    x0, _, x1, _ = screen_boxes(behind, camera, NEAR)[0].tolist()
    assert x1 < x0
    # a centre behind the camera still shows where the ellipsoid reaches in front
    big = Geometry(camera.position[None] * 3, torch.full((1, 3), math.log(0.5), dtype=torch.float64), t["quats"])
    assert screen_boxes(big, camera, NEAR).tolist() == [[0.0, 0.0, 40.0, 30.0]]


def shapes(count: int, log_scales: Tensor, seed: int, depth: float) -> dict[str, Tensor]:
    """Constant-density ellipsoids of the given shape at random places and angles; ``depth``: optical depth through the
    middle, at most."""
    t = scenes.tensors(count, seed=seed)
    t["w2"] *= 0
    t["log_scales"] = log_scales.expand(count, 3).clone()
    t["b2"][:] = depth / 2
    return t


def compare(t: dict[str, Tensor], camera: Camera, tau_error: float) -> float:
    """Largest difference in alpha with all cuts off, allowing optical depths to differ by ``tau_error``; returns the
    coverage."""
    settings = RenderSettings(alpha_min=0.0, transmittance_min=0.0)
    slow = render_lowered(
        scenes.lowered({k: v.double() for k, v in t.items()}), camera, replace(settings, backend="reference")
    ).alpha
    for backend in FAST:
        fast = render_lowered(scenes.lowered(t), camera, replace(settings, **by(backend))).alpha.double()
        assert (fast - slow).abs().max() <= tau_error, backend
    return (slow > 0.02).double().mean().item()


def test_one_primitive_in_every_corner_and_edge() -> None:
    """Bounds at tile edges: spheres whose silhouettes end just inside, on and just outside each border."""
    camera = scenes.camera(33, 18)
    view = camera.viewmat
    for pixel in (-0.6, -0.4, 0.0, 0.5, 15.5, 16.0, 16.5, 31.9, 32.5, 33.4):
        for line in (-0.4, 0.5, 15.9, 17.5, 18.3):
            place = (
                torch.tensor(
                    [(pixel - camera.cx) / camera.fx, (line - camera.cy) / camera.fy, 1.0], dtype=torch.float64
                )
                * 3
            )
            t = shapes(1, torch.full((3,), math.log(0.05)), 0, 1.0)
            t["means"] = (view[:3, :3].T @ (place - view[:3, 3])).float()[None]
            compare(t, camera, 2e-4)


def test_no_tile_is_listed_without_need() -> None:
    """Tile lists are close to the least possible: about the number of tiles that a hit pixel lies in."""
    t = shapes(40, torch.tensor([math.log(0.5), math.log(0.05), math.log(0.05)]), 3, 1.0)
    camera = scenes.camera(112, 80)
    pairs = {render_lowered(scenes.lowered(t), camera, RenderSettings(**by(backend))).stats.pairs for backend in FAST}
    g = scenes.lowered({k: v.double() for k, v in t.items()}).geometry
    needed = 0
    for row in range(40):
        mask = hits(g, row, camera)
        needed += int(mask.reshape(5, 16, 7, 16).any(3).any(1).sum())
    assert needed <= min(pairs) and max(pairs) <= 1.1 * needed + 5

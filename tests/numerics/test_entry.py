"""``sort = "entry"``: every pixel composites its chords in the order in which its ray enters them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.render import RenderOutput, RenderSettings, render_lowered
from neuprim.core.render.backends import REFERENCE
from tests import scenes
from tests.backends import BACKENDS, FAST, by
from tests.numerics.cases import along_z, needle_and_sphere, spheres
from tests.numerics.equivalence import entries

ENTRY = RenderSettings(sort="entry", depth=True)


def render(t: dict[str, Tensor], camera: Camera, settings: RenderSettings, backend: str, **knobs: Any) -> RenderOutput:
    dtype = torch.float64 if backend == "reference" else torch.float32
    model = scenes.lowered({k: v.to(dtype) for k, v in t.items()})
    return render_lowered(model, camera, replace(settings, **by(backend), **knobs))


# ---------------------------------------------------------------- the order


def by_hand(t: dict[str, Tensor], camera: Camera, s: RenderSettings) -> tuple[Tensor, Tensor]:
    """(rgb, alpha) composited pixel by pixel from frames of one primitive each, sorted by :func:`entries`, ties by
    depth of the centre."""
    depth = t["means"].double() @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    by_centre = {k: v[depth.argsort(stable=True)] for k, v in t.items()}
    alone = torch.stack(
        [
            render({k: v[n : n + 1] for k, v in by_centre.items()}, camera, s, "reference").alpha
            for n in range(len(depth))
        ]
    )
    z = entries(by_centre, camera, s.near)
    rgb = torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)
    alpha = torch.zeros(camera.height, camera.width).double()
    for y in range(camera.height):
        for x in range(camera.width):
            T = 1.0
            for n in z[:, y, x].sort(stable=True).indices.tolist():
                a = float(alone[n, y, x])
                rgb[y, x] += T * a * by_centre["colors"][n].double()
                T *= 1 - a
                if T < s.transmittance_min:
                    break
            alpha[y, x] = 1 - T
    return rgb, alpha


@pytest.mark.parametrize(
    ("distance", "extra", "knobs"),
    [
        (3.0, 0.0, {}),
        (0.3, 0.0, {"near": 0.05}),
        (3.0, 0.0, {"near": 3.0}),
        (3.0, 1.0, {"transmittance_min": 0.3}),
        (3.0, 0.0, {"alpha_min": 0.2}),
        (3.0, 1.0, {"alpha_max": 0.3}),
    ],
)
def test_against_the_order_by_hand(distance: float, extra: float, knobs: dict[str, float]) -> None:
    t = scenes.tensors(25, seed=21, radius=0.35)
    t["b2"] += extra
    camera = scenes.camera(14, 10, distance=distance, fov=45 if distance > 1 else 90, shift=(0.8, 0.4))
    settings = replace(ENTRY, **knobs)  # type: ignore[arg-type]
    rgb, alpha = by_hand(t, camera, settings)
    for backend in BACKENDS:
        bound = 1e-11 if backend == REFERENCE else 1e-5
        out = render(t, camera, settings, backend)
        assert (out.rgb.double() - rgb).abs().max() < bound and (out.alpha.double() - alpha).abs().max() < bound, (
            backend
        )


@pytest.mark.parametrize("backend", BACKENDS)
def test_entry_is_right_where_the_order_of_centres_is_wrong(backend: str) -> None:
    t = needle_and_sphere()
    camera = along_z(41, 30.0)
    z = entries(t, camera, 0.01)
    both = (z < torch.inf).all(0)
    front = both & (z[0] < z[1])  # the needle enters first; the centres say that the sphere comes first
    assert front.sum() > 10
    settings = replace(ENTRY, alpha_min=0.0)
    right, wrong = (render(t, camera, settings, backend, sort=s) for s in ("entry", "center"))
    alone = [render({k: v[n : n + 1] for k, v in t.items()}, camera, settings, backend).alpha for n in range(2)]
    expected = torch.stack([alone[0], (1 - alone[0]) * alone[1]], -1)
    assert (right.rgb[..., :2] - expected)[front].abs().max() < 1e-6
    assert (wrong.rgb[..., :2] - expected)[front].abs().max() > 0.5
    assert (right.alpha - wrong.alpha).abs().max() < 1e-5


@pytest.mark.parametrize("backend", BACKENDS)
def test_chords_that_the_near_plane_cuts_keep_the_order_of_centres(backend: str) -> None:
    """The camera is inside three spheres: all entries lie on the near plane."""
    t = spheres([[0.3, 0.0, 0.4], [-0.2, 0.1, -0.1], [0.0, -0.2, 0.9]], [4.5, 4.0, 5.0], [0.2, 0.3, 0.25])
    t = {k: v.float() for k, v in t.items()}
    camera = along_z()
    assert (entries(t, camera, 0.01) == 0.01).all()
    for order in ([0, 1, 2], [2, 0, 1]):
        model = {k: v[order] for k, v in t.items()}
        first, second = (render(model, camera, ENTRY, backend, sort=s) for s in ("center", "entry"))
        assert (first.rgb - second.rgb).abs().max() < 1e-6 and first.rgb.amin(0).amin(0).min() > 0.02
    fourth = {
        k: torch.cat([v, v[:1]]) for k, v in t.items()
    }  # a small sphere in front of all their centres, not cut, comes last
    fourth["means"][3] = torch.tensor([0.0, 0.0, -2.5])
    fourth["log_scales"][3] = math.log(0.2)
    fourth["colors"][3] = torch.ones(3)
    fourth["b2"][3] = 50.0
    out = render(fourth, camera, ENTRY, backend).rgb[10, 10]
    alone = render(t, camera, ENTRY, backend)
    assert torch.allclose(out, alone.rgb[10, 10] + (1 - alone.alpha[10, 10]) * 0.99, atol=1e-5)


@pytest.mark.parametrize("sort", ["center", "entry"])
def test_coincident_primitives_keep_their_index_order(sort: str) -> None:
    t = scenes.tensors(12, seed=4, radius=0.4)
    t = {k: torch.cat([v, v]) for k, v in t.items()}
    t["colors"][12:] = 1 - t["colors"][12:]
    camera, settings = scenes.camera(33, 25), replace(ENTRY, sort=sort)
    truth = render(t, camera, settings, REFERENCE, alpha_min=0.0).rgb
    for backend in FAST:
        assert (render(t, camera, settings, backend, alpha_min=0.0).rgb - truth).abs().max() < 1e-5, backend

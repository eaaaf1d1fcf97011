"""Numbers that are not numbers, or leave every range: refused by name on both backends, or drawn finite."""

from __future__ import annotations

import pytest
import torch

from neuprim.core.errors import NonFiniteError
from neuprim.core.model import sh
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render, render_lowered
from neuprim.tasks.static import SphericalHarmonics
from tests import scenes
from tests.backends import BACKENDS, by

NAMES = ["means", "log_scales", "quats", "W1", "b1", "w2", "b2"]
NET = ["Wx", "bias", "Wout", "base"]
NAN, INF = float("nan"), float("inf")
CAMERA = scenes.camera(20, 20)


def settings(backend: str) -> RenderSettings:
    return RenderSettings(**by(backend))


def model(count: int = 20) -> Primitives:
    t = scenes.tensors(count)
    params = {k: v for k, v in t.items() if k != "colors"}
    params["sh_dc"] = t["colors"]
    params["sh_rest"] = torch.zeros(count, 15, 3)
    return Primitives(CosineDensity(8), SphericalHarmonics(3), params)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("name", "value"),
    [*((name, value) for name in (*NAMES, "colors", *NET) for value in (NAN, INF, -INF)),
     *(("log_scales", value) for value in (95.0, 1000.0, -1000.0, 3e38)), ("quats", 0.0)],
)  # fmt: skip
def test_impossible_numbers_are_refused_by_name(backend: str, name: str, value: float) -> None:
    """Anywhere, behind the camera too. Of a quaternion only all zeros are impossible."""
    t = scenes.tensors(20, hidden=8 if name in NET else None)
    t["means"][13] = CAMERA.position.float() * 3
    t[name][13].view(-1)[0 if value == 0 else -1 :] = value
    with pytest.raises(NonFiniteError, match=rf"\b{name} of primitive 13\b"):
        render_lowered(scenes.lowered(t), CAMERA, settings(backend))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("name", "value"),
    [*((name, 1e-42) for name in (*NAMES, "colors", *NET)), ("Wx", 1e30), ("bias", 1e30), ("Wout", 1e6), ("base", 1e6)],
)
def test_denormals_and_huge_networks_are_drawn(backend: str, name: str, value: float) -> None:
    t = {k: v.requires_grad_() for k, v in scenes.tensors(20, hidden=8 if name in NET else None).items()}
    with torch.no_grad():
        t[name][5] = value
    out = render_lowered(scenes.lowered(t), CAMERA, settings(backend))
    assert torch.isfinite(out.rgb).all() and out.alpha.max() > 0.2
    out.rgb.sum().backward()
    for k, v in t.items():
        if k != "quats" or name != "quats":  # the gradient of a direction grows as one over its length
            assert v.grad is not None and torch.isfinite(v.grad).all(), k


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("value", [1e30, -1e30])
def test_spherical_harmonics_far_outside_their_range_are_drawn(backend: str, value: float) -> None:
    m = model()
    m.params["sh_rest"][4] = value
    out = render(m, CAMERA, settings=settings(backend))
    assert torch.isfinite(out.rgb).all() and torch.isfinite(out.alpha).all() and out.alpha.max() > 0.2


@pytest.mark.parametrize("backend", BACKENDS)
def test_spherical_harmonics_that_overflow_are_refused_by_name(backend: str) -> None:
    m = model()
    way = m.params["means"][4] - CAMERA.position.float()
    m.params["sh_rest"][4] = 3e38 * sh.sh_basis(way / way.norm(), 3)[1:, None].sign()  # every band adds up
    with pytest.raises(NonFiniteError, match=r"of primitive 4\b"):
        render(m, CAMERA, settings=settings(backend))

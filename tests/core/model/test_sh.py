"""Spherical harmonics: the basis itself, and the colour field built on it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from neuprim.core.model import sh
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import Constant
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.tasks.static import SphericalHarmonics
from tests import scenes

pytestmark = pytest.mark.usefixtures("either_way")


def sphere(polar: int = 12, around: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions and weights of a product rule that is exact for polynomials of degree < 2 polar."""
    z, wz = np.polynomial.legendre.leggauss(polar)
    phi = 2 * np.pi * (np.arange(around) + 0.3) / around
    s = np.sqrt(1 - z**2)
    d = np.stack([s[:, None] * np.cos(phi), s[:, None] * np.sin(phi), np.broadcast_to(z[:, None], (polar, around))], -1)
    return torch.from_numpy(d.reshape(-1, 3)), torch.from_numpy(np.repeat(wz, around) * 2 * np.pi / around)


def test_orthonormal() -> None:
    d, w = sphere()
    values = sh.sh_basis(d, 3)
    gram = values.T @ (w[:, None] * values)
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=1e-13)


def test_order_and_signs() -> None:
    """Those of 3D Gaussian splatting: y, z, x with signs -, +, - in band 1."""
    x, y, z = torch.eye(3, dtype=torch.float64)[:, None]
    c1 = math.sqrt(3 / (4 * math.pi))
    for axis, band in ((x, [0, 0, -c1]), (y, [-c1, 0, 0]), (z, [0, c1, 0])):
        assert sh.sh_basis(axis, 1)[0].tolist() == pytest.approx([sh.C0, *band])
    assert sh.sh_basis(z, 2)[0, 6].item() == pytest.approx(0.6307831305050401)
    assert sh.sh_basis(x, 2)[0, 8].item() == pytest.approx(0.5462742152960396)
    assert sh.sh_basis(x, 3)[0, 15].item() == pytest.approx(-0.5900435899266435)


def fresh(degree: int, channels: int, sh_every: float = 0.0) -> tuple[Primitives, SphericalHarmonics, torch.Tensor]:
    colors = torch.rand(20, channels, generator=torch.Generator().manual_seed(1))
    t = scenes.tensors(20, seed=2)
    colour = SphericalHarmonics(degree, channels, sh_every)
    context = InitContext(t["means"], torch.full((20,), 0.1), colors, torch.Generator().manual_seed(0))
    return Primitives.initialise(CosineDensity(2), colour, context), colour, colors


def seen(model: Primitives, distance: float = 3.0) -> torch.Tensor:
    form = model.lower(scenes.camera(distance=distance), {}).colour
    assert isinstance(form, Constant)
    return form.rgb


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_initial_colour_is_the_given_one(degree: int, channels: int) -> None:
    model, _, colors = fresh(degree, channels)
    assert torch.allclose(seen(model), colors, atol=1e-6)


def test_colour_is_never_negative_and_depends_on_the_direction() -> None:
    model, _, _ = fresh(3, 3)
    model.params["sh_rest"].normal_(generator=torch.Generator().manual_seed(5))
    first, second = seen(model), seen(model, distance=0.05)
    assert first.min() == 0
    assert (first - second).abs().max() > 0.05


def test_colour_follows_the_direction_from_camera_to_centre() -> None:
    model, _, _ = fresh(1, 3)
    model.params["sh_dc"].zero_()
    model.params["sh_rest"].zero_()
    model.params["sh_rest"][:, 2, 0] = -0.3  # the coefficient of -x
    camera = scenes.camera()
    offset = model.params["means"] - camera.position.float()
    x = offset[:, 0] / offset.norm(dim=1)
    expected = 0.5 + 0.3 * math.sqrt(3 / (4 * math.pi)) * x
    rgb = seen(model)
    assert torch.allclose(rgb[:, 0], expected, atol=1e-6)
    assert torch.allclose(rgb[:, 1:], torch.tensor(0.5))


def test_bands_are_unlocked_one_by_one() -> None:
    model, colour, _ = fresh(3, 3, sh_every=0.1)
    assert colour.active == 3, "a loaded model uses all of its bands"
    steps = []
    for progress in (0.0, 0.05, 0.1, 0.19999, 0.2, 0.3, 0.31, 1.0):
        colour.set_progress(progress)
        steps.append(colour.active)
    assert steps == [0, 0, 1, 1, 2, 3, 3, 3]

    model.params["sh_rest"].normal_(generator=torch.Generator().manual_seed(5))
    colour.set_progress(0.1)
    first = seen(model)
    model.params["sh_rest"][:, 3:] = 7.0
    assert torch.equal(seen(model), first), "locked bands play no part"
    model.params["sh_rest"][:, :3] = 7.0
    assert not torch.equal(seen(model), first)


def on_blocks(
    means: torch.Tensor, dc: torch.Tensor, rest: torch.Tensor, origin: torch.Tensor, degree: int
) -> torch.Tensor:
    """The card's kernels, on Warp's CPU blocks."""
    pytest.importorskip("warp", reason="the cuda backend's kernels need Warp")
    from neuprim.core.model.colours_warp import fused_harmonic_colors

    return fused_harmonic_colors(means, dc, rest, origin, degree)


@pytest.mark.parametrize("kernels", [sh.sh_colors, on_blocks])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_values_and_gradients_are_those_of_float64(degree: int, kernels: Callable[..., torch.Tensor]) -> None:
    """Also of the camera's position, and for colours that are cut off at zero."""
    g = torch.Generator().manual_seed(degree)
    shapes = {"means": (50, 3), "dc": (50, 4), "rest": (50, 15, 4), "origin": (3,)}
    exact = {
        name: torch.randn(shape, generator=g, dtype=torch.float64).requires_grad_() for name, shape in shapes.items()
    }
    mine = {
        name: value.detach().to(torch.float64 if name == "origin" else torch.float32).requires_grad_()
        for name, value in exact.items()
    }
    with torch.no_grad():
        for name, value in exact.items():
            value.copy_(mine[name])
    pull = torch.randn(50, 4, generator=g)
    found, wanted = kernels(**mine, degree=degree), sh.sh_colors(**exact, degree=degree)
    assert bool((wanted == 0).any()) and torch.allclose(found.double(), wanted, rtol=1e-5, atol=1e-5)
    (found * pull).sum().backward()
    (wanted * pull.double()).sum().backward()
    for name, value in exact.items():
        made, expected = mine[name].grad, value.grad
        assert made is not None and expected is not None
        assert torch.allclose(made.double(), expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max())), name

"""The closed-form line integral against quadrature of the density, and what keeps the density unchanged."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.geometry import Geometry, quaternion_to_matrix
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.reference import pixel_ray_directions
from neuprim.core.train.population import split_population
from neuprim.tasks.static import SphericalHarmonics
from tests import scenes

EXACT = RenderSettings(backend="reference", alpha_min=0.0, alpha_max=0.9999)
DENSITY = ("W1", "b1", "w2", "b2")


def geometry(t: dict[str, Tensor]) -> Geometry:
    return Geometry(t["means"], t["log_scales"], t["quats"])


def model(t: dict[str, Tensor]) -> Primitives:
    params = {k: v for k, v in t.items() if k != "colors"}
    return Primitives(CosineDensity(t["W1"].shape[1]), SphericalHarmonics(0), {**params, "sh_dc": t["colors"]})


def quadrature(t: dict[str, Tensor], origin: Tensor, d: Tensor, near_z: Tensor, points: int = 400) -> Tensor:
    """(P,) optical depth of primitive 0 along unit rays ``d`` (P, 3), chord ends from the plain quadratic formula in
    float64."""
    g = geometry(t)
    to_sphere = (quaternion_to_matrix(g.quats[0]) / g.scales[0]).T
    p, v = to_sphere @ (origin - g.means[0]), d @ to_sphere.T
    a, b, c = (v * v).sum(1), v @ p, p @ p - 1
    root = (b * b - a * c).clamp_min(0).sqrt()
    t0, t1 = torch.maximum((-b - root) / a, near_z), (-b + root) / a
    length = (t1 - t0).clamp_min(0)
    x, w = (torch.from_numpy(q) for q in np.polynomial.legendre.leggauss(points))
    s = t0[:, None] + length[:, None] * (x + 1) / 2
    where = (origin + s[..., None] * d[:, None, :]).reshape(-1, 3)
    sigma = sigma_at(t, torch.zeros(len(where), dtype=torch.int64), where)
    return (sigma.reshape(s.shape) @ w) * length / 2


@pytest.mark.parametrize("neurons", [0, 1, 3, 8, 16])
@pytest.mark.parametrize("distance", [2.0, 0.1], ids=["outside", "inside"])
def test_closed_form_equals_quadrature(neurons: int, distance: float) -> None:
    hit = 0
    for seed in range(2):
        t = scenes.tensors(1, neurons, seed=seed, radius=0.4, dtype=torch.float64)
        t["means"] *= 0.2
        camera = scenes.camera(9, 7, distance=distance, fov=50, shift=(1.3, -0.7))
        alpha = render_lowered(scenes.lowered(t), camera, EXACT).alpha.reshape(-1)
        local = pixel_ray_directions(camera).reshape(-1, 3)
        depth = quadrature(t, camera.position, local @ camera.viewmat[:3, :3], EXACT.near / local[:, 2])
        expected = (-torch.expm1(-depth.clamp_min(0))).clamp_max(EXACT.alpha_max)
        assert (alpha - expected).abs().max() <= 1e-12
        hit += int((alpha > 0.01).sum())
    assert hit > 20, "the rays must meet something"


def test_density_is_the_formula_of_the_paper() -> None:
    t = scenes.tensors(4, 3, seed=5, dtype=torch.float64)
    x = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    for row in range(4):
        m = math.exp(max(t["log_scales"][row].tolist()))
        u = [(x[0, j].item() - t["means"][row, j].item()) / m for j in range(3)]
        f = t["b2"][row, 0].item()
        for k in range(3):
            phase = sum(t["W1"][row, k, j].item() * u[j] for j in range(3)) + t["b1"][row, k].item()
            f += t["w2"][row, k].item() * math.cos(30 * phase)
        assert sigma_at(t, torch.tensor([row]), x).item() == pytest.approx(f / m, rel=1e-12)


def points_inside(g: Geometry, each: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """(rows, points): ``each`` random points in every ellipsoid, float64."""
    gen = torch.Generator().manual_seed(seed)
    u = torch.randn(g.count * each, 3, generator=gen, dtype=torch.float64)
    u = u / u.norm(dim=1, keepdim=True) * torch.rand(len(u), 1, generator=gen, dtype=torch.float64) ** (1 / 3)
    rows = torch.arange(g.count).repeat_interleave(each)
    R = quaternion_to_matrix(g.quats.double())[rows]
    return rows, g.means.double()[rows] + (R @ (g.scales.double()[rows] * u)[:, :, None])[..., 0]


def sigma_at(t: dict[str, Tensor], rows: Tensor, x: Tensor, density: CosineDensity | None = None) -> Tensor:
    wide = {k: v.double() for k, v in t.items()}
    density = density or CosineDensity(t["W1"].shape[1])
    return density.density({k: wide[k] for k in DENSITY}, geometry(wide), rows, x, {})


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
@pytest.mark.parametrize("neurons", [0, 8])
@pytest.mark.parametrize("factors", [(0.6, 0.9), (1 / 1.6, 1 / 1.6)])
def test_split_carries_sigma(dtype: torch.dtype, bound: float, neurons: int, factors: tuple[float, float]) -> None:
    """Relative to S/m = (|b2| + sum |w2|)/m, the largest density the primitive can have."""
    t = scenes.tensors(40, neurons, seed=1, dtype=dtype)
    parents = torch.arange(40)
    children = split_population(model(t), parents, 0.5, *factors)
    child = geometry(children)
    rows, x = points_inside(child, 20)
    before, after = sigma_at(t, rows % 40, x), sigma_at(children, rows, x)
    largest = ((t["b2"].abs()[:, 0] + t["w2"].abs().sum(1)) / geometry(t).length_scale).double()[rows % 40]
    assert ((after - before).abs() / largest).max() <= bound
    assert (before.abs() / largest).max() > 0.1

    # the children lie inside their parents' support, apart from each other, and copying the weights would not have done
    g = geometry({k: v.double() for k, v in t.items()})
    twice = parents.repeat(2)
    inside = ((child.means.double() - g.means[twice])[:, None, :] @ g.rotations[twice])[:, 0] / g.scales[twice]
    assert torch.allclose(inside.norm(dim=1), torch.tensor(0.5, dtype=torch.float64), atol=1e-5)
    assert torch.allclose(inside[:40], -inside[40:], atol=1e-5)
    copies = {**children, **{k: t[k][twice] for k in DENSITY}}
    assert ((sigma_at(copies, rows, x) - before).abs() / largest).max() > 0.1


@pytest.mark.parametrize("omega0", [0.7, 12.0, 30.0])
def test_split_wraps_phases_at_the_density_s_own_turn(omega0: float) -> None:
    """A turn of another omega0 would be part of one: the children would be other waves."""
    t = scenes.tensors(40, 8, seed=1)
    t["b1"] = t["b1"] * 40 * 30 / omega0  # tens of turns
    density = CosineDensity(8, omega0)
    assert type(density)(**density.settings()).omega0 == omega0 and CosineDensity(8).settings() == {"neurons": 8}
    old = geometry(t)
    moved = old.means + 0.3 * old.length_scale[:, None] * torch.tensor([1.0, 0.0, 0.0])
    new = Geometry(moved, old.log_scales + math.log(0.6), old.quats)
    child = density.on_split({k: t[k] for k in DENSITY}, old, new)
    assert child["b1"].abs().max() <= math.pi / omega0 * (1 + 1e-6) < t["b1"].abs().max()
    rows, x = points_inside(new, 20)
    children = {**child, "means": new.means, "log_scales": new.log_scales, "quats": new.quats}
    before, after = (sigma_at(p, rows, x, density) for p in (t, children))
    assert (before - after).abs().max() <= 1e-5 * before.abs().max()


@pytest.mark.parametrize("edge", [1, 2])
def test_children_with_a_soft_edge_have_their_parents_mass(edge: int) -> None:
    """Without neurons a density's integral over space is b2/m times the volume, times a constant of the edge."""
    t = scenes.tensors(20, 0, seed=5, dtype=torch.float64)
    old = geometry(t)
    new = Geometry(old.means, old.log_scales + torch.tensor([0.5, 0.8, 0.9], dtype=torch.float64).log(), old.quats)
    child = CosineDensity(0, edge=edge).on_split({k: t[k] for k in DENSITY}, old, new)

    def mass(b2: Tensor, g: Geometry) -> Tensor:
        return b2[:, 0] / g.length_scale * g.scales.prod(1)

    assert torch.allclose(2 * mass(child["b2"], new), mass(t["b2"], old), rtol=1e-12, atol=0)


@pytest.mark.parametrize("neurons", [0, 5])
def test_two_half_clones_are_the_original(neurons: int) -> None:
    t = scenes.tensors(12, neurons, seed=3, dtype=torch.float64)
    density = CosineDensity(neurons)
    half = density.scale_density({k: t[k] for k in DENSITY}, torch.full((12,), 0.5, dtype=torch.float64))
    rows, x = points_inside(geometry(t), 10)
    assert torch.equal(2 * sigma_at({**t, **half}, rows, x), sigma_at(t, rows, x))
    factors = torch.linspace(0, 3, 12, dtype=torch.float64)
    scaled = density.scale_density({k: t[k] for k in DENSITY}, factors)
    assert torch.allclose(sigma_at({**t, **scaled}, rows, x), factors[rows] * sigma_at(t, rows, x), rtol=1e-12, atol=0)


@pytest.mark.parametrize("scale", [1e-3, 7.0, 1e4])
def test_scaling_the_scene_leaves_the_image(scale: float) -> None:
    """The world density is f/m: optical depth has no unit."""
    t = scenes.tensors(20, 8, seed=4, dtype=torch.float64)
    camera = scenes.camera(20, 15)
    settings = RenderSettings(backend="reference", alpha_min=0.0, transmittance_min=0.0, depth=True)
    first = render_lowered(scenes.lowered(t), camera, settings)
    view = camera.viewmat.clone()
    view[:3, 3] *= scale
    big = {**t, "means": t["means"] * scale, "log_scales": t["log_scales"] + math.log(scale)}
    second = render_lowered(
        scenes.lowered(big), replace(camera, viewmat=view), replace(settings, near=settings.near * scale)
    )
    assert first.alpha.max() > 0.5
    assert (second.rgb - first.rgb).abs().max() < 1e-11
    assert first.depth is not None and second.depth is not None
    assert torch.allclose(second.depth, first.depth * scale, rtol=1e-9)


@pytest.mark.parametrize("neurons", [0, 1, 8])
def test_a_fresh_primitive_has_the_opacity_asked_for(neurons: int) -> None:
    n, generator = 5, torch.Generator().manual_seed(0)
    context = InitContext(torch.zeros(n, 3), torch.full((n,), 0.3), torch.full((n, 3), 0.5), generator, {"alpha": 0.6})
    fresh = Primitives.initialise(CosineDensity(neurons), SphericalHarmonics(0), context)
    b2 = fresh.params["b2"]
    assert torch.allclose(1 - torch.exp(-2 * b2), torch.full((n, 1), 0.6)), "a central chord has optical depth 2 b2"
    if neurons:
        assert fresh.params["W1"].abs().max() <= 1 / 3
        assert fresh.params["w2"].abs().max() <= math.sqrt(6 / neurons) / 30
        context.settings = {"mode": "paper"}
        paper = Primitives.initialise(CosineDensity(neurons), SphericalHarmonics(0), context).params["b2"]
        assert paper.abs().max() <= math.sqrt(6 / neurons) / 30 and paper.unique().numel() == n

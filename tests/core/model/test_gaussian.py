"""The Gaussian density: its closed line integral against quadrature, its mass, and the way it trains like any other
field."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import neuprim.runs.run as running
from neuprim.config import compose
from neuprim.core import checkpoint
from neuprim.core.model.fields import CustomDensity
from neuprim.core.model.gaussian import GaussianDensity, bell_integral
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.train.population import split_population
from neuprim.tasks.static import SphericalHarmonics
from tests import scenes
from tests.core import tiny


def tensors(count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    t = scenes.tensors(count, 0, seed=seed, dtype=dtype)
    own = {"log_amplitude": (t["b2"].abs() + 0.1).log(), "sh_dc": t["colors"] * 4 - 2}
    return {**{k: t[k] for k in ("means", "log_scales", "quats")}, **own}


def geometry(t: dict[str, Tensor]) -> Geometry:
    return Geometry(t["means"], t["log_scales"], t["quats"])


def model(count: int = 20, dtype: torch.dtype = torch.float64) -> Primitives:
    t = tensors(count, 3, dtype)
    return Primitives(GaussianDensity(), SphericalHarmonics(0), {k: v.requires_grad_() for k, v in t.items()})


def integral(
    field: GaussianDensity, t: dict[str, Tensor], prim: Tensor, o: Tensor, d: Tensor, t0: Tensor, t1: Tensor
) -> Tensor:
    form = field.lower(t, geometry(t), {})
    assert isinstance(form, CustomDensity)
    return form.line_integral(prim, o, d, t0, t1)


def chords(t: dict[str, Tensor], distance: float, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(o, d, t0, t1): one ray per primitive that meets it, ``distance`` scene units away."""
    gen = torch.Generator().manual_seed(seed)
    g, n = geometry(t), len(t["means"])
    d, u = (torch.nn.functional.normalize(torch.randn(n, 3, generator=gen).double(), dim=1) for _ in range(2))
    u = u * torch.rand(n, 1, generator=gen)
    inside = g.means + (g.rotations @ (g.scales * u)[:, :, None])[..., 0]
    o = inside - distance * d
    to_sphere = g.rotations.transpose(1, 2) / g.scales[:, :, None]
    y, v = (to_sphere @ (inside - g.means)[:, :, None])[..., 0], (to_sphere @ d[:, :, None])[..., 0]
    a, b = (v * v).sum(1), (y * v).sum(1)
    root = (b * b + a * (1 - (y * y).sum(1))).sqrt()
    return o, d, distance + (-b - root) / a, distance + (-b + root) / a


def quadrature(field: GaussianDensity, t: dict[str, Tensor], o: Tensor, d: Tensor, t0: Tensor, t1: Tensor) -> Tensor:
    x, w = (torch.from_numpy(q) for q in np.polynomial.legendre.leggauss(120))
    half = (t1 - t0) / 2
    s = (t0 + t1)[:, None] / 2 + half[:, None] * x
    points = (o[:, None] + s[..., None] * d[:, None]).reshape(-1, 3)
    rows = torch.arange(len(o)).repeat_interleave(len(x))
    return (field.density(t, geometry(t), rows, points, {}).reshape(s.shape) @ w) * half


# ---------------------------------------------------------------- the closed form


@pytest.mark.parametrize("deviations", [0.5, 3.0, 6.0, 10.0])
@pytest.mark.parametrize("distance", [0.0, 3.0, 1e3])
def test_line_integral_equals_quadrature(deviations: float, distance: float) -> None:
    """Whole chords and pieces of them, such as the near plane leaves: error relative to S = kappa/m x length.

    The points of the quadrature themselves lie only to distance x 1e-16 where they should, hence the last factor.
    """
    field, t = GaussianDensity(deviations), tensors(200)
    o, d, t0, t1 = chords(t, distance)
    prim = torch.arange(200)
    for low, high in ((0.0, 1.0), (0.3, 1.0), (0.45, 0.55), (0.9, 1.0), (0.0, 0.2), (0.6, 0.6001)):
        a, b = t0 + low * (t1 - t0), t0 + high * (t1 - t0)
        found, expected = integral(field, t, prim, o, d, a, b), quadrature(field, t, o, d, a, b)
        S = (t["log_amplitude"][:, 0] - geometry(t).log_length_scale).exp() * (b - a)
        assert ((found - expected).abs() / S).max() <= 1e-12 * max(1.0, distance)
        assert (expected / S).max() > 0.05 or (low, high) != (0.0, 1.0), "the rays must meet something"


def test_bell_integral_keeps_its_digits_everywhere() -> None:
    """Against Gauss-Legendre on the interval, relative to the integral itself, in the far tails and on the seams of the
    three forms."""
    x, w = (torch.from_numpy(q) for q in np.polynomial.legendre.leggauss(100))
    u, half = torch.meshgrid(
        torch.linspace(-7, 7, 57, dtype=torch.float64), torch.logspace(-9, 0.3, 80, dtype=torch.float64), indexing="ij"
    )
    u, half = u.reshape(-1), half.reshape(-1)
    expected = (-((u[:, None] + half[:, None] * x) ** 2)).exp() @ w * half
    found = bell_integral(u, half)
    assert (found / expected - 1).abs().max() <= 1e-12
    assert expected.min() < 1e-28, "the tails must be far"
    assert torch.equal(bell_integral(-u, half), found)
    assert torch.equal(bell_integral(u, torch.zeros_like(u)), torch.zeros_like(u))
    naive = math.sqrt(math.pi) / 2 * (torch.erf(u + half) - torch.erf(u - half))
    assert (naive / expected - 1).abs().max() > 0.5, "the plain difference loses everything"


def test_gradients_are_finite_differences() -> None:
    field, t = GaussianDensity(), tensors(12)
    o, d, t0, t1 = chords(t, 2.0)
    names = ("means", "log_scales", "quats", "log_amplitude")
    prim = torch.arange(12)
    middle = t0 + 0.7 * (t1 - t0)

    def both(*values: Tensor) -> Tensor:
        now = dict(zip(names, values[:4], strict=True))
        o, d, a, b = values[4:]
        ends = ((a, b), (middle, b), (middle, middle + 1e-3))
        return torch.cat([integral(field, now, prim, o, d, *pair) for pair in ends])

    inputs = [v.clone().requires_grad_() for v in (*(t[n] for n in names), o, d, t0, t1)]
    assert torch.autograd.gradcheck(both, inputs, atol=1e-7, rtol=1e-5)
    u = torch.tensor([0.0, 0.5, -3.0, 2.0, 0.1, -6.0], dtype=torch.float64, requires_grad=True)
    w = torch.tensor([1.0, 0.5001, 0.5, 0.01, 0.01, 0.4], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(bell_integral, [u, w], atol=1e-8)


def mass(t: dict[str, Tensor]) -> Tensor:
    """Up to one constant, the integral of sigma over space: kappa/m prod s."""
    return (t["log_amplitude"][:, 0] - geometry(t).log_length_scale + t["log_scales"].sum(1)).exp()


# ---------------------------------------------------------------- a field like any other


def test_parameters_and_start() -> None:
    field = GaussianDensity()
    whole = Primitives(
        field, SphericalHarmonics(3), {**tensors(2), "sh_rest": torch.zeros(2, 15, 3), "sh_dc": torch.zeros(2, 3)}
    )
    assert whole.parameters_per_primitive == 11 + 48
    unit = {"means": torch.zeros(1, 3), "log_scales": torch.zeros(1, 3), "quats": torch.tensor([[1.0, 0, 0, 0]])}
    for settings, alpha in (({"alpha": 0.7}, 0.7), ({}, 0.8), ({"mode": "paper"}, 0.1)):
        context = InitContext(unit["means"], torch.ones(1), torch.ones(1, 3), torch.Generator(), settings)
        start = {**unit, "log_amplitude": field.parameters()[0].init(context)}
        ends = torch.tensor([1.0]), torch.tensor([3.0])
        ray = torch.tensor([[-2.0, 0, 0]]), torch.tensor([[1.0, 0, 0]])
        depth = integral(field, start, torch.tensor([0]), *ray, *ends)
        assert 1 - math.exp(-depth.item()) == pytest.approx(alpha, rel=1e-6)


@pytest.mark.parametrize("factors", [(0.6, 0.9), (1 / 1.6, 1 / 1.6)])
def test_split_keeps_the_mass_of_the_pair(factors: tuple[float, float]) -> None:
    m = model()
    children = split_population(m, torch.arange(20), 0.5, *factors)
    pair = mass(children)[:20] + mass(children)[20:]
    before = mass({k: v.detach() for k, v in m.params.items()})
    assert torch.allclose(pair, before, rtol=1e-12, atol=0)
    in_place = m.density.on_split(m.of(m.density), m.geometry, m.geometry)
    assert torch.allclose(2 * in_place["log_amplitude"].exp(), m.params["log_amplitude"].exp(), rtol=1e-14, atol=0)


# ---------------------------------------------------------------- runs


@pytest.mark.parametrize(("preset", "strategy"), [("quick", "relocate"), ("paper", "gradient")])
def test_a_short_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: str, strategy: str) -> None:
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)
    scene, out = tiny.write_blender(tmp_path / "two"), tmp_path / "run"
    words = [
        "task=static", "scene=blender", f"scene.path={scene}", f"preset={preset}", "model.density.form=gaussian",
        "model.primitives=30", "model.colour.form=sh",
        "model.sh_degree=1", "train.iterations=120", "train.max_seconds=null", "train.log_every=5",
        "train.population.every=20",
        f"train.population.strategy={strategy}", "train.population.start=0", f"output_dir={out}",
    ]  # fmt: skip
    running.run(compose(words))
    lines = [json.loads(text) for text in (out / "metrics.jsonl").read_text().splitlines()]
    losses = [line["loss"] for line in lines]
    assert sum(losses[-4:]) < 0.7 * sum(losses[:4])
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["backend"] == "reference" and metrics["parameters_per_primitive"] == 11 + 12
    header, _ = checkpoint.read_tensors(out / "model.safetensors", "model")
    assert header["density"] == {"class": "GaussianDensity", "settings": {"deviations": 3.0}}

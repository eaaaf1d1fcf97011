"""What does not fit is refused at every entrance, by field, tensor, found and expected; what fits in an odd way is
drawn."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.errors import FormError
from neuprim.core.model import sh
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import Constant, Cosine, CustomColour, CustomDensity, Shading
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.tensors import MOST_UNITS
from neuprim.core.render import RenderSettings, render, render_lowered
from neuprim.core.volumes.density_grid import density_at, density_grid
from neuprim.tasks.static import SphericalHarmonics
from tests import scenes
from tests.backends import BACKENDS, FAST, SLOW_HERE, by

CAMERA = scenes.camera(20, 16)
N, K = 20, 8
NET = scenes.tensors(N, hidden=4)


def settings(backend: str, **more: Any) -> RenderSettings:
    return RenderSettings(**by(backend), **more)


def model(
    density: type[CosineDensity] = CosineDensity, colour: type[SphericalHarmonics] = SphericalHarmonics
) -> Primitives:
    t = scenes.tensors(N, K)
    params = {**{k: v for k, v in t.items() if k != "colors"}, "sh_dc": t["colors"], "sh_rest": torch.zeros(N, 15, 3)}
    return Primitives(density(K), colour(3), params)


def waves(**methods: Callable[..., Any]) -> type[CosineDensity]:
    return type("Waves", (CosineDensity,), methods)


def paint(**methods: Callable[..., Any]) -> type[SphericalHarmonics]:
    return type("Paint", (SphericalHarmonics,), methods)


def lowers(name: str, change: Callable[[Tensor], Any]) -> type[CosineDensity]:
    def lower(self: CosineDensity, params: Any, geometry: Any, conditions: Any) -> Cosine:
        form = CosineDensity.lower(self, params, geometry, conditions)
        return replace(form, **{name: change(getattr(form, name))})

    return waves(lower=lower)


# ---------------------------------------------------------------- fuzz


@pytest.mark.parametrize(
    ("count", "backends"), [(2000, ["cpu", "reference"]), *((100, [b]) for b in FAST if b != "cpu")]
)
def test_no_wrong_form_crashes_or_passes(count: int, backends: list[str]) -> None:
    """In a process of its own: what this guards against is the end of the process. What refuses is the same for all."""
    words = [sys.executable, "-m", "tests.numerics.forms_fuzz", str(count), "0", *backends]
    done = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith(f"{count} wrong forms refused")
    assert f"{count // 20} odd but right ones drawn alike" in done.stdout


# ---------------------------------------------------------------- what a field's author reads

NAN = float("nan")
WRONG: dict[str, tuple[type[CosineDensity], str]] = {
    "w2 too short": (
        lowers("w2", lambda v: v[:5]),
        r"Cosine: w2 has shape \(5, 8\); expected \(20, 8\), as means has N=20",
    ),
    "too many neurons": (
        lowers("W1", lambda v: v.repeat(1, 33, 1)),
        r"Cosine: W1 has shape \(20, 264, 3\); .* at most 256",
    ),
    "another device": (lowers("b1", lambda v: v.to("meta")), r"Cosine: b1 has device meta; expected cpu"),
    "omega0": (lowers("omega0", lambda v: NAN), r"Cosine: omega0 has value nan; expected a finite number"),
    "nothing": (waves(lower=lambda *a: None), r"NoneType; expected Cosine or CustomDensity"),
}
"""One of each kind; the fuzz draws the others, on every backend."""


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_density_names_its_field(name: str) -> None:
    density, message = WRONG[name]
    with pytest.raises(FormError, match=rf"^density field Waves lowered to {message}") as caught:
        render(model(density), CAMERA)
    assert "\n" not in str(caught.value)
    with pytest.raises(FormError, match=rf"^density field Waves lowered to {message}"):
        density_grid(model(density), {}, torch.eye(4, dtype=torch.float64), (4, 4, 4))


@pytest.mark.parametrize(
    ("colour", "message"),
    [
        (
            Constant(torch.ones(N)),
            r"Constant: rgb has shape \(20,\); expected \(N, C\) with N=20 as in means, C at least 1",
        ),
        (Constant(torch.ones(N, 0)), r"Constant: rgb has shape \(20, 0\)"),
        (torch.ones(N, 3), r"Tensor; expected Constant, RayNet or CustomColour"),
        (scenes.colour({**NET, "Wout": torch.ones(N, 4, 3)}), r"RayNet: Wout has .*; expected \(20, 3, 4\)"),
        (
            CustomColour(lambda prim, x, d: x[:, :2], 3),
            r"CustomColour: radiance returned shape \(\d+, 2\); expected .* 3\)",
        ),
        (CustomColour(lambda prim, x, d: x.long(), 3), r"CustomColour: radiance returned torch\.int64"),
        (CustomColour(lambda prim, x, d: x, 0), r"CustomColour: channels has value 0"),
        (CustomColour(None, 3), r"CustomColour: radiance has type NoneType; expected a function"),  # type: ignore[arg-type]
    ],
)
def test_a_wrong_colour_names_its_field(colour: Any, message: str) -> None:
    with pytest.raises(FormError, match=rf"^colour field Paint lowered to {message}"):
        render(model(colour=paint(lower=lambda *a: colour)), CAMERA)


def test_a_wrong_opaque_density_is_named_wherever_it_is_asked() -> None:
    def column(*a: Tensor) -> Tensor:
        return a[3][:, None]

    wrong = model(waves(lower=lambda *a: CustomDensity(column)))
    message = r"lowered to CustomDensity: line_integral returned shape \((\d+), 1\); expected \(\1,\)"
    with pytest.raises(FormError, match=f"^density field Waves {message}"):
        render(wrong, CAMERA)
    both = model(waves(lower=lambda *a: CustomDensity(column), density=lambda self, p, g, prim, x, c: x))
    message = r"^density field Waves: density returned shape \(\d+, 3\); expected \(\d+,\)"
    with pytest.raises(FormError, match=message):
        density_grid(both, {}, torch.eye(4, dtype=torch.float64) * 0.1, (4, 4, 4))
    with pytest.raises(FormError, match=message):
        density_at(both, {}, torch.zeros(3, 3) + both.params["means"][0])


@pytest.mark.parametrize(
    ("methods", "message"),
    [
        *(
            ({"active_rows": lambda self, p, c, rows=rows: rows}, f"active_rows returned {message}")
            for rows, message in (
                (torch.tensor([3, N]), r"rows \[3, 20\]; expected ascending int64 rows \(M,\) from 0 to 19"),
                (torch.tensor([-1, 3]), r"rows \[-1, 3\]"),
                (torch.tensor([4, 2, 3, 5]), r"rows \[4, 2, 3, 5\]"),
                (torch.ones(N).bool(), r"torch\.bool \(20,\) on cpu; expected ascending int64"),
                (torch.tensor([1.0]), r"torch\.float32 \(1,\)"),
                ([1, 2], "type list"),
            )
        ),
        ({"move": lambda self, p, g, c: g[:3]}, r"move: means has shape \(3, 3\); expected \(20, 3\)"),
        (
            {"move": lambda self, p, g, c: replace(g, quats=g.quats.T)},
            r"move: quats has shape \(4, 20\); expected .*4\)",
        ),
        ({"move": lambda self, p, g, c: replace(g, means=g.means.half())}, r"move: means has dtype torch\.float16"),
        ({"move": lambda self, p, g, c: g.means}, r"move has type Tensor; expected Geometry"),
    ],
)
def test_rows_and_places_name_their_method(methods: dict[str, Any], message: str) -> None:
    wrong = model(waves(**methods))
    asks = (
        lambda: render(wrong, CAMERA),
        lambda: wrong.lower_density({}),
        lambda: density_at(wrong, {}, torch.zeros(1, 3)),
    )
    for ask in asks:
        with pytest.raises(FormError, match=rf"^density field Waves: {message}"):
            ask()


@pytest.mark.parametrize(
    ("shade", "message"),
    [
        (Shading(pixels=lambda points: points), r"shade returned shape \((\d+), 3\); expected \(\1,\)"),
        (Shading(pixels=0.5), "shade has type float; expected a function or None"),  # type: ignore[arg-type]
        (0.5, "shade returned type float; expected Shading or None"),
        (Shading(torch.ones(1)), r"shade: primitives returned shape \(1,\); expected \(\d+,\)"),
    ],
)
def test_a_wrong_shade_names_its_field(shade: Any, message: str) -> None:
    with pytest.raises(FormError, match=f"^colour field Paint: {message}"):
        render(model(colour=paint(shade=lambda *a: shade)), CAMERA)


# ---------------------------------------------------------------- what surrounds the forms


def test_backgrounds_rows_and_cameras() -> None:
    lowered, away = scenes.lowered(scenes.tensors(N)), replace(CAMERA, viewmat=torch.eye(2))
    without: Any = replace(lowered, geometry=None)  # type: ignore[arg-type]
    for form, camera, background, message in (
        (
            lowered,
            CAMERA,
            torch.ones(1),
            r"background has shape \(1,\); expected \(3,\), as colour lowered to Constant has",
        ),
        (lowered, away, None, r"viewmat has shape \(2, 2\); expected \(4, 4\)"),
        (
            replace(lowered, rows=torch.arange(19)),
            CAMERA,
            None,
            r"LoweredPrimitives\.rows holds 19 rows for 20 primitives",
        ),
        (without, CAMERA, None, "geometry has type NoneType; expected Geometry"),
    ):
        with pytest.raises(FormError, match=f"^{message}"):
            render_lowered(form, camera, RenderSettings(), background)


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("backend", BACKENDS)
def test_an_error_map_of_another_size(backend: str, samples: int) -> None:
    """Where it is given, not in the backward pass."""
    t = {k: v.requires_grad_() for k, v in scenes.tensors(N).items()}
    out = render_lowered(scenes.lowered(t), CAMERA, settings(backend, samples=samples))
    with pytest.raises(FormError, match=r"error has shape \(3, 4\); expected \(16, 20\), that of the frame$"):
        out.request_contributions(torch.ones(3, 4))
    with pytest.raises(FormError, match=r"error has type ndarray; expected a torch tensor$"):
        out.request_contributions(np.ones((16, 20)))  # type: ignore[arg-type]
    assert out.stats.contributions is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rest": torch.zeros(N, 8, 3)}, r"rest has 8 bands; expected at least 15 for degree 3"),
        (
            {"rest": torch.zeros(N - 1, 15, 3)},
            r"rest has shape \(19, 15, 3\); expected \(N, bands, C\) with N=20 as in",
        ),
        ({"rest": torch.zeros(N, 15, 2)}, r"rest has shape \(20, 15, 2\)"),
        ({"rest": None}, r"rest is None; expected \(N, at least 15, C\)"),
        ({"dc": torch.zeros(N)}, r"dc has shape \(20,\); expected \(N, C\) with N=20 as in means"),
        ({"means": torch.zeros(N, 2)}, r"means has shape \(20, 2\); expected \(N, 3\)"),
        ({"origin": torch.zeros(2)}, r"origin has shape \(2,\); expected \(3,\)"),
        ({"degree": 4, "rest": torch.zeros(N, 24, 3)}, r"degree 4; expected 0\.\.3"),
    ],
)
def test_harmonics_do_not_read_beyond_their_tensors(change: dict[str, Any], message: str) -> None:
    whole = {"means": torch.ones(N, 3), "dc": torch.zeros(N, 3), "rest": torch.zeros(N, 15, 3)}
    whole |= {"origin": torch.zeros(3), "degree": 3}
    assert sh.sh_colors(**whole).shape == (N, 3)
    with pytest.raises(FormError, match=f"^sh.colors: {message}"):
        sh.sh_colors(**{**whole, **change})


# ---------------------------------------------------------------- what is right stays right


def drawn(t: dict[str, Tensor], backend: str, **more: Any) -> tuple[Tensor, dict[str, Tensor]]:
    t = {k: v.detach().clone().requires_grad_() for k, v in t.items()}
    image = render_lowered(
        scenes.lowered(t), CAMERA, settings(backend, alpha_min=0.0, transmittance_min=0.0, **more)
    ).rgb
    image.sum().backward()
    return image.detach(), {k: v.grad for k, v in t.items() if v.grad is not None}


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("hidden", [None, 8])
@pytest.mark.parametrize("names", [["W1"], ["means", "w2"], ["b2"], ["base", "colors"], ["Wx"]])
def test_dtypes_may_be_mixed(names: list[str], hidden: int | None, backend: str) -> None:
    t = scenes.tensors(N, hidden=hidden)
    mixed = {k: v.double() if k in names else v for k, v in t.items()}
    (image, grads), (other, found) = drawn(t, backend), drawn(mixed, backend)
    assert torch.equal(image, other.float())
    for name, grad in grads.items():
        assert found[name].dtype == mixed[name].dtype and torch.equal(grad, found[name].float()), name


@pytest.mark.parametrize("sort", ["center", "entry"])
@pytest.mark.parametrize(("neurons", "hidden"), [(MOST_UNITS, None), (17, MOST_UNITS)])
@pytest.mark.parametrize(
    "backend", [pytest.param(b, marks=[pytest.mark.slow] if b in SLOW_HERE else []) for b in FAST]
)  # half a minute to compile
def test_as_many_units_as_the_kernels_know(backend: str, neurons: int, hidden: int | None, sort: str) -> None:
    t = scenes.tensors(N, neurons, hidden=hidden)
    t["w2"] = t["w2"] / neurons**0.5
    image, grads = drawn(t, backend, sort=sort)
    truth, expected = drawn({k: v.double() for k, v in t.items()}, "reference", sort=sort)
    assert (image - truth).abs().max() < 2e-6
    for name, grad in expected.items():
        assert (grads[name] - grad).norm() <= 1e-4 * grad.norm(), name

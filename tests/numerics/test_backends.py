"""The fast backends against the float64 reference, and the reference against finite differences."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.errors import BackendUnavailable, NonFiniteError
from neuprim.core.model.fields import Constant, CustomColour, CustomDensity
from neuprim.core.render import RenderSettings, choose_backend, render_lowered
from tests import scenes
from tests.backends import BACKENDS, FAST, LEFT_OUT, by
from tests.numerics.cases import CASES, DEFAULT, case
from tests.numerics.compare import assert_same_frame, draw, row_errors


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("name", CASES)
def test_equals_reference(name: str, backend: str) -> None:
    t, camera, settings = case(name)
    fast, slow = assert_same_frame(t, camera, settings, backend=backend)
    assert slow.output.alpha.max() > 0.1, "the view must show something"
    assert fast.output.rgb.dtype == torch.float32 and slow.output.rgb.dtype == torch.float64
    seen = slow.tally
    other = fast.tally
    # the sums run over all pixels, so a single pair on the other side of a cut shows: alpha_min x T at most
    assert (other.weight - seen.weight).abs().max() <= 2e-5 * seen.weight.max() + 2 / 255
    assert (other.error_weight - seen.error_weight).abs().max() <= 2e-5 * seen.error_weight.max() + 1e-4
    assert torch.equal(other.weight > 0.05, seen.weight > 0.05)
    assert other.weight[seen.weight == 0].abs().sum() <= 2 / 255


def test_cases_mean_what_they_say() -> None:
    """The camera really is inside primitives, the near plane really cuts chords, opacity really saturates."""
    t, camera, settings = case("inside")
    rotation = scenes.lowered(t).geometry.rotations.double()
    inside = (
        ((camera.position - t["means"].double())[:, None] @ rotation)[:, 0] / t["log_scales"].double().exp()
    ).norm(dim=1) < 1
    assert inside.sum() >= 2
    for name, other in (
        ("near plane", {"near": 0.01}),
        ("low ceiling", {"alpha_max": 0.99}),
        ("opaque", {"transmittance_min": 0.0}),
    ):
        t, camera, settings = case(name)
        first, second = (
            render_lowered(scenes.lowered(t), camera, s).alpha for s in (settings, replace(settings, **other))
        )
        assert (first - second).abs().max() > (1e-6 if name == "opaque" else 0.05), name


def test_no_backend_is_left_out() -> None:
    if LEFT_OUT:
        pytest.skip("not tested here: " + "; ".join(f"{name}: {why}" for name, why in LEFT_OUT.items()))


def test_a_view_that_shows_nothing() -> None:
    t = scenes.tensors(20)
    camera = scenes.camera(33, 20)
    view = camera.viewmat.clone()
    view[2] *= -1
    view[0] *= -1  # turned round
    background = torch.tensor([0.1, 0.6, 0.3], requires_grad=True)
    for backend in BACKENDS:
        leaves = {k: v.clone().requires_grad_() for k, v in t.items()}
        background.grad = None
        out = render_lowered(
            scenes.lowered(leaves), replace(camera, viewmat=view), replace(DEFAULT, **by(backend)), background
        )
        assert torch.equal(out.rgb, background.detach().expand(20, 33, 3)) and out.depth is not None
        assert out.alpha.abs().max() == 0 and out.depth.abs().max() == 0
        (out.rgb.sum() + out.alpha.sum() + out.depth.sum()).backward()
        assert all(v.grad is None or v.grad.abs().max() == 0 for v in leaves.values())
        assert background.grad is not None and torch.allclose(background.grad, torch.full((3,), 660.0))


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_primitives_at_all(backend: str) -> None:
    leaves = {k: v[:0].clone().requires_grad_() for k, v in scenes.tensors(2).items()}
    out = render_lowered(
        scenes.lowered(leaves), scenes.camera(20, 17), RenderSettings(**by(backend)), torch.tensor([0.5, 0.25, 1.0])
    )
    assert torch.equal(out.rgb, torch.tensor([0.5, 0.25, 1.0]).expand(17, 20, 3))
    assert out.alpha.abs().max() == 0
    if out.rgb.requires_grad:
        out.request_contributions(torch.ones(17, 20))
        out.rgb.sum().backward()


@pytest.mark.parametrize("backend", FAST)
def test_any_number_of_threads_gives_the_same_bits(backend: str) -> None:
    t, camera = scenes.tensors(1500, 5, seed=3, radius=0.06), scenes.camera(100, 70)
    frames = [draw(backend, t, camera, replace(DEFAULT, threads=n)) for n in (1, 2, 3)]
    for other in frames[1:]:
        for image in ("rgb", "alpha", "depth"):
            assert torch.equal(getattr(frames[0].output, image), getattr(other.output, image)), image
        for name, grad in frames[0].grads.items():
            assert torch.equal(grad, other.grads[name]), name
        for sums in ("weight", "error_weight"):
            assert torch.equal(getattr(frames[0].tally, sums), getattr(other.tally, sums)), sums
    assert frames[0].output.alpha.max() > 0.5


@pytest.mark.parametrize("backend", FAST)
def test_a_far_camera_loses_no_digits(backend: str) -> None:
    """A thousand radii away every primitive is a few pixels wide: float64 preparation keeps them exact."""
    t = scenes.tensors(80, 8, seed=5, radius=0.01)
    t["means"] *= 0.05
    camera = scenes.camera(48, 35, distance=100.0, fov=0.06)
    assert_same_frame(t, camera, DEFAULT, backend=backend)


@pytest.mark.parametrize("backend", FAST)
def test_order_of_primitives_does_not_matter(backend: str) -> None:
    t, camera, settings = case("K=8 C=3")
    shuffle = torch.randperm(len(t["means"]), generator=torch.Generator().manual_seed(1))
    first, second = (draw(backend, u, camera, settings) for u in (t, {k: v[shuffle] for k, v in t.items()}))
    assert torch.equal(first.output.rgb, second.output.rgb)
    assert torch.equal(first.grads["means"][shuffle], second.grads["means"])


# ---------------------------------------------------------------- gradients of the oracle itself


@pytest.mark.parametrize(
    ("neurons", "distance", "near"), [(2, 3.0, 0.01), (0, 3.0, 0.01), (2, 0.4, 0.05), (3, 3.0, 2.9)]
)
def test_reference_gradients_are_finite_differences(neurons: int, distance: float, near: float) -> None:
    t = scenes.tensors(5, neurons, seed=11, radius=0.4, dtype=torch.float64)
    camera = scenes.camera(7, 5, distance=distance, fov=50 if distance > 1 else 80, shift=(0.37, -0.21))
    settings = RenderSettings(backend="reference", near=near, alpha_min=1e-9, depth_floor=1e-14, depth=True)
    g = torch.Generator().manual_seed(0)
    names = [k for k in t if t[k].numel()]
    w_rgb, w_z = (
        torch.randn(5, 7, 3, generator=g, dtype=torch.float64),
        torch.randn(5, 7, generator=g, dtype=torch.float64),
    )

    def functional(view: Tensor, background: Tensor, *values: Tensor) -> Tensor:
        low = scenes.lowered({**t, **dict(zip(names, values, strict=True))})
        out = render_lowered(low, replace(camera, viewmat=view), settings, background)
        assert out.depth is not None
        return (out.rgb * w_rgb).sum() + (out.alpha * w_z).sum() + (out.depth * w_z.flip(0)).sum()

    inputs = [
        camera.viewmat.clone(),
        torch.tensor([0.3, 0.5, 0.1], dtype=torch.float64),
        *(t[k].clone() for k in names),
    ]
    assert render_lowered(scenes.lowered(t), camera, settings).alpha.max() > 0.3
    assert torch.autograd.gradcheck(functional, [x.requires_grad_() for x in inputs], eps=1e-7, atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("backend", FAST)
def test_only_the_asked_for_gradients_are_made(backend: str) -> None:
    t, camera, settings = case("K=8 C=3")
    alone = draw(backend, t, camera, settings, with_view=False)
    both = draw(backend, t, camera, settings)
    assert "viewmat" not in alone.grads
    assert all(torch.equal(alone.grads[k], both.grads[k]) for k in t)


@pytest.mark.parametrize("backend", FAST)
def test_the_floor_on_grazing_rays_is_shared(backend: str) -> None:
    """A large floor changes the gradients of both backends alike and the image of neither."""
    t, camera, settings = case("K=3 C=5")
    floored = replace(settings, depth_floor=0.2)
    fast, _ = assert_same_frame(t, camera, floored, backend=backend)
    plain = draw(backend, t, camera, settings)
    assert torch.equal(fast.output.rgb, plain.output.rgb)
    assert row_errors(fast.grads["log_scales"], plain.grads["log_scales"]).max() > 0.01


# ---------------------------------------------------------------- numbers that are not


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "W1", "b1", "w2", "b2", "colors"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_non_finite_input_is_named(name: str, value: float) -> None:
    t = scenes.tensors(20)
    t[name][13].view(-1)[-1] = value
    with pytest.raises(NonFiniteError, match=rf"\b{name} of primitive 13\b"):
        render_lowered(scenes.lowered(t), scenes.camera(20, 20), RenderSettings(backend="cpu"))


def test_non_finite_input_behind_the_camera_is_named_too() -> None:
    t = scenes.tensors(20)
    t["means"][4] = scenes.camera().position.float() * 3
    t["w2"][4, 0] = float("nan")
    with pytest.raises(NonFiniteError, match=r"w2 of primitive 4\b"):
        render_lowered(scenes.lowered(t), scenes.camera(20, 20), RenderSettings(backend="cpu"))


def test_zero_quaternion_is_named() -> None:
    t = scenes.tensors(20)
    t["quats"][7] = 0
    with pytest.raises(NonFiniteError, match=r"quats of primitive 7 is zero"):
        render_lowered(scenes.lowered(t), scenes.camera(20, 20), RenderSettings(backend="cpu"))


@pytest.mark.parametrize("value", [1000.0, 95.0, -1000.0])
def test_scales_beyond_the_range_are_named(value: float) -> None:
    t = scenes.tensors(20)
    t["log_scales"][3] = value
    with pytest.raises(NonFiniteError, match=r"log_scales of primitive 3\b"):
        render_lowered(scenes.lowered(t), scenes.camera(20, 20), RenderSettings(backend="cpu"))


# ---------------------------------------------------------------- choice of a backend


def test_forms_without_a_kernel_go_to_the_reference() -> None:
    low = scenes.lowered(scenes.tensors(3))
    assert choose_backend(low, RenderSettings()).name == "cpu"
    opaque = CustomDensity(lambda prim, o, d, t0, t1: t1 - t0)
    assert choose_backend(replace(low, density=opaque), RenderSettings()).name == "reference"
    colour = CustomColour(lambda prim, x, d: x, 3)
    assert choose_backend(replace(low, colour=colour), RenderSettings()).name == "reference"
    with pytest.raises(BackendUnavailable, match="CustomDensity density"):
        render_lowered(replace(low, density=opaque), scenes.camera(8, 8), RenderSettings(backend="cpu"))


def test_opaque_forms_draw_what_the_closed_forms_draw() -> None:
    t = scenes.tensors(15, 0, dtype=torch.float64)
    low, camera, settings = scenes.lowered(t), scenes.camera(20, 15), RenderSettings(backend="reference")
    m = low.geometry.length_scale
    opaque = CustomDensity(lambda prim, o, d, t0, t1: (t1 - t0) * t["b2"][prim, 0] / m[prim])
    colour = CustomColour(lambda prim, x, d: t["colors"][prim], 3)
    assert isinstance(low.colour, Constant)
    first = render_lowered(low, camera, settings).rgb
    assert first.max() > 0.2
    for other in (
        replace(low, density=opaque),
        replace(low, colour=colour),
        replace(low, density=opaque, colour=colour),
    ):
        assert (render_lowered(other, camera, settings).rgb - first).abs().max() < 1e-12

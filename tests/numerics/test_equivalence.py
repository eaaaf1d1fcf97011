"""Every backend draws what the float64 reference draws: form x edge x order x view, with all gradients."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.backends import REFERENCE
from tests import scenes
from tests.backends import BACKENDS, FAST, SLOW_HERE, by
from tests.numerics.cases import CONSTANT, DEFAULT, NETWORK, Case, case, make_case
from tests.numerics.equivalence import assert_same_bits, draw, row_errors, same, same_contributions

SORTS = ("center", "entry")
NET = ("Wx", "bias", "Wout", "base")
OWN_KERNELS = ("K=0 C=1", "K=1 C=3", "K=3 C=5", "K=16 C=1", "no depth")
"""Cases with kernels of their own on a GPU. A GPU's backend on a CPU compiles them for minutes. It draws them with a
hard edge, in the order of centres."""
EDGE_1 = "inside"
"""The case that is drawn with edge 1 unless slow tests run: edge 1 is edge 2 but for a polynomial."""


def worth_compiling(name: str, backend: str) -> bool:
    return name not in OWN_KERNELS or backend not in SLOW_HERE


HARD = [
    (name, sort, b) for name in CONSTANT for sort in SORTS for b in FAST if sort == "center" or worth_compiling(name, b)
]
SOFT = [(name, "center") for name in CONSTANT] + [(name, "entry") for name in ("K=3 C=5", "inside", "near plane")]
# at distance/radius 1e5 entries differ by less than float32 knows of their depth
NETWORKS = [(name, "center") for name in NETWORK]
NETWORKS += [(name, "entry") for name in NETWORK if "1e5" not in name and name != "no units"]


@pytest.mark.parametrize(("name", "sort", "backend"), HARD)
def test_hard_edges(name: str, sort: str, backend: str) -> None:
    fast, slow = same(backend, REFERENCE, make_case(name, sort=sort))
    assert slow.output.alpha.max() > 0.1, "the view must show something"
    assert fast.output.rgb.dtype == torch.float32 and slow.output.rgb.dtype == torch.float64
    same_contributions(fast, slow, (2 if sort == "center" else 4) / 255)


@pytest.mark.parametrize(
    ("name", "sort", "edge", "backend"),
    [
        pytest.param(name, sort, edge, b, marks=[pytest.mark.slow] if edge == 1 and name != EDGE_1 else [])
        for name, sort in SOFT
        for edge in (1, 2)
        for b in FAST
        if worth_compiling(name, b)
    ],
)
def test_soft_edges(name: str, sort: str, edge: int, backend: str) -> None:
    _, slow = same(backend, REFERENCE, make_case(name, edge, sort))
    assert slow.output.alpha.max() > 0.05


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize(("name", "sort"), NETWORKS)
def test_colour_networks(name: str, sort: str, backend: str) -> None:
    fast, slow = same(backend, REFERENCE, make_case(f"network: {name}", sort=sort))
    assert slow.output.alpha.max() > 0.1
    if " rad" in name:  # float32 knows the slower phases well enough, the others not
        assert (fast.output.stats.extra["float64"] > 30) == ("30 rad" not in name)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("sort", SORTS)
@pytest.mark.parametrize("edge", [0, pytest.param(1, marks=pytest.mark.slow), 2])  # 1 is 2 but for a polynomial
@pytest.mark.parametrize("view", [{}, {"distance": 0.15, "fov": 70.0}], ids=["outside", "inside"])
def test_colour_networks_and_edges(view: dict[str, float], edge: int, sort: str, backend: str) -> None:
    """Inside, where the near plane cuts chords, a colour moves with its chord's middle, and the density does not."""
    t = scenes.tensors(40, 3, seed=7, hidden=5)
    knobs = RenderSettings(sort=sort, depth=True, near=0.05)  # type: ignore[arg-type]
    fast, slow = same(backend, REFERENCE, Case(t, scenes.camera(33, 25, **view), knobs, edge))
    assert slow.output.alpha.max() > 0.3
    assert edge == 0 or (fast.output.stats.extra["float64"] > 3) == bool(view)
    assert all(slow.grads[k].abs().max() > 1e-3 for k in NET)


# ---------------------------------------------------------------- drawn cases

COMMON: dict[str, Any] = {"derandomize": True, "deadline": None, "database": None}
COMMON["suppress_health_check"] = list(HealthCheck)


def drawn_cases(
    units: st.SearchStrategy[tuple[int, int | None]], channels: list[int], edges: list[int]
) -> st.SearchStrategy[Case]:
    """Cases with ``units``: the neurons of a density, and those of a colour network or None."""

    def build(units: tuple[int, int | None], model: Any, view: Any, knobs: Any, edge: int) -> Case:
        t = scenes.tensors(neurons=units[0], hidden=units[1], **model)
        return Case(t, scenes.camera(**view), replace(DEFAULT, **knobs), edge)

    model = st.fixed_dictionaries({
        "count": st.sampled_from([1, 8, 40]),
        "channels": st.sampled_from(channels),
        "seed": st.integers(0, 999),
        "radius": st.sampled_from([0.1, 0.2, 0.35]),
    })  # fmt: skip
    view = st.fixed_dictionaries({
        "width": st.integers(1, 40),
        "height": st.integers(1, 30),
        "distance": st.sampled_from([0.3, 1.2, 3.0, 8.0]),
        "fov": st.sampled_from([30.0, 60.0, 100.0]),
        "shift": st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
    })  # fmt: skip
    knobs = st.fixed_dictionaries({
        "sort": st.sampled_from(SORTS),
        "near": st.sampled_from([0.01, 0.3, 2.9]),
        "depth": st.booleans(),
        "alpha_max": st.sampled_from([0.2, 0.99]),
        "depth_floor": st.just(1e-3),
    })  # fmt: skip
    return st.builds(build, units, model, view, knobs, st.sampled_from(edges))


def check_drawn(backend: str, drawn: Case) -> None:
    with scenes.soft(drawn.edge):
        assume(render_lowered(scenes.lowered(drawn.tensors), drawn.camera, drawn.settings).alpha.max() > 0.1)
    try:
        same(backend, REFERENCE, drawn, image_bound=2e-5, grad_bound=1e-2)
    except AssertionError as error:
        assume("undecided" not in str(error))
        raise


ANY_UNITS = st.tuples(st.sampled_from([0, 1, 3, 8, 16]), st.sampled_from([None, 0, 1, 5, 16]))


@settings(max_examples=40, **COMMON)
@given(drawn_cases(ANY_UNITS, [1, 3, 5], [0, 2]))
def test_drawn_cases(drawn: Case) -> None:
    check_drawn("cpu", drawn)


@pytest.mark.slow
@settings(max_examples=400, **COMMON)
@given(drawn_cases(ANY_UNITS, [1, 3, 5], [0, 1, 2]))
def test_many_drawn_cases(drawn: Case) -> None:
    check_drawn("cpu", drawn)


@pytest.mark.parametrize("backend", [name for name in FAST if name != "cpu"])
@settings(max_examples=10, **COMMON)
@given(drawn=drawn_cases(st.sampled_from([(8, None), (3, 5)]), [3], [0, 2]))  # other tests compile these kernels too
def test_drawn_cases_on_other_backends(backend: str, drawn: Case) -> None:
    check_drawn(backend, drawn)


# ---------------------------------------------------------------- the same bits, and the same nothing


@pytest.mark.parametrize("sort", SORTS)
@pytest.mark.parametrize("hidden", [None, 5])
def test_any_number_of_threads_gives_the_same_bits(hidden: int | None, sort: str) -> None:
    t, camera = scenes.tensors(1500, 5, seed=3, radius=0.06, hidden=hidden), scenes.camera(100, 70)
    first, *others = (draw("cpu", t, camera, replace(DEFAULT, threads=n, sort=sort)) for n in (1, 2, 3))  # type: ignore[arg-type]
    for other in others:
        assert_same_bits(first, other)
    assert first.output.alpha.max() > 0.5


@pytest.mark.parametrize("backend", FAST)
def test_order_of_primitives_does_not_matter(backend: str) -> None:
    t, camera, knobs = case("K=8 C=3")
    shuffle = torch.randperm(len(t["means"]), generator=torch.Generator().manual_seed(1))
    first, second = (draw(backend, u, camera, knobs) for u in (t, {k: v[shuffle] for k, v in t.items()}))
    assert torch.equal(first.output.rgb, second.output.rgb)
    assert torch.equal(first.grads["means"][shuffle], second.grads["means"])


@pytest.mark.parametrize("sort", SORTS)
@pytest.mark.parametrize("hidden", [None, 8])
@pytest.mark.parametrize("backend", BACKENDS)
def test_nothing_to_draw(backend: str, hidden: int | None, sort: str) -> None:
    """No primitives, primitives far away, and a camera that looks away: the background and its gradient alone."""
    t, camera = scenes.tensors(20, hidden=hidden), scenes.camera(33, 20)
    away = camera.viewmat.clone()
    away[[0, 2]] *= -1
    far = {**t, "means": t["means"] + 50.0}
    for model, view in (({k: v[:0] for k, v in t.items()}, camera), (far, camera), (t, replace(camera, viewmat=away))):
        leaves = {k: v.clone().requires_grad_() for k, v in model.items()}
        background = torch.tensor([0.1, 0.6, 0.3], requires_grad=True)
        out = render_lowered(scenes.lowered(leaves), view, replace(DEFAULT, **by(backend), sort=sort), background)  # type: ignore[arg-type]
        assert torch.equal(out.rgb, background.detach().expand(20, 33, 3)) and out.depth is not None
        assert out.alpha.abs().max() == 0 and out.depth.abs().max() == 0
        out.request_contributions(torch.ones(20, 33))
        (out.rgb.sum() + out.alpha.sum() + out.depth.sum()).backward()
        assert all(v.grad is None or v.grad.numel() == 0 or v.grad.abs().max() == 0 for v in leaves.values())
        assert background.grad is not None and torch.allclose(background.grad, torch.full((3,), 660.0))


@pytest.mark.parametrize("backend", FAST)
def test_the_floor_on_grazing_rays_is_shared(backend: str) -> None:
    """A large floor changes the gradients of both backends alike and the image of neither."""
    made = make_case("K=8 C=3")
    fast, _ = same(backend, REFERENCE, replace(made, settings=replace(made.settings, depth_floor=0.2)))
    plain = draw(backend, made.tensors, made.camera, made.settings)
    assert torch.equal(fast.output.rgb, plain.output.rgb)
    assert row_errors(fast.grads["log_scales"], plain.grads["log_scales"]).max() > 0.01


@pytest.mark.parametrize("backend", FAST)
def test_a_far_camera_loses_no_digits(backend: str) -> None:
    """A thousand radii away every primitive is a few pixels wide: float64 preparation keeps them exact."""
    t = scenes.tensors(80, 8, seed=5, radius=0.01)
    t["means"] *= 0.05
    same(backend, REFERENCE, Case(t, scenes.camera(48, 35, distance=100.0, fov=0.06), DEFAULT))


@pytest.mark.parametrize("backend", FAST)
def test_float64_pixels_are_sorted_too(backend: str) -> None:
    """Needles and discs near the camera, which fast backends draw in float64."""
    t = scenes.tensors(40, seed=2, radius=0.3)
    t["log_scales"][:, 0] -= 4.0
    knobs = replace(DEFAULT, sort="entry", depth_floor=1e-3)
    fast, _ = same(backend, REFERENCE, Case(t, scenes.camera(40, 30, distance=0.5, fov=60), knobs))
    assert fast.output.stats.extra["float64"] > 3


# ---------------------------------------------------------------- the cases themselves


def test_cases_mean_what_they_say() -> None:
    """The camera is inside primitives, the near plane cuts chords, opacity saturates, the orders differ."""
    t, camera, knobs = case("inside")
    rotation = scenes.lowered(t).geometry.rotations.double()
    local = ((camera.position - t["means"].double())[:, None] @ rotation)[:, 0] / t["log_scales"].double().exp()
    assert (local.norm(dim=1) < 1).sum() >= 2
    for name, change, least in (
        ("near plane", {"near": 0.01}, 0.05),
        ("low ceiling", {"alpha_max": 0.99}, 0.05),
        ("opaque", {"transmittance_min": 0.0}, 1e-6),
        ("K=8 C=3", {"sort": "entry"}, 0.02),
    ):
        t, camera, knobs = case(name)
        a, b = (render_lowered(scenes.lowered(t), camera, s).rgb for s in (knobs, replace(knobs, **change)))
        assert (a - b).abs().max() > least, name


def test_network_colours_vary_and_are_clamped_here_and_there() -> None:
    made = make_case("network: depth")
    one = {k: v[:1] for k, v in made.tensors.items()}
    one["means"], one["b2"] = one["means"] * 0, one["b2"] * 0 + 1.0
    rgb = render_lowered(scenes.lowered(one), made.camera, made.settings)
    visible = rgb.alpha > 0.1
    colours = rgb.rgb[visible] / rgb.alpha[visible][:, None]
    assert (colours.amax(0) - colours.amin(0)).max() > 0.2
    assert 0.01 < (colours < 1e-6).float().mean() < 0.9

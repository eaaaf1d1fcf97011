"""The functional front door: the renderer's own images and gradients, batched, and every bad input refused by name."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import neuprim
from neuprim.core.cameras import Camera
from neuprim.core.errors import BackendUnavailable, ConfigError, DataError, NeuprimError, NonFiniteError
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.functional import Rasterized
from tests import scenes
from tests.backends import BACKENDS, FAST, by

WIDTH, HEIGHT = 40, 30
CAMERAS = [
    scenes.camera(WIDTH, HEIGHT),
    scenes.camera(WIDTH, HEIGHT, distance=2.0, fov=60, shift=(7.5, -3.25)),
    scenes.camera(WIDTH, HEIGHT, distance=0.4, fov=90),
]


def arguments(count: int = 30, seed: int = 7, cameras: list[Camera] | None = None, **kw: Any) -> dict[str, Any]:
    """Keyword arguments of a valid call."""
    used = CAMERAS if cameras is None else cameras
    views = torch.stack([c.viewmat for c in used]) if used else torch.zeros(0, 4, 4)
    Ks = torch.stack([c.K for c in used]) if used else torch.zeros(0, 3, 3)
    return {**scenes.tensors(count, seed=seed, **kw), "viewmats": views, "Ks": Ks, "width": WIDTH, "height": HEIGHT}


def rasterize(width: int = WIDTH, height: int = HEIGHT, **given: Any) -> Rasterized:
    """The call of :func:`arguments`, in which primitive tensors and other arguments are mixed."""
    names = {"log_gain", *scenes.tensors(1)} & given.keys()
    primitives = {name: given.pop(name) for name in sorted(names)}
    return neuprim.rasterize(primitives, given.pop("viewmats"), given.pop("Ks"), (width, height), **given)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("channels", [1, 3, 7])
def test_equals_the_renderer_camera_by_camera(backend: str, channels: int) -> None:
    a = arguments(channels=channels)
    backgrounds = torch.rand(3, channels, generator=torch.Generator().manual_seed(0))
    out = rasterize(**a, backgrounds=backgrounds, **by(backend), depth=True, near=0.05)
    assert isinstance(out, Rasterized) and out.depth is not None
    assert out.rgb.shape == (3, HEIGHT, WIDTH, channels) and out.alpha.shape == out.depth.shape == (3, HEIGHT, WIDTH)
    assert out.rgb.dtype == torch.float32 and [s.backend for s in out.stats] == [backend] * 3
    settings = RenderSettings(**by(backend), depth=True, near=0.05)
    for c, camera in enumerate(CAMERAS):
        one = render_lowered(scenes.lowered(a), camera, settings, backgrounds[c])
        assert one.alpha.max() > 0.3
        assert (
            torch.equal(out.rgb[c], one.rgb)
            and torch.equal(out.alpha[c], one.alpha)
            and torch.equal(out.depth[c], one.depth)
        )  # type: ignore[arg-type]
    shared = rasterize(**a, backgrounds=backgrounds[0], **by(backend), near=0.05)
    assert (
        torch.equal(shared.rgb[0], out.rgb[0]) and not torch.equal(shared.rgb[1], out.rgb[1]) and shared.depth is None
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_edges_and_gains_are_those_of_a_model(backend: str) -> None:
    a = arguments()
    log_gain = torch.linspace(-1, 1, 30)[:, None].requires_grad_()
    hard = rasterize(**a, **by(backend)).rgb
    for edge in (1, 2):
        soft = rasterize(**a, edge=edge, log_gain=log_gain, **by(backend))
        by_hand = {**a, "w2": a["w2"] * log_gain.exp(), "b2": a["b2"] * log_gain.exp()}
        assert torch.equal(rasterize(**by_hand, edge=edge, **by(backend)).rgb, soft.rgb)
        assert torch.equal(rasterize(**a, edge=edge, log_gain=log_gain[:, 0], **by(backend)).rgb, soft.rgb)
        assert not torch.allclose(soft.rgb, hard, atol=1e-2)
        (grad,) = torch.autograd.grad(soft.rgb.sum(), log_gain)
        assert float(grad.abs().max()) > 1e-3


def grads(backend: str, names: list[str], dtype: torch.dtype) -> dict[str, Tensor]:
    a = arguments()
    a["backgrounds"] = torch.tensor([[0.2, 0.4, 0.9]]).expand(3, 3)
    for k in (*scenes.tensors(1), "backgrounds"):
        a[k] = a[k].to(dtype)
    for k in names:
        a[k] = a[k].clone().requires_grad_()
    out = rasterize(**a, **by(backend), alpha_min=0.0, transmittance_min=0.0)
    g = torch.Generator().manual_seed(1)
    (out.rgb * torch.randn(out.rgb.shape, generator=g).to(dtype)).sum().backward()
    return {k: a[k].grad for k in names}


@pytest.mark.parametrize("backend", FAST)
def test_gradients_to_everything_agree_between_the_backends(backend: str) -> None:
    names = [*scenes.tensors(1), "viewmats", "backgrounds"]
    fast, slow = grads(backend, names, torch.float32), grads("reference", names, torch.float64)
    for name in names:
        assert slow[name].abs().max() > 0, name
        assert fast[name].shape == slow[name].shape
        assert (fast[name].double() - slow[name]).norm() <= 1e-3 * slow[name].norm(), name
    assert all(slow["viewmats"][c].abs().max() > 0 for c in range(3))


def test_poses_intrinsics_and_backgrounds_against_finite_differences() -> None:
    cameras = [scenes.camera(7, 5, fov=50, shift=(0.4, -0.2)), scenes.camera(7, 5, distance=0.4, fov=80)]
    a = {**arguments(5, 11, cameras, neurons=2, radius=0.4, dtype=torch.float64), "width": 7, "height": 5}
    w = torch.randn(2, 5, 7, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def functional(viewmats: Tensor, numbers: Tensor, backgrounds: Tensor) -> Tensor:
        fx, fy, cx, cy = numbers.unbind(1)
        o, i = torch.zeros_like(fx), torch.ones_like(fx)
        Ks = torch.stack([fx, o, cx, o, fy, cy, o, o, i], -1).reshape(2, 3, 3)
        knobs = {"alpha_min": 1e-9, "depth_floor": 1e-14, "near": 0.05, "depth": True, "backend": "reference"}
        out = rasterize(**{**a, "viewmats": viewmats, "Ks": Ks}, backgrounds=backgrounds, **knobs)
        assert out.depth is not None
        return (torch.cat([out.rgb, out.alpha[..., None], out.depth[..., None]], -1) * w).sum()

    numbers = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float64)
    # the last row of a pose is fixed, so differences are taken in its other twelve entries
    free = a["viewmats"][:, :3].clone()
    bottom = a["viewmats"][:, 3:]
    backgrounds = torch.tensor([[0.3, 0.5, 0.1], [0.9, 0.2, 0.4]], dtype=torch.float64)
    inputs = [x.requires_grad_() for x in (free, numbers, backgrounds)]
    assert torch.autograd.gradcheck(
        lambda v, k, b: functional(torch.cat([v, bottom], 1), k, b), inputs, eps=1e-7, atol=5e-6, rtol=1e-5
    )


@pytest.mark.parametrize("backend", ["cpu", "auto"])
def test_intrinsics_have_no_silent_zero_gradient(backend: str) -> None:
    a = arguments()
    a["Ks"].requires_grad_()
    with pytest.raises(BackendUnavailable, match=r'Ks requires a gradient.*pass backend="reference" or Ks\.detach\(\)'):
        rasterize(**a, backend=backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_cameras_and_no_primitives(backend: str) -> None:
    a = arguments(cameras=[])
    a["means"].requires_grad_()
    none = rasterize(**a, **by(backend), depth=True)
    assert none.rgb.shape == (0, HEIGHT, WIDTH, 3) and none.alpha.shape == (0, HEIGHT, WIDTH) and none.stats == ()
    assert none.depth is not None and none.depth.shape == (0, HEIGHT, WIDTH)
    none.rgb.sum().backward()
    assert a["means"].grad is not None and a["means"].grad.abs().max() == 0
    empty = rasterize(**arguments(0), **by(backend), backgrounds=torch.tensor([0.5, 0.25, 1.0]))
    assert (
        torch.equal(empty.rgb, torch.tensor([0.5, 0.25, 1.0]).expand(3, HEIGHT, WIDTH, 3))
        and empty.alpha.abs().max() == 0
    )


def test_population_statistics_come_back_per_camera() -> None:
    a = arguments()
    a["means"].requires_grad_()
    out = rasterize(**a)
    error = torch.ones(3, HEIGHT, WIDTH)
    error[1] = 0.5
    tallies = out.request_contributions(error)
    out.rgb.sum().backward()
    for c, tally in enumerate(tallies):
        assert tally.weight.sum().item() == pytest.approx(out.alpha[c].sum().item(), rel=1e-4)
        assert torch.allclose(tally.error_weight, tally.weight * (0.5 if c == 1 else 1.0))
    with pytest.raises(
        DataError,
        match=rf"^rasterize: request_contributions: error has shape \(2, 3\); expected \(3, {HEIGHT}, {WIDTH}\), that "
        rf"of alpha$",
    ):
        out.request_contributions(torch.ones(2, 3))


# ---------------------------------------------------------------- bad input


def changed(name: str, index: tuple[Any, ...], value: float) -> Any:
    def change(a: dict[str, Any]) -> None:
        a[name] = a[name].clone()
        a[name][index] = value

    return change


def put(name: str, value: Any) -> Any:
    return lambda a: a.update({name: value(a[name]) if callable(value) else value})  # a new name is a setting


NAN = float("nan")
BAD: dict[str, tuple[Any, type[NeuprimError], str]] = {
    "means flat": (put("means", lambda v: v.flatten()), DataError, r"means has shape \(90,\); expected \(N, 3\)"),
    "W1": (put("W1", lambda v: v.transpose(1, 2)), DataError,
        r"W1 has shape \(30, 3, 8\); expected \(N, K, 3\) with N=30"),
    "w2": (put("w2", lambda v: v[:7]), DataError, r"w2 has shape \(7, 8\); expected \(30, 8\)"),
    "b2": (put("b2", lambda v: v.expand(30, 2)), DataError, r"b2 has shape \(30, 2\); expected \(30, 1\) or \(30,\)"),
    "colors rows": (put("colors", lambda v: v[:29]), DataError,
        r"colors has shape \(29, 3\); expected \(N, channels\)"),
    "colors views": (put("colors", lambda v: v.expand(2, 30, 3)), DataError,
        r"colors has shape \(2, 30, 3\); expected \(3, 30, channels\)"),
    "mixed": (put("w2", lambda v: v.double()), DataError,
        r"w2 has dtype torch\.float64; expected torch\.float32, the dtype of means"),
    "device": (put("colors", lambda v: v.to("meta")), DataError, r"colors has device meta; expected cpu"),
    "nan": (changed("b1", (13, 2), NAN), NonFiniteError, r"b1 of primitive 13 is not finite"),
    "zero quat": (changed("quats", (9,), 0.0), NonFiniteError, r"quats of primitive 9 is zero"),
    "viewmats nan": (changed("viewmats", (1, 0, 3), NAN), DataError, r"viewmats\[1\].*non-finite"),
    "viewmats scaled": (put("viewmats", lambda v: v * 2), DataError, r"viewmats\[0\].*expected a rotation"),
    "Ks skew": (changed("Ks", (1, 0, 1), 0.5), DataError, r"Ks\[1\] has skew K\[0,1\]=0\.5.*not supported"),
    "Ks last row": (changed("Ks", (0, 2, 2), 2.0), DataError,
        r"Ks\[0\] has last row \[0\.0, 0\.0, 2\.0\]; expected \[0, 0, 1\]"),
    "Ks focal": (changed("Ks", (0, 1, 1), -5.0), DataError, r"Ks\[0\] has focal lengths .*fy=-5\.0; expected positive"),
    "width": (put("width", 0), DataError, r"size has value \(0, 30\); expected two positive ints"),
    "edge": (put("edge", 3), DataError, r"edge has value 3; expected 0, 1 or 2"),
    "log_gain": (put("log_gain", torch.zeros(29)), DataError,
        r"log_gain has shape \(29,\); expected \(30, 1\) or \(30,\)"),
    "backgrounds": (put("backgrounds", torch.ones(2, 3)), DataError,
        r"backgrounds has shape \(2, 3\); expected \(3,\) or \(3, 3\)"),
    "backgrounds nan": (put("backgrounds", torch.full((3,), NAN)), NonFiniteError, r"backgrounds is not finite"),
    "setting": (put("alpha_mim", 0.1), ConfigError, r"unknown setting 'alpha_mim'; did you mean 'alpha_min'"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_named(name: str) -> None:
    change, error, message = BAD[name]
    a = {**arguments(), "omega0": 30.0, "backgrounds": None}
    change(a)
    with pytest.raises(error, match=f"^(r(asterize: .*|enderer.))?{message}"):
        rasterize(**a)


# ---------------------------------------------------------------- the package, the example


def test_importing_the_package_stays_light_and_the_name_stays_a_function() -> None:
    code = (
        "import sys, neuprim; assert 'torch' not in sys.modules; assert 'rasterize' in dir(neuprim); "
        "neuprim.rasterize; neuprim.nothing"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[1])
    assert done.returncode == 1 and "AttributeError: module 'neuprim' has no attribute 'nothing'" in done.stderr
    assert inspect.isfunction(neuprim.rasterize)

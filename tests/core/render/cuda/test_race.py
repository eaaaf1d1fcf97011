"""The race against gsplat keeps to gsplat's documented interface: a stand-in with its signatures draws by the reference
backend."""

from __future__ import annotations

import importlib
import inspect
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.colours import sh
from neuprim.core.model.densities.gaussian import GaussianDensity
from neuprim.core.model.fields import Constant
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered
from tests.core import tiny

BENCHMARKS = Path(__file__).parents[4] / "benchmarks"
STEPS = 4


def rasterization(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int,
    near_plane: float = 0.01, far_plane: float = 1e10, radius_clip: float = 0.0, eps2d: float = 0.3, sh_degree: int | None = None,
    packed: bool = True, tile_size: int = 16, backgrounds: Tensor | None = None, render_mode: str = "RGB",
) -> tuple[Tensor, Tensor, dict[str, Any]]:  # fmt: skip
    """As gsplat documents it; what it would refuse, this refuses."""
    count = len(means)
    assert means.shape == scales.shape == (count, 3) and quats.shape == (count, 4) and opacities.shape == (count,)
    assert (
        viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3) and (backgrounds is None or backgrounds.shape == (1, 3))
    )
    assert (
        sh_degree is not None
        and colors.shape[0] == count
        and colors.shape[2] == 3
        and (sh_degree + 1) ** 2 <= colors.shape[1]
    )
    assert bool((scales > 0).all()) and bool(((opacities > 0) & (opacities < 1)).all())
    assert {x.dtype for x in (means, quats, scales, opacities, colors, viewmats, Ks)} == {torch.float32}
    K = Ks[0].tolist()
    camera = Camera(viewmats[0], K[0][0], K[1][1], K[0][2], K[1][2], width, height)
    density = GaussianDensity()
    geometry = Geometry(means, scales.log() + torch.tensor(density.deviations).log(), quats)
    amplitude = -torch.log1p(-opacities)[:, None]
    rgb = sh.colors(means, colors[:, 0], colors[:, 1:], camera.position, sh_degree)
    lowered = Lowered(geometry, density.lower({"log_amplitude": amplitude.log()}, geometry, {}), Constant(rgb))
    output = render_lowered(
        lowered, camera, RenderSettings(backend="reference"), None if backgrounds is None else backgrounds[0]
    )
    return output.rgb[None], output.alpha[None, ..., None], {"width": width, "height": height}


@dataclass
class MCMCStrategy:
    """Fields and methods that gsplat documents; it moves nothing, and keeps what it was told."""

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_stop_iter: int = 25_000
    refine_every: int = 100
    min_opacity: float = 0.005
    verbose: bool = False
    told: list[tuple[int, float]] = field(default_factory=list)

    def check_sanity(self, params: dict[str, Any], optimizers: dict[str, Any]) -> None:
        assert params.keys() == optimizers.keys() >= {"means", "scales", "quats", "opacities"}
        assert all(len(adam.param_groups) == 1 for adam in optimizers.values())

    def initialize_state(self) -> dict[str, Any]:
        return {"binoms": torch.zeros(51, 51)}

    def step_post_backward(
        self, params: Any, optimizers: Any, state: dict[str, Any], step: int, info: dict[str, Any], lr: float
    ) -> None:
        assert "binoms" in state and info["width"] == tiny.SIZE and len(params["means"]) <= self.cap_max
        self.told.append((step, lr))


@pytest.fixture
def race(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/shared/race.py"""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return importlib.import_module("shared.race")


def test_gaussians_learn_what_neuprim_learns(race: ModuleType) -> None:
    made: list[MCMCStrategy] = []

    def strategy(**settings: Any) -> MCMCStrategy:
        made.append(MCMCStrategy(**settings))
        return made[0]

    gsplat = SimpleNamespace(rasterization=rasterization, MCMCStrategy=strategy)
    data = tiny.two_primitives()
    params = race.gaussians(data, 12, torch.device("cpu"))
    before, _ = race.judged(gsplat, params, data.test, data.background)
    found = race.lap(gsplat, data, 12, STEPS, torch.device("cpu"))
    assert (
        (found.count, found.bytes) == (12, 12 * 59 * 4)
        and found.psnr > before + 0.1
        and found.step_ms > 0
        and found.frame_ms > 0
    )
    assert [step for step, _ in made[0].told] == list(range(STEPS)) and made[0].cap_max == 12
    rates = [lr for _, lr in made[0].told]
    assert rates == sorted(rates, reverse=True) and rates[0] == pytest.approx(1.6e-4 * data.extent)


def test_only_documented_arguments_are_named(race: ModuleType) -> None:
    """And by name, so that no order of arguments matters."""
    called: dict[str, Any] = {}

    def seen(*args: Any, **kwargs: Any) -> Any:
        assert not args
        called.update(kwargs)
        return rasterization(**kwargs)

    data = tiny.two_primitives()
    race.judged(
        SimpleNamespace(rasterization=seen), race.gaussians(data, 5, torch.device("cpu")), data.test, data.background
    )
    assert called.keys() <= inspect.signature(rasterization).parameters.keys() and called["sh_degree"] == race.DEGREE


def test_counts_rise_until_the_quality_is_reached(race: ModuleType) -> None:
    def run(count: int) -> Any:
        return race.Lap(count, 0, 20.0 + count, 0.0, 0.0)

    laps, level = race.equal_psnr(run, [2, 4, 8, 16], 25.0)
    assert [one.count for one in laps] == [2, 4, 8] and level is laps[-1]
    laps, level = race.equal_psnr(run, [2, 4], 99.0)
    assert len(laps) == 2 and level is None


def test_without_the_package_there_is_no_race(
    race: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    assert race.opened() is None
    script = importlib.import_module("gpu")
    assert script.race({}, []) is None and "pip install gsplat" in capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "gsplat", ModuleType("gsplat"))
    with pytest.raises(SystemExit, match="nothing was trained on chair"):
        script.race({}, [])

"""Which device draws: what the setting says, what is there, and where the tensors are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import neuprim
from neuprim.config import compose
from neuprim.core.compute import device
from neuprim.core.compute.device import HOST
from neuprim.core.errors import BackendUnavailable, ConfigError, DataError
from neuprim.core.model.fields import CustomDensity
from neuprim.core.render import RenderSettings, backends, render_lowered
from neuprim.core.render.backends import best_render_backend_device, choose_backend
from neuprim.runs.fit import prepare_training
from tests import scenes
from tests.core import tiny
from tests.pretend_card import CARD, Card, pretended
from tests.short_runs import words

MISSING = "torch finds no CUDA device"


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Iterator[Card]:
    with pretended(monkeypatch) as made:
        yield made


def setting(kind: str, **more: Any) -> RenderSettings:
    """As on a machine with a GPU: there, what the setting calls cuda is the pretended one."""
    settings = RenderSettings(**more)
    object.__setattr__(settings, "device", kind)
    return settings


def frame(seed: int = 0) -> Any:
    return scenes.lowered(scenes.tensors(5, seed=seed)), scenes.camera(12, 10)


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("renderer.device=cuda", rf"^renderer\.device=cuda: {MISSING}; expected cpu or auto$"),
        (
            "renderer.backend=cuda",
            rf"^renderer\.backend=cuda cannot run here: {MISSING}; expected auto or the name of another backend$",
        ),
    ],
)
def test_a_missing_gpu_is_refused_in_one_line_before_anything_is_loaded(
    override: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "cuda_unavailable", lambda: MISSING)
    monkeypatch.setattr("neuprim.runs.fit.load_dataset", lambda *_, **__: pytest.fail("loaded"))
    with pytest.raises(BackendUnavailable, match=line):
        prepare_training(compose(words(tmp_path, tmp_path / "run", 3, override)))
    key, value = override.removeprefix("renderer.").split("=")
    with pytest.raises(BackendUnavailable, match=line):
        render_lowered(*frame(), RenderSettings(**{key: value}))


def test_without_a_gpu_everything_is_computed_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "cuda_unavailable", lambda: MISSING)
    assert tiny.trainer(tiny.two_primitives(), 1).device == HOST
    assert backends.with_available_render_backend(RenderSettings(device="cuda", near=0.5)) == RenderSettings(near=0.5)


def test_a_backend_and_a_device_that_do_not_go_together_are_refused(tmp_path: Path) -> None:
    line = (
        r"^renderer\.device=cuda: renderer\.backend=reference cannot use this device; expected renderer\.device=cpu or "
    )
    line += "auto$"
    with pytest.raises(ConfigError, match=line):
        compose(words(tmp_path, tmp_path / "run", 3, "renderer.device=cuda", "renderer.backend=reference"))


@pytest.mark.parametrize(
    ("own", "kind", "name"),
    [("cpu", CARD.type, "card"), (CARD.type, "cpu", "cpu"), ("cpu", "auto", "cpu"), (CARD.type, "auto", "card")],
)
def test_tensors_go_where_the_setting_says_and_the_frame_comes_back(own: str, kind: str, name: str, card: Card) -> None:
    """Gradients go the same way, and so do contributions."""
    low, camera = frame()
    wanted = render_lowered(low, camera, RenderSettings())
    low = low.to(torch.device(own))
    low.geometry.means.requires_grad_()
    assert choose_backend(low, setting(kind), camera).name == name
    output = render_lowered(low, camera, setting(kind))
    found = output.request_contributions(torch.ones_like(output.alpha))
    output.rgb.sum().backward()
    grad = low.geometry.means.grad
    assert grad is not None and output.rgb.device.type == grad.device.type == found.weight.device.type == own
    assert bool((found.weight > 0).any()) and torch.allclose(found.weight, found.error_weight)
    assert torch.equal(output.alpha.detach().cpu(), wanted.alpha)


def test_code_of_a_model_stays_where_it_is(card: Card) -> None:
    """What only the reference draws is not moved to it; a run keeps such a model on the CPU in the first place."""
    low, camera = frame()
    own = replace(low, density=CustomDensity(lambda prim, o, d, t0, t1: t1 - t0))
    assert render_lowered(own, camera, RenderSettings()).stats.backend == "reference"
    away = replace(low.to(CARD), density=own.density)
    with pytest.raises(BackendUnavailable, match="cannot draw the model's own code, which runs on the meta; it draws"):
        render_lowered(away, camera, RenderSettings())


def test_a_run_keeps_a_model_where_it_is_drawn(card: Card, monkeypatch: pytest.MonkeyPatch) -> None:
    model, camera = tiny.trainer(tiny.two_primitives(), 1).model.to(HOST), scenes.camera(12, 10)
    for settings, wanted in (
        (RenderSettings(), CARD),
        (setting("cpu"), HOST),
        (RenderSettings(backend="cpu"), HOST),
        (RenderSettings(backend="card"), CARD),
        (setting(CARD.type), CARD),
    ):
        assert best_render_backend_device(model, settings, camera, {}) == wanted, settings
    row = replace(backends.TABLE[0], unsupported=lambda low, camera: "this model")
    with monkeypatch.context() as patch:  # undone before the pretended card is
        patch.setattr(backends, "TABLE", (row, *backends.TABLE[1:]))
        assert best_render_backend_device(model, RenderSettings(), camera, {}) == HOST


def test_rasterize_takes_tensors_of_a_gpu(card: Card) -> None:
    t = scenes.tensors(4)
    camera = scenes.camera(8, 6)
    K = torch.tensor([[[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]], dtype=torch.float64)
    wanted = neuprim.rasterize(t, camera.viewmat[None], K, (8, 6))
    away = {name: value.to(CARD).requires_grad_() for name, value in t.items()}
    found = neuprim.rasterize(away, camera.viewmat[None].to(CARD), K.to(CARD), (8, 6))
    assert found.rgb.device == CARD and torch.equal(found.rgb.detach().cpu(), wanted.rgb)
    found.rgb.sum().backward()
    assert away["means"].grad is not None and away["means"].grad.device == CARD
    with pytest.raises(DataError, match=r"^rasterize: W1 has device cpu; expected meta, the device of means$"):
        neuprim.rasterize({**away, "W1": t["W1"]}, camera.viewmat[None], K, (8, 6))

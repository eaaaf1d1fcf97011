"""What a page looks at: a run with its data, without them, with a damaged header, and with its model on a card."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.channels import Channels
from neuprim.core.checkpoint import save_model
from neuprim.core.errors import DataError
from neuprim.core.io.images import to_uint8
from neuprim.core.metrics import psnr
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.render import RenderSettings
from neuprim.runs.measure import draw
from neuprim.runs.open import load_run
from neuprim.runs.render_config import RenderConfig, parse_render_config
from neuprim.tasks.static import TASK as STATIC
from neuprim.tasks.static.fields import SphericalHarmonics
from neuprim.viewer.frame import DEPTH, Look
from neuprim.viewer.primitives import ellipsoids_of, strongest
from neuprim.viewer.subject import Subject
from neuprim.viewer.view import open_subject
from tests.core import tiny
from tests.page_models import camera_at, random_model
from tests.pretend_card import CARD, pretended
from tests.short_runs import fit, words


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("subject")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
        return fit(words(tiny.write_blender(folder / "two"), folder / "run", 60))


def test_a_run_with_its_data(run_dir: Path) -> None:
    subject = open_subject(run_dir)
    names = subject.view_names()
    assert subject.dataset is not None and len(names) == len(subject.dataset.test) and subject.start().name in names
    assert np.allclose(subject.center, subject.dataset.center) and subject.up == tuple(subject.dataset.up.tolist())
    found = subject.compare(names[1])
    view, background = subject.view(names[1]), subject.dataset.background
    truth = subject.dataset.test.pixels(1).over(background)
    drawn = draw(subject.model(), view, subject.settings, background)
    assert found.psnr == psnr(drawn, truth) > 10
    assert np.array_equal(found.truth, to_uint8(truth).numpy()) and np.array_equal(found.drawn, to_uint8(drawn).numpy())
    few = parse_render_config(["density.neurons=1"], subject.settings, subject.model())
    look = Look(view.camera, view.conditions)
    assert not np.array_equal(subject.draw(look, few).image, subject.draw(look, RenderConfig(subject.settings)).image)


def test_a_run_whose_data_are_gone_is_shown_without_held_out_views(run_dir: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run_dir, copy)
    config = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(config.replace(str(run_dir.parent / "two"), str(tmp_path / "gone")))
    told: list[str] = []
    subject = open_subject(copy, told.append)
    assert (
        subject.dataset is None and subject.view_names() == [] and len(told) == 1 and "no held-out views: " in told[0]
    )
    start = subject.start()
    image = subject.draw(Look(start.camera.resized(96, 54), start.conditions), RenderConfig(subject.settings)).image
    assert image.std() > 10, "the model is in the picture"
    middle = image[18:36, 32:64].astype(float)
    assert np.abs(middle - image[0, 0]).mean() > np.abs(image.astype(float) - image[0, 0]).mean(), "and in its middle"


def test_a_damaged_header_is_named(run_dir: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run_dir, copy)
    _, _, model, header = load_run(copy)
    more = {k: v for k, v in header.items() if k in ("background", "color_space", "channels", "data_source")}
    save_model(copy / "model.safetensors", model, "static", {**more, "data": {"up": [0, "x", 1], "center": [0, 0, 0]}})
    with pytest.raises(DataError, match=r"the model's header: data: up\[1\] is .*expected a finite number"):
        open_subject(copy)


def test_a_model_on_a_card_is_drawn_and_asked_like_any(monkeypatch: pytest.MonkeyPatch) -> None:
    model = random_model(CosineDensity(2, edge=2), SphericalHarmonics(1), count=40)
    settings, look = RenderSettings(), Look(camera_at((0.3, -3.0, 1.0)), {}, DEPTH)
    direction = look.camera.viewmat[2, :3].numpy()

    def asked() -> tuple[np.ndarray, np.ndarray, int | None]:
        channels = Channels(("R", "G", "B"), "srgb", None, "static")
        subject = Subject(
            "it", STATIC, lambda: model, channels, settings, torch.ones(3), (0.0, 0.0, 1.0), Subject.middle_of(model)
        )
        start = subject.start()
        assert start.camera.viewmat.isfinite().all()
        picture = subject.draw(look, RenderConfig(settings)).image
        return picture, ellipsoids_of(model, look, channels, 5).rows, strongest(model, look, direction, settings)

    expected = asked()
    with pretended(monkeypatch):
        model = model.to(CARD)
        assert model.device == CARD
        found = asked()
    assert (
        np.array_equal(found[0], expected[0])
        and np.array_equal(found[1], expected[1])
        and found[2] == expected[2] is not None
    )

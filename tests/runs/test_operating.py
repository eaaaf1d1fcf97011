"""Operating points: words to settings and back, and what they do to a model and its images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neuprim.cli import main
from neuprim.cli.operating_words import _HEADS, operating_words
from neuprim.core.checkpoint import save_model
from neuprim.core.errors import ConfigError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.runs import storage
from neuprim.runs.draw import render_run
from neuprim.runs.measure import draw, evaluate_run
from neuprim.runs.open import load_dataset, load_run
from neuprim.runs.operating import HEADS, OperatingPoint, read_point
from neuprim.runs.storage import stored_bytes
from tests.search.tradeoff_runs import tiny_run


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_run(tmp_path_factory.mktemp("operating"))


@pytest.fixture(scope="module")
def model(run_dir: Path) -> Primitives:
    return load_run(run_dir)[2]


POINTS = st.builds(
    OperatingPoint,
    st.builds(
        RenderSettings,
        backend=st.sampled_from(("auto", "cpu", "reference")),
        sort=st.sampled_from(("center", "entry")),
        samples=st.integers(1, 4),
        alpha_max=st.floats(1e-6, 0.9999),
        alpha_min=st.floats(0, 0.99),
        transmittance_min=st.floats(0, 0.99),
        near=st.floats(1e-6, 10),
        depth=st.booleans(),
        threads=st.integers(0, 3),
    ),
    st.floats(1e-3, 1.0),
    st.dictionaries(st.just(("colour", "degree")), st.integers(0, 2)).flatmap(
        lambda found: st.dictionaries(st.just(("density", "neurons")), st.sampled_from((3, 2, 1, 0))).map(
            lambda more: {**found, **more}
        )
    ),
    st.dictionaries(st.sampled_from(storage.GROUPS), st.sampled_from(["float16", "uint8"])),
)


@given(POINTS)
def test_words_say_all_of_a_point(model: Primitives, point: OperatingPoint) -> None:
    usual = RenderSettings(alpha_min=0.01)
    words = point.words(usual)
    assert read_point(words, usual, model) == point
    assert operating_words(words) == (list(words), [])


def test_no_words_are_the_run(model: Primitives) -> None:
    usual = RenderSettings(samples=2)
    assert read_point([], usual, model) == OperatingPoint(usual) and OperatingPoint(usual).words(usual) == ()
    assert OperatingPoint(usual).applied(model) is model
    everything = OperatingPoint(usual, stored=dict.fromkeys(storage.GROUPS, "float16"))
    assert everything.words(usual) == ("store.all=float16",)


@pytest.mark.parametrize(
    ("word", "text"),
    [
        (
            "rendere.alpha_min=0",
            "rendere.alpha_min: nothing that a finished run is drawn by; did you mean 'renderer.alpha_min'",
        ),
        ("renderer.alpha_mi=0", "renderer.alpha_mi: no such setting; did you mean 'renderer.alpha_min'"),
        ("renderer.alpha_min=2", "renderer.alpha_min=2: expected a number"),
        ("renderer.backend=cup", "renderer.backend=cup: expected auto"),
        ("resolution=0", "resolution=0: expected a factor above 0, at most 1"),
        ("resolution=1.5", "resolution=1.5: expected a factor above 0, at most 1"),
        (
            "colour.degre=1",
            "colour.degre: nothing that SphericalHarmonics can do with less of; did you mean 'colour.degree'",
        ),
        ("colour.degree=3", "colour.degree=3: expected 2 or 1 or 0, less than the model has"),
        ("colour.degree=true", "colour.degree=True: expected 2 or 1 or 0"),
        ("density.neurons=5", "density.neurons=5: expected 3 or 2 or 1 or 0"),
        ("store.mean=float16", "store.mean: no such group of parameters; did you mean 'means'"),
        ("store.means=float61", "store.means=float61: no such format; did you mean 'float16'"),
    ],
)
def test_wrong_words_are_one_line(
    word: str, text: str, model: Primitives, run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ConfigError) as refused:
        read_point([word], RenderSettings(), model)
    assert str(refused.value).startswith(text) and "\n" not in str(refused.value)
    if operating_words([word])[0]:
        assert main(["eval", str(run_dir), word]) == 2
        out, err = capsys.readouterr()
        assert out == "" and err == f"neuprim: error: {' '.join(str(refused.value).split())}\n"


def test_the_command_line_knows_what_points_begin_with() -> None:
    assert set(_HEADS) == set(HEADS)
    assert operating_words(["--time", "0.5", "--", "renderer.sort=entry", "x=1", "resolution=0.5"]) == (
        ["renderer.sort=entry", "resolution=0.5"],
        ["--time", "0.5", "x=1"],
    )


def test_a_format_changes_its_group_alone(model: Primitives) -> None:
    point = read_point(["store.colour=float16"], RenderSettings(), model)
    stored = point.applied(model)
    for name, value in model.params.items():
        expected = value.half().float() if name in ("sh_dc", "sh_rest") else value
        assert torch.equal(stored.params[name], expected)
    saved = 2 * sum(model.params[name].numel() for name in ("sh_dc", "sh_rest"))
    assert stored_bytes(stored, point.stored) == stored_bytes(model, {}) - saved


def test_bytes_are_those_of_a_file_that_holds_it_so(model: Primitives, run_dir: Path, tmp_path: Path) -> None:
    """Of 32-bit floats to the byte but for the header, whose text is shorter; a row of another format counts by its own
    rule."""
    smaller = read_point(["colour.degree=1", "density.neurons=2"], RenderSettings(), model)
    reduced = smaller.applied(model)
    save_model(tmp_path / "m.safetensors", reduced, "static", {})
    save_model(tmp_path / "whole.safetensors", model, "static", {})
    difference = (tmp_path / "whole.safetensors").stat().st_size - (tmp_path / "m.safetensors").stat().st_size
    assert abs(difference - (stored_bytes(model, {}) - stored_bytes(reduced, smaller.stored))) <= 16
    path = run_dir / "model.safetensors"
    assert evaluate_run(run_dir)["model_bytes"] == path.stat().st_size
    less = evaluate_run(run_dir, words=["colour.degree=1", "density.neurons=2"])
    assert less["model_bytes"] == path.stat().st_size - stored_bytes(model, {}) + stored_bytes(reduced, smaller.stored)
    assert less["parameters"] == reduced.count * reduced.parameters_per_primitive


def test_eight_bits_are_even_steps_between_the_ends_of_each_column(model: Primitives) -> None:
    point = read_point(["store.colour=uint8"], RenderSettings(), model)
    before, after = (m.params["sh_dc"] for m in (model, point.applied(model)))
    steps = (before.amax(0) - before.amin(0)) / 255
    assert 0 < float(((after - before).abs() / steps).max()) <= 3.1  # ends may leave out a few numbers
    assert len(after[:, 0].unique()) <= 256
    numbers = sum(model.params[name].numel() for name in ("sh_dc", "sh_rest"))
    columns = sum(model.params[name][0].numel() for name in ("sh_dc", "sh_rest"))
    assert stored_bytes(model, point.stored) == stored_bytes(model, {}) - 3 * numbers + 8 * columns


def test_another_row_is_another_format(model: Primitives, monkeypatch: pytest.MonkeyPatch) -> None:
    halves = storage.Format("whole numbers", torch.round, lambda value: value.numel())
    monkeypatch.setattr(storage, "FORMATS", {**storage.FORMATS, "whole": halves})
    monkeypatch.setattr("neuprim.runs.operating.FORMATS", storage.FORMATS)
    point = read_point(["store.means=whole"], RenderSettings(), model)
    assert torch.equal(point.applied(model).params["means"], model.params["means"].round())
    assert stored_bytes(model, point.stored) == stored_bytes(model, {}) - 3 * model.params["means"].numel()


def test_what_a_format_does_not_hold_is_refused(model: Primitives) -> None:
    huge = Primitives(model.density, model.colour, {**model.params, "means": model.params["means"] + 1e6})
    with pytest.raises(ConfigError, match=r"store\.means=float16: means has values that float16 does not hold"):
        read_point(["store.means=float16"], RenderSettings(), model).applied(huge)


def test_resolution_is_drawn_small_and_enlarged(model: Primitives, run_dir: Path) -> None:
    config, task, _, _ = load_run(run_dir)
    dataset = load_dataset(config, task)
    view = dataset.test.view(0)
    half = OperatingPoint(config.renderer, 0.5)
    small = draw(model, replace(view, camera=view.camera.resized(12, 12)), config.renderer, dataset.background)
    image = half.draw(model, view, dataset.background)
    assert image.shape == (24, 24, 3)
    expected = torch.nn.functional.interpolate(small.permute(2, 0, 1)[None], (24, 24), mode="bilinear")[0].permute(
        1, 2, 0
    )
    assert torch.equal(image, expected)
    assert torch.equal(
        OperatingPoint(config.renderer).draw(model, view, dataset.background),
        draw(model, view, config.renderer, dataset.background),
    )


def test_render_and_eval_draw_the_point(run_dir: Path, model: Primitives, tmp_path: Path) -> None:
    """The same image to the bit from the command line's words as from the point itself, and another than without."""
    config, task, _, _ = load_run(run_dir)
    dataset = load_dataset(config, task)
    words = ["renderer.alpha_min=0.25", "resolution=0.5", "colour.degree=0", "store.all=float16"]
    point = read_point(words, config.renderer, model)
    image = point.draw(point.applied(model), dataset.test.view(1), dataset.background)
    out = tmp_path / "views"
    assert main(["render", str(run_dir), "--camera", "test", "--format", "npy", "--out", str(out), *words]) == 0
    drawn = [np.load(path) for path in sorted(out.iterdir())]
    assert np.array_equal(drawn[1], image.numpy())
    plain = [np.load(path) for path in render_run(run_dir, "test", None, "npy", tmp_path / "plain", 1, {})]
    assert not np.array_equal(plain[1], drawn[1])
    again, other = evaluate_run(run_dir), evaluate_run(run_dir, words=words)
    assert other["psnr"] != again["psnr"] and evaluate_run(run_dir, words=words)["psnr"] == other["psnr"]

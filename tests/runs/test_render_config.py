"""Render configurations: overrides to settings and back, and their effect on a model and its images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neuprim.cli import main
from neuprim.core.checkpoint import save_model
from neuprim.core.errors import ConfigError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.runs.measure import evaluate_run, render_image
from neuprim.runs.open import load_dataset, load_run
from neuprim.runs.render_config import (
    RenderConfig,
    estimate_run_file_bytes,
    parse_run_rendering,
)
from tests.search.tradeoff_runs import tiny_run


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_run(tmp_path_factory.mktemp("render_config"))


@pytest.fixture(scope="module")
def model(run_dir: Path) -> Primitives:
    return load_run(run_dir).model


CONFIGS = st.builds(
    RenderConfig,
    st.builds(
        RenderSettings,
        backend=st.sampled_from(("auto", "cpu", "reference")),
        sort=st.sampled_from(("center", "entry")),
        samples=st.integers(1, 4),
        alpha_max=st.floats(1e-6, 0.9999),
        alpha_min=st.floats(0, 0.99),
        near=st.floats(1e-6, 10),
        depth=st.booleans(),
    ),
    st.floats(1e-3, 1.0),
    st.fixed_dictionaries(
        {}, optional={("colour", "degree"): st.integers(0, 2), ("density", "neurons"): st.integers(0, 3)}
    ),
)


@given(CONFIGS)
def test_overrides_round_trip(model: Primitives, config: RenderConfig) -> None:
    defaults = RenderSettings()
    words = config.to_overrides(defaults)
    assert parse_run_rendering(words, defaults, model) == config


@pytest.mark.parametrize(
    ("word", "key"),
    [
        ("renderer.alpha_mi=0.1", "renderer.alpha_mi"),
        ("renderer.backend=gpu", "renderer.backend"),
        ("resolution=0", "resolution"),
        ("resolution=1.5", "resolution"),
        ("colour.degre=1", "did you mean 'colour.degree'"),
        ("colour.degree=3", "colour.degree=3: expected a reduced value: 2 or 1 or 0"),
        ("density.neurons=5", "density.neurons=5"),
        ("resolution.x=1", "resolution.x"),
    ],
)
def test_invalid_overrides_are_refused_in_one_line(word: str, key: str, model: Primitives) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_run_rendering([word], RenderSettings(), model)
    assert key in str(refused.value) and "\n" not in str(refused.value)


def test_file_bytes_follow_the_tensors(model: Primitives, tmp_path: Path) -> None:
    config = parse_run_rendering(["colour.degree=1", "density.neurons=2"], RenderSettings(), model)
    reduced = config.prepare_model(model)
    save_model(tmp_path / "reduced.safetensors", reduced, "static", {})
    save_model(tmp_path / "full.safetensors", model, "static", {})
    estimated = estimate_run_file_bytes(tmp_path / "full.safetensors", model, reduced)
    assert abs(estimated - (tmp_path / "reduced.safetensors").stat().st_size) <= 16  # the headers differ


def test_reductions_of_a_file_without_zeros_count_as_tensors(model: Primitives, tmp_path: Path) -> None:
    """The saved bytes of zeros must not be subtracted a second time."""
    sparse = Primitives(model.density, model.colour, {**model.params, "sh_rest": 0 * model.params["sh_rest"]})
    path = tmp_path / "sparse.safetensors"
    save_model(path, sparse, "static", {}, without_zeros=True)
    assert estimate_run_file_bytes(path, sparse, sparse) == path.stat().st_size
    reduced = RenderConfig(reduced={("colour", "degree"): 1}).prepare_model(sparse)
    tensors = 4 * reduced.count * reduced.parameters_per_primitive
    assert estimate_run_file_bytes(path, sparse, reduced) == tensors


def test_render_and_eval_apply_the_overrides(run_dir: Path, model: Primitives, tmp_path: Path) -> None:
    """Images from the command line equal those of the configuration, to the bit."""
    stored = load_run(run_dir)
    run_config = stored.config
    dataset = load_dataset(stored)
    view = dataset.test.view(1)
    words = ["renderer.alpha_min=0.25", "resolution=0.5", "colour.degree=0"]
    config = parse_run_rendering(words, run_config.renderer, model)
    image = config.render_view(config.prepare_model(model), view, dataset.background)
    out = tmp_path / "views"
    assert main(["render", str(run_dir), "--camera", "test", "--format", "npy", "--out", str(out), *words]) == 0
    assert np.array_equal(np.load(sorted(out.iterdir())[1]), image.numpy())
    small = replace(view, camera=view.camera.resized(12, 12))
    half = RenderConfig(run_config.renderer, 0.5).render_view(model, view, dataset.background)
    plain = render_image(model, small, run_config.renderer, dataset.background).permute(2, 0, 1)[None]
    expected = torch.nn.functional.interpolate(plain, (24, 24), mode="bilinear")[0].permute(1, 2, 0)
    assert torch.equal(half, expected)
    assert evaluate_run(run_dir, overrides=words)["psnr"] != evaluate_run(run_dir)["psnr"]

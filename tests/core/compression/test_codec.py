"""A model in few bits and back: every built-in field, errors as the steps allow, the same bytes and the same floats
every time."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

import neuprim.core.compression.codec as codec
from neuprim.core import checkpoint
from neuprim.core.compression.codec import canonical_model, fake_quantize, fit_quantizers, fit_quantizers_to_error
from neuprim.core.compression.file import read_compressed
from neuprim.core.compression.quantizers import LEVELS, ColumnQuantizer, bit_table
from neuprim.core.errors import CheckpointError, ConfigError
from neuprim.core.model.fields import prunable_units_of_model
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from tests import scenes
from tests.compressing import FIELDS, example, gaussians, stored, without_pieces


def angles(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    cosine = (a.double() * b.double()).sum(1).abs() / a.double().norm(dim=1) / b.double().norm(dim=1)
    return 2 * cosine.clamp_max(1).acos()


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", FIELDS)
def test_a_model_comes_back_within_its_steps(tmp_path: Path, name: str, level: int) -> None:
    task, model = example(name)
    path = tmp_path / "m.neuprim"
    checkpoint.save_compressed(path, model, task.name, {"background": [0.5], "note": "naïve"}, LEVELS[level], "a: ä\n")
    assert checkpoint.checkpoint_config(path) == "a: ä\n"
    again, header = checkpoint.load_model_checkpoint(path, task)
    assert header["note"] == "naïve" and header["primitives"] == model.count and header["background"] == [0.5]
    assert type(again.density) is type(model.density) and again.colour.settings() == model.colour.settings()
    wanted, made = stored(model, LEVELS[level])
    for key, value in wanted.params.items():
        back, scheme = again.params[key].reshape(model.count, value[0].numel()), made[key]
        if not isinstance(scheme, ColumnQuantizer):
            assert float(angles(value, back).max()) < 4.0 / scheme.half
            continue
        x = value.reshape(back.shape)
        inside = x.clamp(scheme.low, scheme.high)
        half = (scheme.high - scheme.low).double() / scheme.last / 2
        assert bool(((back - inside).double().abs() <= half * 1.001 + 1e-6).all()), key
        outside = float((x != inside).double().mean()) if x.numel() else 0.0
        assert outside <= 0.06, key  # at most 1% at either end, of 40 rows


@pytest.mark.parametrize("name", FIELDS)
def test_a_bit_says_who_does_without_a_piece(tmp_path: Path, name: str) -> None:
    """The same numbers come back as from a file of whole columns, which takes more bytes; compressed again it is the
    same file."""
    task, model = example(name, 2000)
    pruned = without_pieces(model)
    files = []
    for path in (tmp_path / "0", tmp_path / "1"):
        checkpoint.save_compressed(path, pruned, task.name, {}, LEVELS[3])
        pruned, _ = checkpoint.load_model_checkpoint(path, task)
        files.append(path.read_bytes())
    assert files[0] == files[1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "_MIN_MASKED", 2.0)
        checkpoint.save_compressed(tmp_path / "2", pruned, task.name, {}, LEVELS[3])
    plain, _ = checkpoint.load_model_checkpoint(tmp_path / "2", task)
    assert all(torch.equal(value, plain.params[key]) for key, value in pruned.params.items())
    if prunable_units_of_model(model.density, model.colour):
        assert len(files[0]) < 0.95 * (tmp_path / "2").stat().st_size


def test_neither_the_order_of_rows_nor_their_place_matters(tmp_path: Path) -> None:
    """The same primitives in another order make the same file, and the file's order draws the same image."""
    task, model = example("static", 200)
    rows = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    other = Primitives(model.density, model.colour, model.rows(rows))
    for i, m in enumerate((model, other)):
        checkpoint.save_compressed(tmp_path / f"{i}", m, task.name, {}, LEVELS[2])
    assert (tmp_path / "0").read_bytes() == (tmp_path / "1").read_bytes()
    wanted, _ = stored(model, LEVELS[2])
    for backend in ("reference", "cpu"):
        settings = RenderSettings(backend=backend)
        with torch.no_grad():
            a, b = (render(m, scenes.camera(), {}, settings).rgb for m in (canonical_model(model), wanted))
        assert torch.allclose(a, b, atol=1e-5)


# ---------------------------------------------------------------- bits


def test_a_column_with_a_few_far_numbers_gets_twice_the_bits() -> None:
    model = gaussians(4000)
    model.params["log_amplitude"] = torch.randn(4000, 1, generator=torch.Generator().manual_seed(0))
    assert fit_quantizers(model, LEVELS[3])["log_amplitude"].bits.tolist() == [7]
    model.params["log_amplitude"][::1000] = 200.0
    assert fit_quantizers(model, LEVELS[3])["log_amplitude"].bits.tolist() == [14]
    exact = bit_table(3, ["log_amplitude=7"], model.specs)
    assert fit_quantizers(model, exact)["log_amplitude"].bits.tolist() == [7]


def test_positions_get_the_bits_that_the_primitives_sizes_ask_for() -> None:
    model = gaussians(400)
    model.params["log_scales"] = torch.full((400, 3), -3.0)
    assert fit_quantizers(model, LEVELS[5])["means"].bits.tolist() == [11] * 3
    model.params["means"][0] = 500.0
    made = fit_quantizers(model, LEVELS[5])["means"]
    steps = float((made.high - made.low)[0] / made.last[0])
    assert np.exp(-3.0) / 100 < steps <= np.exp(-3.0) / 50
    assert fit_quantizers(model, bit_table(5, ["means=9"], model.specs))["means"].bits.tolist() == [9] * 3


@pytest.mark.parametrize(
    ("level", "word", "message"),
    [
        (6, "", "--level 6: expected one of 1, 2, 3, 4, 5"),
        (3, "means", "bits.means: expected bits.NAME=BITS"),
        (3, "mean=16", "no parameter 'mean'; did you mean 'means'"),
        (3, "means=21", "bits.means=21: expected 1 to 20"),
        (3, "W1=0", "expected 1 to 16"),
        (3, "others=8,7", "expected 1 to 16"),
    ],
)
def test_words_that_mean_nothing(level: int, word: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        bit_table(level, [word] if word else [], example("static")[1].specs)
    assert message in str(caught.value) and "\n" not in str(caught.value)


# ---------------------------------------------------------------- what training may use


@pytest.mark.parametrize("name", ["static", "dynamic", "additive"])
def test_rounded_tensors_are_what_comes_back_with_their_own_gradients(tmp_path: Path, name: str) -> None:
    task, model = example(name)
    checkpoint.save_compressed(tmp_path / "m", model, task.name, {}, LEVELS[4])
    again, _ = checkpoint.load_model_checkpoint(tmp_path / "m", task)
    wanted, made = stored(model, LEVELS[4])
    leaves = {key: value.clone().requires_grad_() for key, value in wanted.params.items()}
    found = fake_quantize(leaves, made)
    for key, value in found.items():
        if key == "quats":
            assert float(angles(value.detach(), again.params[key]).max()) < 1e-3
        else:
            assert torch.equal(value.detach(), again.params[key]), key
    total = torch.stack([(value * (i + 1)).sum() for i, value in enumerate(found.values())]).sum()
    grads = torch.autograd.grad(total, list(leaves.values()), allow_unused=True)
    for i, (grad, leaf) in enumerate(zip(grads, leaves.values(), strict=True)):
        assert grad is not None and torch.equal(grad, torch.full_like(leaf, i + 1.0))


# ---------------------------------------------------------------- as coarse as images allow


def effects_of(model: Primitives) -> dict[str, torch.Tensor]:
    """Some effect of every number, of very different sizes."""
    draw = partial(torch.rand, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return {s.name: 10 ** (2 * draw(s.size)) * model.count for s in model.specs}


@pytest.mark.parametrize("name", FIELDS)
def test_every_column_brings_the_error_that_it_may(tmp_path: Path, name: str) -> None:
    task, model = example(name, 2000)
    whole, error = canonical_model(model), 1e-4
    effects = effects_of(whole)
    made = fit_quantizers_to_error(whole, effects, error)
    back = fake_quantize(whole.params, made)
    for spec in whole.specs:
        if spec.fixed or not spec.size:
            continue
        x, y = (values[spec.name].reshape(2000, spec.size).double() for values in (whole.params, back))
        brought = effects[spec.name] * (x - y).square().mean(0)
        if spec.name == "quats":  # across, whatever the norm; whole bits are up to 1.4 times too long or too short
            off = (angles(x, y) / 2).square().mean() * effects["quats"].sum() / 3
            assert 0.4 * 3 * error < float(off) < 2.2 * 3 * error
        elif spec.name == "b2" and name == "volume":
            assert float(brought) < 1e-12  # -1 and 1 are what they are
        else:
            varied = effects[spec.name] * x.var(0) > 2 * error  # else a single value says it
            assert bool((brought < 1.25 * error).all()) and bool((brought > 0.7 * error)[varied].all()), spec.name
    path = tmp_path / "m"
    checkpoint.save_compressed(path, whole, task.name, {}, made)
    again = checkpoint.load_model_checkpoint(path, task)[0]
    rows = codec.storage_order(whole, made)
    for key in (k for k in back if k != "quats"):
        assert torch.equal(again.params[key], back[key][rows]), key


def test_what_images_do_not_show_keeps_eight_bits_and_what_is_gone_stays_gone() -> None:
    model = canonical_model(without_pieces(example("soft", 400)[1]))
    effects = effects_of(model)
    effects["log_gain"] *= 0
    back = fake_quantize(model.params, fit_quantizers_to_error(model, effects, 1e-3))
    own = model.params["log_gain"]
    assert float((back["log_gain"] - own).abs().max()) < float(own.max() - own.min()) / 250
    same = Primitives(model.density, model.colour, {**model.params, "log_gain": torch.full_like(own, 0.7)})
    made = fit_quantizers_to_error(same, effects, 1e-3)["log_gain"]
    assert isinstance(made, ColumnQuantizer) and made.bits.tolist() == [1]
    for name in ("sh_rest", "w2"):
        gone = model.params[name] == 0
        assert bool(gone.any()) and bool((back[name][gone] == 0).all())
    for unknown in (torch.nan, torch.inf):
        without = {name: torch.full_like(value, unknown) for name, value in effects.items()}
        fine = fit_quantizers_to_error(model, without, 1e-3)
        for name, value in fake_quantize(model.params, fine).items():
            near = angles(value, model.params[name]) if name == "quats" else value - model.params[name]
            assert float(near.abs().max()) < 1e-3 if name == "quats" else 1e-5, name
    none = Primitives(model.density, model.colour, {name: value[:0] for name, value in model.params.items()})
    assert fake_quantize(none.params, fit_quantizers_to_error(none, effects, 1e-3))["means"].shape == (0, 3)


# ---------------------------------------------------------------- what cannot be stored


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"b1": torch.full((40, 3), torch.nan)}, "parameter b1 of primitive 0 is [nan, nan, nan], which cannot be"),
        ({"b2": 1 / (torch.arange(40.0)[:, None] < 39)}, "parameter b2 of primitive 39 is [inf]"),
        ({"quats": torch.zeros(40, 4)}, "parameter quats of primitive 0 is [0.0, 0.0, 0.0, 0.0]"),
        ({"b2": torch.zeros(40, 1, dtype=torch.int64)}, "parameter b2 is torch.int64; only torch.float32"),
        ({"b2": torch.zeros(40, 1, dtype=torch.float64)}, "parameter b2 is torch.float64; only torch.float32"),
    ],
)
def test_numbers_that_cannot_be_stored(tmp_path: Path, params: dict[str, torch.Tensor], message: str) -> None:
    model = example("static")[1]
    model.params |= params
    with pytest.raises(CheckpointError) as caught:
        checkpoint.save_compressed(tmp_path / "m", model, "static", {}, LEVELS[3])
    assert message in str(caught.value) and not (tmp_path / "m").exists()


def test_a_model_of_nothing_but_zeros_is_no_bomb(tmp_path: Path) -> None:
    """What compresses without end is stored as it is, so that what strangers send need not be believed."""
    task, model = example("static", 40_000)
    params = {name: torch.zeros_like(value) for name, value in model.params.items()}
    params["quats"][:, 0] = 1.0
    path, zeros = tmp_path / "m", Primitives(model.density, model.colour, params)
    checkpoint.save_compressed(path, zeros, task.name, {}, LEVELS[3], "task: static\n")
    numbers = 4 * 40_000 * model.parameters_per_primitive
    assert numbers > 2**20 and path.stat().st_size * 64 + 2**20 >= numbers > 10 * path.stat().st_size
    assert all(torch.equal(value, params[name]) for name, value in read_compressed(path)[1].items())

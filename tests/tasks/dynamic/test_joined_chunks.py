"""Models joined from chunks of a sequence: what counts when, exactly; and what is done with such a model."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from neuprim.core import checkpoint
from neuprim.core.compression.codec import canonical_model, fake_quantize, fit_quantizers
from neuprim.core.compression.quantizers import LEVELS
from neuprim.core.errors import ConfigError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.volumes.points import volume_values_at
from neuprim.tasks.dynamic import TASK
from neuprim.tasks.dynamic.time_density import TimeDensity, time_chunk_weights, validate_time_chunk_overlaps
from neuprim.tasks.dynamic.volume.volume_scene import join_time_chunks
from tests import scenes
from tests.timed_models import model

SEAMS = ((0.25, 0.375), (0.625, 0.75))
CHUNKS = torch.arange(3.0)[:, None]
TIMES = (0.0, 0.2, 0.25, 0.3, 0.375, 0.5, 0.7, 0.75, 1.0)
EXACT = RenderSettings(backend="reference", alpha_min=0.0, transmittance_min=0.0)


def at(time: float) -> dict[str, Tensor]:
    return {"time": torch.tensor(time)}


def three(time: str = "phase+window+motion") -> list[Primitives]:
    """Of one form, with windows that reach far beyond any chunk."""
    models = []
    for seed in range(3):
        one = model(time, neurons=2, dtype=torch.float32)
        generator = torch.Generator().manual_seed(seed)
        means = one.params["means"].detach()
        one.params["means"] = means + 0.2 * torch.rand(means.shape, generator=generator)
        if "window" in time:
            one.params["log_window"] = torch.full_like(one.params["log_window"], 1.0)
        models.append(one)
    return models


# ---------------------------------------------------------------- weights of chunks


def test_shares_add_up_to_one_at_every_time_and_at_most_two_count() -> None:
    for time in torch.linspace(-0.5, 1.5, 401, dtype=torch.float64):
        own = time_chunk_weights(CHUNKS, SEAMS, time)[:, 0]
        assert float(own.sum()) == pytest.approx(1.0, abs=1e-15) and int((own > 0).sum()) <= 2


@pytest.mark.parametrize(
    "wrong", [[(0.5, 0.5)], [(0.5, 0.4)], [(0.1, 0.3), (0.2, 0.4)], [(0.1,)], [("a", 0.2)], [(0.1, float("nan"))], 3]
)
def test_other_seams_are_refused(wrong: object) -> None:
    with pytest.raises(ValueError, match="expected pairs of"):
        validate_time_chunk_overlaps(wrong)  # type: ignore[arg-type]


# ---------------------------------------------------------------- joining


@pytest.mark.parametrize("time", ["phase", "window+motion", "phase+offset+window+motion"])
def test_a_joined_field_is_the_sum_of_the_chunks_by_their_shares(time: str) -> None:
    models = three(time=time)
    whole = join_time_chunks(models, [0, 1, 2], SEAMS)
    points = torch.rand((200, 3), generator=torch.Generator().manual_seed(5)) - 0.5
    for moment in TIMES:
        own = time_chunk_weights(CHUNKS, SEAMS, torch.tensor(moment))[:, 0]
        parts = [_sums(m, points, moment) for m in models]
        found = _sums(whole, points, moment)
        assert float(found.abs().max()) > 0
        wanted = sum(share * part for share, part in zip(own, parts, strict=True))
        assert torch.allclose(found, wanted, rtol=1e-5, atol=1e-5)


def _sums(m: Primitives, points: Tensor, time: float) -> Tensor:
    """(4, M) extinction and source of all primitives at some points."""
    values = volume_values_at(m, at(time), points, True, 1)
    return torch.cat([values.sigma[None], values.source.T]).detach()


def test_a_frame_of_one_chunk_is_that_chunks_own_image_to_the_bit() -> None:
    models = three()
    whole, camera = join_time_chunks(models, [0, 1, 2], SEAMS), scenes.camera()
    for moment, chunk in ((0.0, 0), (0.25, 0), (0.375, 1), (0.625, 1), (0.75, 2), (1.0, 2)):
        expected = render(models[chunk], camera, at(moment)).rgb
        assert torch.equal(render(whole, camera, at(moment)).rgb, expected)
        assert len(whole.density.active_rows(whole.of(whole.density), at(moment))) <= models[chunk].count  # type: ignore[arg-type]


def test_nothing_lives_where_its_chunk_has_seen_nothing_however_long_its_window() -> None:
    whole = join_time_chunks(three(), [0, 1, 2], SEAMS)
    for moment in torch.linspace(0, 1, 101).tolist():
        alive = whole.density.active_rows(whole.of(whole.density), at(moment))
        assert alive is not None and len(alive)
        for chunk in whole.params["chunk"][alive, 0].unique().tolist():
            begin = SEAMS[int(chunk) - 1][0] if chunk > 0 else 0.0
            end = SEAMS[int(chunk)][1] if chunk < 2 else 1.0
            assert begin - 1e-7 <= moment <= end + 1e-7
    assert float(whole.params["log_window"].exp().min()) > 1  # of its own accord all would live for ever


def test_a_chunk_that_holds_nothing_leaves_its_time_empty() -> None:
    first, _, last = three()
    whole = join_time_chunks([first, last], [0, 2], SEAMS)
    alive = whole.density.active_rows(whole.of(whole.density), at(0.5))
    assert alive is not None and len(alive) == 0
    assert not bool(render(whole, scenes.camera(), at(0.5)).alpha.any())


def test_models_of_other_forms_are_refused() -> None:
    with pytest.raises(ConfigError, match="different forms"):
        join_time_chunks([three()[0], *three(time="window+motion")[1:]], [0, 1, 2], SEAMS)
    whole = join_time_chunks(three(), [0, 1, 2], SEAMS)
    with pytest.raises(ConfigError, match="expected a TimeDensity without seams"):
        join_time_chunks([whole, whole, whole], [0, 1, 2], SEAMS)


# ---------------------------------------------------------------- what is done with it


def test_the_reference_agrees_and_labels_have_no_gradient() -> None:
    whole, camera = join_time_chunks(three(), [0, 1, 2], SEAMS), scenes.camera()
    whole.params = {name: value.requires_grad_() for name, value in whole.params.items()}
    for moment in (0.3, 0.7):
        image = render(whole, camera, at(moment), RenderSettings(alpha_min=0.0, transmittance_min=0.0)).rgb
        assert torch.allclose(image.double(), render(whole, camera, at(moment), EXACT).rgb.double(), atol=2e-5)
    image.sum().backward()
    assert whole.params["chunk"].grad is None and bool(whole.params["means"].grad.any())  # type: ignore[union-attr]


def test_a_part_of_time_can_be_taken_away() -> None:
    whole = join_time_chunks(three(), [0, 1, 2], SEAMS)
    field, fewer = whole.density.reduce(whole.of(whole.density), whole.geometry, "phase", 0)
    assert isinstance(field, TimeDensity) and field.seams == SEAMS
    assert torch.equal(fewer["chunk"], whole.params["chunk"])


def test_files_keep_seams_and_labels(tmp_path: Path) -> None:
    whole = join_time_chunks(three(), [0, 1, 2], SEAMS)
    checkpoint.save_model(tmp_path / "model.safetensors", whole, "dynamic", {})
    again, _ = checkpoint.load_model_checkpoint(tmp_path / "model.safetensors", TASK)
    assert again.density.settings() == whole.density.settings()
    assert torch.equal(again.params["chunk"], whole.params["chunk"])


def test_labels_survive_every_level_of_compression() -> None:
    count = 40
    seams = tuple((n / count, (n + 0.5) / count) for n in range(1, count))
    whole = join_time_chunks([three()[0]] * count, range(count), seams)
    small = canonical_model(whole)
    for table in LEVELS.values():
        back = fake_quantize(small.params, fit_quantizers(small, table))["chunk"]
        assert torch.equal(back.round(), small.params["chunk"])

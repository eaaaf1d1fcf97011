"""The end of a run once more: rates, what stays as it is, and training for few bits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neuprim.config import Job
from neuprim.core.compression.codec import Quantizers, canonical_model, fit_quantizers
from neuprim.core.compression.quantizers import ColumnQuantizer, bit_table
from neuprim.core.data import Dataset
from neuprim.core.model.primitives import Primitives
from neuprim.runs.open import load_dataset, load_run
from neuprim.runs.training import COOL, LEAST_START, LONG, START, make_run_finetune_trainer
from neuprim.search.compress import QuantizationSearch, TrainingData, dequantize, finetune_for_table, search_fewest_bits
from neuprim.search.model_quality import SearchQuality
from tests.core import tiny
from tests.short_runs import fit, words


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    return fit(words(tiny.write_blender(folder / "two"), folder / "run", 300, "renderer.threads=1"))


@pytest.fixture(scope="module")
def dataset(run_dir: Path) -> Dataset:
    return load_dataset(load_run(run_dir))


def test_rates_begin_above_those_of_the_run_s_end_and_fall_to_next_to_nothing(run_dir: Path, dataset: Dataset) -> None:
    stored = load_run(run_dir)
    config, task, model = stored.config, stored.task, stored.model
    assert 40 / LONG * START < LEAST_START
    trainer = make_run_finetune_trainer(Job(config, task), dataset, model, 40)
    spec = next(s for s in model.specs if s.name == "b2")
    usual = config.train.rates.get("b2", spec.lr) * config.train.final_rate
    assert trainer.rates()["b2"] == pytest.approx(LEAST_START * usual, rel=1e-6)
    means = config.train.rates["means"] * config.train.final_rate * trainer.pixel
    assert trainer.rates()["means"] == pytest.approx(LEAST_START * means, rel=1e-6)
    for _ in range(40):
        trainer.train_step()
    assert trainer.finished and trainer.rates()["b2"] == pytest.approx(COOL * LEAST_START * usual, rel=1e-6)
    for steps, start in (
        (LONG, START),
        (3 * LONG, START),
        (2 * LONG // 3, 2 * START / 3),
    ):  # of many steps they begin higher
        assert make_run_finetune_trainer(Job(config, task), dataset, model, steps).rates()["b2"] == pytest.approx(
            start * usual, rel=1e-3
        )


def test_the_model_itself_stays_as_it_is_and_no_primitive_is_born_or_moved(run_dir: Path, dataset: Dataset) -> None:
    stored = load_run(run_dir)
    config, task, model = stored.config, stored.task, stored.model
    before = {name: value.clone() for name, value in model.params.items()}
    eager = replace(
        config, train=replace(config.train, population=replace(config.train.population, every=1, start=0.0, stop=1.0))
    )
    trainer = make_run_finetune_trainer(Job(eager, task), dataset, model, 30)
    changes = [trainer.train_step().change for _ in range(30)]
    assert set(changes) == {None} and trainer.model.count == model.count
    assert all(torch.equal(model.params[name], value) for name, value in before.items())
    assert not torch.equal(trainer.model.params["means"], before["means"])


def test_what_is_to_stay_zero_does_and_nothing_else(run_dir: Path, dataset: Dataset) -> None:
    stored = load_run(run_dir)
    config, task, model = stored.config, stored.task, stored.model
    zero = torch.zeros_like(model.params["sh_rest"], dtype=torch.bool)
    zero[::2, 3:] = True
    pruned = Primitives(
        model.density, model.colour, {**model.params, "sh_rest": model.params["sh_rest"].masked_fill(zero, 0.0)}
    )
    trainer = make_run_finetune_trainer(Job(config, task), dataset, pruned, 20)
    trainer.zero_masks = {"sh_rest": zero}
    for _ in range(20):
        trainer.train_step()
    after = trainer.model.params["sh_rest"].detach()
    assert bool((after[zero] == 0).all()) and not torch.equal(after[~zero], pruned.params["sh_rest"][~zero])
    tensors, header = trainer.state()
    again = make_run_finetune_trainer(Job(config, task), dataset, pruned, 20)
    again.load_state(tensors, header, "state")
    assert torch.equal(again.zero_masks["sh_rest"], zero)


# ---------------------------------------------------------------- few bits


@pytest.fixture
def data(run_dir: Path, dataset: Dataset) -> TrainingData:
    stored = load_run(run_dir)
    config, task = stored.config, stored.task
    return TrainingData(config, task, dataset)


def ignore(text: str, fraction: float) -> None:
    pass


def equal(a: Primitives, b: Primitives) -> bool:
    return all(torch.equal(a.params[name], value) for name, value in b.params.items())


def test_training_for_few_bits_wins_back_what_they_cost(run_dir: Path, data: TrainingData) -> None:
    model, quality = load_run(run_dir).model, SearchQuality(data.dataset, data.config.renderer)
    table, plain = bit_table(5, [], model.specs), canonical_model(model)
    at_once = quality(dequantize(plain, fit_quantizers(plain, table)))
    fewer, again = (finetune_for_table(data, model, table, 150, ignore) for _ in range(2))
    assert fewer.steps == 150 and fewer.notes == () and equal(again.model, fewer.model)
    assert quality(dequantize(fewer.model, fewer.quantizers)) > at_once + 0.2


@pytest.mark.parametrize("steps", [0, 200])
def test_a_tolerance_is_kept(run_dir: Path, data: TrainingData, steps: int) -> None:
    model, quality = load_run(run_dir).model, SearchQuality(data.dataset, data.config.renderer)
    base = quality(model)
    for allowed in (0.1, 0.5):
        fewer = search_fewest_bits(data, model, allowed, steps, ignore)
        assert base - quality(dequantize(fewer.model, fewer.quantizers)) <= allowed + 1e-6
        assert torch.equal(fewer.model.params["W1"], canonical_model(model).params["W1"]) == (steps == 0)


def test_training_that_spoils_the_model_is_not_stored(
    run_dir: Path, data: TrainingData, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = load_run(run_dir).model
    plain = search_fewest_bits(data, model, 0.2, 0, ignore)
    monkeypatch.setattr("neuprim.runs.training.LEAST_START", 300.0)
    found = search_fewest_bits(data, model, 0.2, 20, ignore)
    assert equal(found.model, plain.model) and found.notes == plain.notes and found.steps == 20
    fewer = finetune_for_table(data, model, bit_table(1, [], model.specs), 20, ignore)
    assert fewer.steps == 20 and len(fewer.notes) == 1 and "brought nothing" in fewer.notes[0]
    assert equal(fewer.model, canonical_model(model))


@pytest.mark.parametrize("start", [1e-3, 0.1, 20.0])
def test_the_coarsest_numbers_that_are_enough_are_found(run_dir: Path, data: TrainingData, start: float) -> None:
    quality = SearchQuality(data.dataset, data.config.renderer)
    rounding = QuantizationSearch(load_run(run_dir).model, data.dataset, quality)

    def width(made: Quantizers) -> float:
        scheme = made["sh_dc"]
        assert isinstance(scheme, ColumnQuantizer)
        return float((scheme.high - scheme.low).double() @ (1.0 / scheme.last).double())

    wanted = width(rounding.fit(0.3))
    coarse, above = rounding.find_finest(lambda m: width(m) > wanted, start)
    assert width(coarse) > wanted and 0.2999 <= above < 0.4
    made, share = rounding.find_coarsest(lambda m: width(m) <= wanted, start)
    assert width(made) <= wanted < width(rounding.fit(1.1 * share)) and 0.2 < share <= 0.3001

"""The training loop: it learns, and it goes on exactly where it was stopped."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core import checkpoint
from neuprim.core.compute import threads
from neuprim.core.data import Dataset, PointCloud
from neuprim.core.errors import CheckpointError, ConfigError, DataError, DeviceMemoryError, NonFiniteError
from neuprim.core.metrics import psnr
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import Contributions
from neuprim.core.render.near_plane import typical_pixel_size
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.population import FixedPopulation
from neuprim.core.train.settings import MIN_COOLDOWN, ModelSettings, PopulationSettings, TrainSettings
from neuprim.core.train.trainer import StepReport, Trainer
from neuprim.runs.measure import render_image
from tests.core import tiny


@pytest.fixture(scope="module")
def plain() -> Dataset:
    return tiny.two_primitives()


@pytest.fixture(scope="module")
def random_background() -> Dataset:
    return tiny.two_primitives(random_background=True)


STRATEGIES: dict[str, dict[str, Any]] = {
    "fixed": {},
    "relocate": {"strategy": "relocate", "fraction": 0.2},
    "gradient": {
        "strategy": "gradient",
        "grow_threshold": 1e-4,
        "prune_threshold": 1e-9,
        "clone_scale": 0.05,
        "max_primitives": 20,
    },
}


def same(a: Trainer, b: Trainer) -> None:
    first, second = a.state(), b.state()
    assert {**first[1], "elapsed": 0} == {**second[1], "elapsed": 0}
    assert first[0].keys() == second[0].keys()
    for name, value in first[0].items():
        assert value.dtype == second[0][name].dtype and torch.equal(value, second[0][name]), name


def curve(reports: list[StepReport]) -> list[tuple[Any, ...]]:
    return [(r.step, r.loss, r.psnr, r.primitives, r.view, r.change) for r in reports]


def test_training_learns(plain: Dataset) -> None:
    trainer = tiny.trainer(plain, 300)
    reports = list(trainer.run())
    assert len(reports) == 300 and trainer.finished
    first, last = reports[:6], reports[-6:]
    assert sum(r.loss for r in last) < 0.2 * sum(r.loss for r in first)
    assert sum(r.psnr for r in last) / 6 > 24
    assert all(math.isfinite(r.loss) for r in reports)
    assert [r.step for r in reports] == list(range(1, 301))


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_half_saved_loaded_and_half_is_the_whole(strategy: str, random_background: Dataset, tmp_path: Path) -> None:
    """N chosen so that the stop falls in the middle of an epoch and between two interventions."""

    def make() -> Trainer:
        smooth = {"warmup_steps": 5, "anisotropy_weight": 1e-3, "anisotropy_from": 15, "stride": 2}
        return tiny.trainer(random_background, 40, population=STRATEGIES[strategy], **smooth)

    whole = make()
    expected = list(whole.run())
    first = make()
    reports = [first.train_step() for _ in range(20)]
    tensors, header = first.state()
    checkpoint.write_tensors(tmp_path / "c.safetensors", "checkpoint", tensors, header)

    torch.manual_seed(99)  # the global generator plays no part
    second = make()
    header, tensors = checkpoint.read_tensors(tmp_path / "c.safetensors", "checkpoint")
    second.load_state(tensors, header, "c.safetensors")
    assert second.step == 20 and second.elapsed == first.elapsed
    same(first, second)
    reports += second.run()
    assert curve(reports) == curve(expected)
    same(whole, second)
    changed = [r.change for r in expected if r.change]
    assert bool(changed) == (strategy != "fixed")
    if strategy == "gradient":
        assert whole.model.count > 12
    assert whole.optimizer.age.max() == 40
    assert (whole.optimizer.age.min() < 40) == (strategy != "fixed")


def test_every_view_once_per_epoch(plain: Dataset) -> None:
    trainer = tiny.trainer(plain, 18)
    names = [trainer.train_step().view for _ in range(18)]
    epochs = [names[i : i + 6] for i in (0, 6, 12)]
    assert all(sorted(e) == [f"v{i}" for i in range(6)] for e in epochs)
    assert epochs[0] != epochs[1] or epochs[1] != epochs[2]


def test_rates(plain: Dataset) -> None:
    """Warm-up, decay to a fraction of themselves, and a cool-down that ends just above zero."""
    trainer = tiny.trainer(plain, 100, final_rate=0.01, warmup_steps=4, rates={"b2": 0.5})
    first = trainer.rates()
    assert first["b2"] == pytest.approx(0.5 / 4)
    specs = {s.name: s for s in trainer.model.specs}
    assert first["means"] == pytest.approx(specs["means"].lr * plain.extent / 4)
    trainer.step = 50
    assert trainer.rates()["W1"] == pytest.approx(specs["W1"].lr * 0.1)
    trainer.step = 100
    assert trainer.rates()["b2"] == pytest.approx(0.5 * 0.01)
    usual, cooled = (tiny.trainer(plain, 1000, final_rate=0.1, cooldown=share) for share in (0.0, 0.2))
    expected = {0: 1, 400: 1, 800: 1, 900: 0.5, 950: 0.25, 999: MIN_COOLDOWN, 1000: MIN_COOLDOWN}
    for step, share in expected.items():
        usual.step = cooled.step = step
        assert cooled.rates() == pytest.approx({name: share * rate for name, rate in usual.rates().items()})


@pytest.mark.parametrize("count", [1, 3])
def test_a_step_works_on_as_many_threads_as_the_renderer_has(
    plain: Dataset, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its loss and its optimiser too, whatever the machine has."""
    trainer, other, asked = tiny.trainer(plain, 40), tiny.trainer(plain, 40), set()
    monkeypatch.setattr(threads, "core_count", lambda: 5)
    monkeypatch.setattr(threads, "_thread_pool", lambda n, made=threads._thread_pool: asked.add(n) or made(n))  # type: ignore[func-returns-value]
    trainer.renderer = replace(trainer.renderer, threads=count)
    trainer.train_step()
    assert asked == (set() if count == 1 else {3})
    other.train_step()
    assert asked - {3} == {5}
    same(trainer, other)


def test_units_of_rates(plain: Dataset) -> None:
    """A word takes the place of a parameter's own unit, of positions and of anything else."""
    assert plain.extent > 2, "otherwise the units could be mixed up"
    units = {"means": "absolute", "b2": "extent"}
    trainer = tiny.trainer(plain, 100, final_rate=1.0, rates={"means": 1.6e-4, "b2": 0.5}, rate_units=units)
    assert trainer.rates()["means"] == pytest.approx(1.6e-4) and trainer.rates()["b2"] == pytest.approx(
        0.5 * plain.extent
    )
    assert tiny.trainer(plain, 100, rates={"means": 1.6e-4}).rates()["means"] == pytest.approx(1.6e-4 * plain.extent)
    by_pixel = tiny.trainer(plain, 100, rates={"means": 0.1}, rate_units={"means": "pixel"})
    assert by_pixel.rates()["means"] == pytest.approx(0.1 * plain.extent / 250), "no larger steps for coarse images"
    cameras = [replace(plain.train.view(i).camera, fx=1e4) for i in range(len(plain.train))]
    means = by_pixel.model.params["means"].detach()
    depth = torch.cat([camera.project(means)[1] for camera in cameras]).median().item()
    assert typical_pixel_size(means, cameras, plain.extent) == pytest.approx(depth / 1e4, rel=0.05)
    before = trainer.model.params["means"].detach().clone()
    trainer.train_step()  # the first step of Adam is the rate, whatever the gradient
    assert (trainer.model.params["means"].detach() - before).abs().max().item() == pytest.approx(1.6e-4, rel=0.01)
    with pytest.raises(ConfigError, match=r"train\.rate_units\.mean: no such parameter; did you mean 'means'"):
        tiny.trainer(plain, 100, rate_units={"mean": "absolute"})


def test_a_size_weight_costs_the_mean_semi_axis_over_the_extent(plain: Dataset) -> None:
    without, small = tiny.trainer(plain), tiny.trainer(plain, size_weight=0.5)
    expected = 0.5 * float(small.model.params["log_scales"].exp().mean()) / small.extent
    assert small.train_step().loss - without.train_step().loss == pytest.approx(expected, rel=1e-4)
    for trainer in (without, small):
        list(trainer.run())
    after = [float(trainer.model.params["log_scales"].exp().mean()) for trainer in (without, small)]
    assert after[1] < 0.9 * after[0]


def test_budget_of_seconds(plain: Dataset) -> None:
    trainer = tiny.trainer(plain, 10**9, max_seconds=0.05)
    reports = list(trainer.run())
    assert 0 < len(reports) < 10_000 and trainer.elapsed >= 0.05 and trainer.progress == 1.0
    assert list(tiny.trainer(plain, 0).run()) == []


def test_masked_pixels_do_not_count(plain: Dataset) -> None:
    mask = torch.ones(tiny.SIZE, tiny.SIZE, dtype=torch.bool)
    mask[:, 12:] = False
    clean = [replace(p, mask=mask) for p in plain.train.images]  # type: ignore[attr-defined]
    spoiled = [replace(p, rgb=torch.where(mask[..., None], p.rgb, torch.full_like(p.rgb, 1e3))) for p in clean]
    results = []
    for images in (spoiled, clean):
        dataset = tiny.two_primitives()
        dataset.train.images = images  # type: ignore[attr-defined]
        trainer = tiny.trainer(dataset, 5, ssim_weight=0.0)
        list(trainer.run())
        results.append(trainer)
    same(*results)


def test_the_psnr_of_a_step_is_that_of_the_pixels_that_count() -> None:
    dataset = tiny.two_primitives()
    mask = torch.zeros(tiny.SIZE, tiny.SIZE, dtype=torch.bool)
    mask[8:14, 5:20] = True
    dataset.train.images = [replace(p, mask=mask) for p in dataset.train.images]  # type: ignore[attr-defined]
    trainer = tiny.trainer(dataset, 3)
    drawn = [
        render_image(trainer.model, dataset.train.view(i), trainer.renderer, dataset.background)
        for i in range(len(dataset.train))
    ]
    report = trainer.train_step()
    index = [dataset.train.view(i).name for i in range(len(dataset.train))].index(report.view)
    expected = psnr(drawn[index], dataset.train.pixels(index).over(dataset.background), mask)
    assert report.psnr == pytest.approx(expected, abs=1e-4)


class _Seen(FixedPopulation):
    """Leaves the model as it is and keeps what it was told."""

    def __init__(self) -> None:
        super().__init__(PopulationSettings(strategy="fixed"))
        self.weights: list[Tensor] = []

    def observe(self, model: Primitives, tally: Contributions) -> None:
        self.weights.append(tally.of_all(model.count)[0].clone())


@pytest.mark.parametrize("views", [2, 3])
def test_gradients_of_several_views_are_their_mean(views: int, plain: Dataset) -> None:
    """And the population sees all of them, and the report speaks of all of them."""
    still = {spec.name: 0.0 for spec in tiny.trainer(plain, 10).model.specs}
    several = tiny.trainer(plain, 10, views_per_step=views, rates=still)
    single = tiny.trainer(plain, 10, rates=still)
    several.population, single.population = together, apart = _Seen(), _Seen()
    report = several.train_step()
    grads: dict[str, Tensor] = {}
    reports = []
    for _ in range(views):
        reports.append(single.train_step())
        for name, value in single.model.params.items():
            if value.grad is not None:  # bands of colours that are locked have none
                grads[name] = grads.get(name, torch.zeros_like(value)) + value.grad / views
    assert len(grads) >= 8
    rounding = 1e-6 * max(
        float(grad.abs().max()) for grad in grads.values()
    )  # of spheres, turning them is nothing else
    for name, value in several.model.params.items():
        assert (value.grad is not None) == (name in grads)
        assert value.grad is None or torch.allclose(value.grad, grads[name], rtol=1e-4, atol=rounding), name
    assert len(together.weights) == 1 and torch.allclose(
        together.weights[0], sum(apart.weights, torch.zeros(())), rtol=1e-5
    )
    assert report.loss == pytest.approx(sum(r.loss for r in reports) / views, rel=1e-5)
    assert report.psnr == pytest.approx(sum(r.psnr for r in reports) / views, rel=1e-5)
    assert report.parts == pytest.approx(
        {k: sum(r.parts[k] for r in reports) / views for k in reports[0].parts}, rel=1e-5
    )
    assert report.view == f"{reports[-1].view} and {views - 1} more" and several.step == 1


# ---------------------------------------------------------------- what goes wrong


def test_a_full_card_is_one_line_that_says_what_to_lower(plain: Dataset) -> None:
    trainer = tiny.trainer(plain, views_per_step=2)
    trainer.train_step()
    trainer.loss = lambda *_: (_ for _ in ()).throw(
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")
    )
    with pytest.raises(
        DeviceMemoryError,
        match=r"out of memory at step 1 with 12 primitives, images of \d+ x \d+ pixels and train.views_per_step=2; "
        r"lower",
    ):
        trainer.train_step()


def test_a_non_finite_parameter_stops_by_name(plain: Dataset) -> None:
    trainer = tiny.trainer(plain)
    trainer.train_step()
    with torch.no_grad():
        trainer.model.params["w2"][4, 1] = float("inf")
    with pytest.raises(NonFiniteError, match=r"w2 of primitive 4\b"):
        trainer.train_step()


def test_empty_splits_and_no_points(plain: Dataset) -> None:
    model = tiny.trainer(plain).model
    dataset = tiny.two_primitives()
    dataset.train.cameras = []  # type: ignore[attr-defined]
    with pytest.raises(DataError, match="training split is empty"):
        Trainer(model, dataset, lambda a, b: (a, {}), TrainSettings(), tiny.RenderSettings(), 0)
    nowhere = replace(
        dataset, start=lambda views, count, generator: tiny.PointCloud(torch.zeros(0, 3), torch.zeros(0, 3))
    )
    with pytest.raises(DataError, match="two: no starting points"):
        initial_model_to_train(model.density, model.colour, nowhere, ModelSettings(), 0)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_points_still_make_a_model(plain: Dataset, count: int) -> None:
    model = initial_model_to_train(
        tiny.CosineDensity(2), tiny.SphericalHarmonics(0), plain, ModelSettings(primitives=count), 0
    )
    assert model.count == count
    assert bool(torch.isfinite(model.geometry.scales).all()) and model.geometry.scales.min() > 0


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("alpha", 1.0, "above 0 and below 1"),
        ("alpha", "much", "a finite number above 0 and below 1"),
        ("scale", 0, "above 0"),
        ("mode", "papr", "opaque or paper"),
    ],
)
def test_impossible_starting_values_name_their_key(plain: Dataset, key: str, value: object, expected: str) -> None:
    with pytest.raises(ConfigError, match=rf"model\.init\.{key}={value}: expected .*{expected}"):
        initial_model_to_train(
            tiny.CosineDensity(2), tiny.SphericalHarmonics(0), plain, ModelSettings(primitives=5, init={key: value}), 0
        )


DAMAGES: dict[str, Callable[[dict[str, Any]], None]] = {
    "no step": lambda h: h.pop("step"),
    "step of text": lambda h: h.update(step="20"),
    "step negative": lambda h: h.update(step=-1),
    "elapsed nan": lambda h: h.update(elapsed=float("nan")),
    "other data": lambda h: h.update(views=7),
    "other names": lambda h: h.update(names="0" * 16),
    "missing parameter": lambda t: t.pop("params.w2"),
    "another parameter": lambda t: t.update({"params.w3": t["params.w2"]}),
    "parameter shape": lambda t: t.update({"params.w2": t["params.w2"][:, :2]}),
    "parameter type": lambda t: t.update({"params.w2": t["params.w2"].double()}),
    "parameter nan": lambda t: t["params.w2"].fill_(float("nan")),
    "rows differ": lambda t: t.update({"params.w2": t["params.w2"][:5]}),
    "scalar means": lambda t: t.update({"params.means": torch.tensor(1.0)}),
    "missing moment": lambda t: t.pop("adam.m.w2"),
    "moment shape": lambda t: t.update({"adam.v.w2": torch.zeros(12, 3)}),
    "moment type": lambda t: t.update({"adam.v.w2": t["adam.v.w2"].double()}),
    "age shape": lambda t: t.update({"adam.age": torch.zeros(3, dtype=torch.int64)}),
    "age beyond the steps": lambda t: t["adam.age"].__setitem__(2, 2**50),
    "age negative": lambda t: t["adam.age"].__setitem__(2, -1),
    "order range": lambda t: t.update(order=torch.tensor([0, 6])),
    "no generator": lambda t: t.pop("generator"),
    "short generator": lambda t: t.update(generator=t["generator"][:100]),
    "population shape": lambda t: t.update({"population.weight": torch.zeros(3)}),
    "exposure": lambda t: t.update({"exposure.seen": torch.zeros(3)}),
    "zeros": lambda t: t.update({"zeros.w2": torch.zeros(3, dtype=torch.bool)}),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(plain: Dataset, kind: str) -> None:
    old, new, untouched = (tiny.trainer(plain, 40, population=STRATEGIES["relocate"]) for _ in range(3))
    for _ in range(3):
        old.train_step()
    tensors, header = old.state()
    tensors = {k: v.clone() for k, v in tensors.items()}
    DAMAGES[kind](header if list(DAMAGES).index(kind) < 6 else tensors)
    with pytest.raises(CheckpointError, match=r"some file\.safetensors"):
        new.load_state(tensors, header, "some file.safetensors")
    same(new, untouched)


def test_points_that_no_camera_sees_are_refused(plain: Dataset) -> None:
    away = PointCloud(torch.full((4, 3), 100.0) + torch.rand(4, 3), torch.full((4, 3), 0.5))
    with pytest.raises(
        DataError,
        match=r"none of 4 starting points is in the image of a training camera; .*model\.init\.points.*ply_file_path",
    ):
        tiny.trainer(replace(plain, start=lambda views, count, generator: away))


def test_cameras_without_extent_move_by_the_depth(plain: Dataset) -> None:
    still = tiny.trainer(replace(plain, extent=1e-9))
    assert still.extent > 0.1 and still.rates()["means"] == pytest.approx(7e-4 * still.extent, rel=0.1)
    assert tiny.trainer(plain).extent == plain.extent

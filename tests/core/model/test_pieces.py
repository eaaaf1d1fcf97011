"""Pieces of primitives: what fields name, what their absence changes, and files that leave them out."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from neuprim.core import checkpoint
from neuprim.core.errors import CheckpointError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import Field, prunable_units_of_model
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import (
    count_unit_numbers,
    dense_primitive_parameters,
    primitive_unit_removal_effect,
    primitives_with_unit,
    sparse_primitive_parameters,
    zero_units,
)
from neuprim.core.task import TaskSpec
from neuprim.plugins.registry import load_task
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.relight.colour import LightHarmonics, LightNetwork
from neuprim.tasks.relight.surface import SurfaceColour
from neuprim.tasks.static import SphericalHarmonics, SphericalLobes
from tests.core.model.shaken import CONDITIONS, COUNT, camera, made

PAIRS = [
    (CosineDensity(3, edge=2, gain=True), SphericalHarmonics(3)),
    (TimeDensity(2, "phase+offset+window+motion"), TimeHarmonics(2)),
    (CosineDensity(1), SphericalLobes(3)),
    (CosineDensity(1), LightHarmonics(4)),
    (CosineDensity(1), SurfaceColour(3)),
    (CosineDensity(0), LightNetwork(4, visibility="none")),
    (CosineDensity(0), LightNetwork(3, form="multiplicative", visibility="none")),
]


def pruned(model: Primitives, seed: int = 5) -> Primitives:
    """The model, in which every piece is gone from half of the primitives."""
    generator = torch.Generator().manual_seed(seed)
    pieces = prunable_units_of_model(model.density, model.colour)
    gone = {name: (piece, torch.rand(model.count, generator=generator) < 0.5) for name, piece in pieces.items()}
    return Primitives(model.density, model.colour, zero_units(gone, model.params))


@pytest.mark.parametrize(("density", "colour"), PAIRS, ids=lambda field: type(field).__name__)
def test_no_number_is_in_two_pieces_and_each_has_some(density: Field, colour: Field) -> None:
    model = made(density, colour)
    pieces = prunable_units_of_model(model.density, model.colour)
    assert pieces
    times = {name: torch.zeros_like(value) for name, value in model.params.items()}
    for piece in pieces.values():
        assert count_unit_numbers(piece, model.params) > 0
        for name, place in piece.places.items():
            times[name][(slice(None), *place)] += 1
    assert all(float(count.max()) <= 1 for count in times.values() if count.numel())


@pytest.mark.parametrize(("density", "colour"), PAIRS, ids=lambda field: type(field).__name__)
def test_of_a_piece_that_is_gone_nothing_is_left(density: Field, colour: Field) -> None:
    """A primitive whose piece is zero looks like one whose other numbers of the piece never were: moving zeros
    elsewhere changes nothing."""
    model = made(density, colour)
    for name, piece in prunable_units_of_model(model.density, model.colour).items():
        everywhere = torch.ones(COUNT, dtype=torch.bool)
        empty = Primitives(model.density, model.colour, zero_units({name: (piece, everywhere)}, model.params))
        assert not bool(primitives_with_unit(piece, empty.params).any())
        assert bool(primitives_with_unit(piece, model.params).all())
        empty.lower(camera(), CONDITIONS).check()
        untouched = [key for key in model.params if key not in piece.places]
        assert all(empty.params[key] is model.params[key] for key in untouched)


def test_a_neuron_that_is_gone_is_a_field_without_it() -> None:
    model = made(*PAIRS[0])
    piece = prunable_units_of_model(model.density, model.colour)["density.neuron 1"]
    empty = zero_units({"": (piece, torch.ones(COUNT, dtype=torch.bool))}, model.params)
    own = model.of(model.density)
    fewer = {name: value[:, [0, 2]] if name in ("W1", "b1", "w2") else value for name, value in own.items()}
    prim, x = torch.arange(COUNT), model.params["means"] + 0.02
    found = model.density.density({name: empty[name] for name in own}, model.geometry, prim, x, {})
    expected = CosineDensity(2, edge=2, gain=True).density(fewer, model.geometry, prim, x, {})
    assert torch.allclose(found, expected, atol=1e-6)


def test_worth_is_the_first_order_of_doing_without() -> None:
    model = made(*PAIRS[0])
    piece = prunable_units_of_model(model.density, model.colour)["colour.coefficient 2 +0, channel 1"]
    params = {name: value.clone().requires_grad_() for name, value in model.params.items()}
    weights = torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(1))
    colours = 5.0 + sum((params["sh_rest"][:, i] for i in range(15)), torch.zeros(COUNT, 3))  # linear, as harmonics are
    (colours * weights).sum().backward()
    gradients = {name: torch.zeros_like(value) if value.grad is None else value.grad for name, value in params.items()}
    expected = model.params["sh_rest"][:, 5, 1] * weights[:, 1]
    assert torch.allclose(primitive_unit_removal_effect(piece, params, gradients), expected, atol=1e-5)


# ---------------------------------------------------------------- files

BITS = (45 * COUNT + 7) // 8  # bytes of the bits of COUNT primitives' coefficients of degree 3


@pytest.mark.parametrize(("density", "colour"), PAIRS, ids=lambda field: type(field).__name__)
def test_files_leave_zeros_out_and_give_them_back(density: Field, colour: Field) -> None:
    model = pruned(made(density, colour))
    own = (*model.density.parameters(), *model.colour.parameters())
    stored, sparse = sparse_primitive_parameters(model.params, own)
    again = dense_primitive_parameters(stored, sparse, own, "file")
    assert sparse and again.keys() == model.params.keys()
    for name, value in model.params.items():
        assert torch.equal(again[name].view(torch.int32), value.view(torch.int32)), name
    assert sum(t.numel() * t.element_size() for t in stored.values()) < 4 * model.count * model.parameters_per_primitive


@pytest.fixture
def task() -> TaskSpec:
    return load_task("static")


@pytest.fixture
def file(tmp_path: Path, task: TaskSpec) -> Path:
    path = tmp_path / "model.safetensors"
    model = pruned(made(CosineDensity(2, edge=2, gain=True), SphericalHarmonics(3)))
    checkpoint.save_model(path, model, task.name, {}, without_zeros=True)
    return path


def test_a_pruned_model_loads_as_it_was(file: Path, task: TaskSpec) -> None:
    model, header = checkpoint.load_model_checkpoint(file, task)
    assert checkpoint.read_header(file, "model")["sparse"] and "sparse" not in header  # the model in memory is whole
    expected = pruned(made(CosineDensity(2, edge=2, gain=True), SphericalHarmonics(3)))
    assert all(torch.equal(model.params[name], value) for name, value in expected.params.items())
    plain = file.with_name("plain.safetensors")
    checkpoint.save_model(plain, made(CosineDensity(2, edge=2, gain=True), SphericalHarmonics(3)), task.name, {})
    assert file.stat().st_size < 0.75 * plain.stat().st_size


LIES = {
    "no mask": (lambda t: t.pop("sh_rest|there"), "sh_rest|there is missing"),
    "a short mask": (lambda t: t.update({"sh_rest|there": torch.zeros(1).byte()}), f"expected torch.uint8 ({BITS},)"),
    "a mask of floats": (lambda t: t.update({"sh_rest|there": torch.zeros(BITS)}), f"expected torch.uint8 ({BITS},)"),
    "numbers too few": (lambda t: t.update({"sh_rest|numbers": t["sh_rest|numbers"][:-1]}), "sh_rest|numbers is"),
    "numbers too many": (
        lambda t: t.update({"sh_rest|there": torch.zeros(BITS).byte()}),
        "expected torch.float32 (0,)",
    ),
    "another type": (lambda t: t.update({"sh_rest|numbers": t["sh_rest|numbers"].double()}), "is torch.float64"),
    "a part missing": (lambda t: t.pop("W1|numbers"), "W1|numbers is missing"),
    "a part of nothing": (lambda t: t.update({"sh_all|numbers": torch.zeros(1)}), "belongs to no parameter"),
    "there twice": (lambda t: t.update({"w2": torch.zeros(COUNT, 2)}), "w2 is stored twice"),
    "no means": (lambda t: t.pop("means"), "means"),
}


@pytest.mark.parametrize("lie", LIES)
def test_files_that_lie_are_refused(lie: str, file: Path, task: TaskSpec) -> None:
    change, expected = LIES[lie]
    with safe_open(str(file), framework="pt") as source:
        metadata, tensors = source.metadata(), {name: source.get_tensor(name) for name in source.keys()}
    change(tensors)
    save_file({name: t.contiguous() for name, t in tensors.items()}, str(file), metadata=metadata)
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load_model_checkpoint(file, task)
    assert expected in str(caught.value) and str(file) in str(caught.value)

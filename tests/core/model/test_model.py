"""A model's tensors: their count, their shapes, and values that are not numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from neuprim.core.errors import FormError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.geometry import GEOMETRY_SPECS, Geometry, quaternion_to_matrix
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext, ParameterSpec
from neuprim.tasks.static import SphericalHarmonics


def build(count: int = 4, neurons: int = 8, degree: int = 3, channels: int = 3) -> Primitives:
    means, colours = torch.arange(3.0 * count).reshape(count, 3), torch.rand(count, channels)
    context = InitContext(means, torch.full((count,), 0.2), colours, torch.Generator().manual_seed(0))
    return Primitives.initialise(CosineDensity(neurons), SphericalHarmonics(degree, channels), context)


def test_ninety_nine_parameters() -> None:
    model = build()
    specs = (GEOMETRY_SPECS, model.density.parameters(), model.colour.parameters())
    assert [sum(s.size for s in own) for own in specs] == [10, 41, 48] and model.parameters_per_primitive == 99
    assert sum(v.numel() for v in model.params.values()) == 99 * 4


def test_a_fresh_model_stands_on_its_points() -> None:
    model = build()
    assert torch.equal(model.params["means"], torch.arange(12.0).reshape(4, 3))
    assert torch.allclose(model.geometry.scales, torch.tensor(0.2))
    assert torch.equal(model.geometry.rotations, torch.eye(3).expand(4, 3, 3))
    assert all(v.dtype == torch.float32 and v.is_contiguous() for v in model.params.values())
    assert list(model.params) == [s.name for s in model.specs]


@pytest.mark.parametrize(
    ("init", "message"),
    [
        (lambda c: torch.zeros(c.count), r"init returned shape \(4,\); expected \(4, 1\)"),
        (lambda c: [0.0] * c.count, r"init returned type list; expected a torch tensor"),
    ],
)
def test_a_start_value_of_another_shape_names_field_and_parameter(init: Any, message: str) -> None:
    class Waves(CosineDensity):
        def parameters(self) -> list[ParameterSpec]:
            found = super().parameters()
            return [*found[:-1], replace(found[-1], init=init)]

    context = InitContext(torch.zeros(4, 3), torch.ones(4), torch.rand(4, 3), torch.Generator())
    with pytest.raises(FormError, match=rf"^density field Waves: parameters: b2: {message}"):
        Primitives.initialise(Waves(), SphericalHarmonics(0), context)
    context.means = torch.zeros(4, 2)
    with pytest.raises(FormError, match=r"^starting points: means: init returned shape \(4, 2\); expected \(4, 3\)"):
        Primitives.initialise(CosineDensity(), SphericalHarmonics(0), context)


def test_a_missing_tensor() -> None:
    model = build()
    params = {k: v for k, v in model.params.items() if k != "w2"}
    with pytest.raises(ValueError, match="do not match the specs"):
        Primitives(model.density, model.colour, params)


@pytest.mark.parametrize(
    ("name", "shape"),
    [("W1", (4, 7, 3)), ("b2", (4,)), ("quats", (4, 3)), ("sh_rest", (3, 15, 3)), ("log_scales", (4, 1))],
)
def test_a_wrong_shape_is_named(name: str, shape: tuple[int, ...]) -> None:
    model = build()
    with pytest.raises(ValueError, match=rf"{name} has shape .*expected") as caught:
        Primitives(model.density, model.colour, {**model.params, name: torch.zeros(shape)})
    assert str(shape) in str(caught.value)


def test_two_fields_may_not_share_a_name() -> None:
    class Clash(SphericalHarmonics):
        def parameters(self):  # type: ignore[no-untyped-def]
            return [*super().parameters(), CosineDensity(8).parameters()[0]]

    model = build()
    with pytest.raises(ValueError, match="do not match"):
        Primitives(model.density, Clash(), model.params)


def test_quaternions_are_wxyz_and_normalised_on_use() -> None:
    quarter_turn = torch.tensor([2.0, 0.0, 0.0, 2.0])  # about z
    R = quaternion_to_matrix(quarter_turn)
    assert torch.allclose(R @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]), atol=1e-6)
    random = torch.randn(50, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    R = quaternion_to_matrix(random)
    assert torch.allclose(R @ R.transpose(1, 2), torch.eye(3, dtype=torch.float64).expand(50, 3, 3))
    assert torch.allclose(torch.linalg.det(R), torch.ones(50, dtype=torch.float64))
    assert torch.allclose(quaternion_to_matrix(-3 * random), R)


def test_a_tie_of_axes_sends_the_gradient_to_the_first() -> None:
    log_scales = torch.zeros(1, 3, requires_grad=True)
    g = Geometry(torch.zeros(1, 3), log_scales, torch.tensor([[1.0, 0, 0, 0]]))
    g.length_scale.sum().backward()
    assert log_scales.grad is not None and log_scales.grad.tolist() == [[1.0, 0.0, 0.0]]

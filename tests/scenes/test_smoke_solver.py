"""The fluid solver against what fluids do: volume is kept, transport makes nothing new, hot gas rises."""

from __future__ import annotations

import math

import pytest
import torch

from neuprim.scenes.smoke.smoke_scenes import TurbulenceNoise
from neuprim.scenes.smoke.solver import (
    Faces,
    GasForcing,
    GasProperties,
    GasState,
    SmokeBox,
    advance_gas,
    advect_field,
    expansion_flow,
    flow_divergence,
    project_velocity,
    step_gas,
)

BOX = SmokeBox((17, 12, 23), 1 / 17)


def random_flow(box: SmokeBox, seed: int) -> Faces:
    generator = torch.Generator().manual_seed(seed)
    u, v, w = (torch.randn(component.shape, generator=generator) for component in box.air_at_rest())
    return u, v, w


def leak(velocity: Faces, box: SmokeBox) -> float:
    """Greatest flow_divergence, relative to the greatest speed per cell."""
    fastest = max(float(component.abs().max()) for component in velocity)
    return float(flow_divergence(velocity, box).abs().max()) * box.cell / max(fastest, 1e-30)


def blob(box: SmokeBox, at: tuple[float, float, float], radius: float) -> torch.Tensor:
    x, y, z = box.axes()
    return torch.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2 + (z - at[2]) ** 2) / radius**2)


def centroid(field: torch.Tensor, box: SmokeBox) -> list[float]:
    return [float((field * axis).sum() / field.sum()) for axis in box.axes()]


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_projection_leaves_no_divergence(scale: float) -> None:
    u, v, w = random_flow(BOX, 3)
    flow = project_velocity((u * scale, v * scale, w * scale), BOX)
    assert leak((u, v, w), BOX) > 1 and leak(flow, BOX) < 2e-6
    assert not bool(flow[2][:, :, 0].any()), "the ground is solid"


def test_projection_removes_gradients_and_keeps_solenoidal_flow() -> None:
    box = BOX
    pressure = torch.randn(box.shape, generator=torch.Generator().manual_seed(6))
    gradient = expansion_flow(pressure, box)  # any irrotational flow of this box is one of these
    assert max(float(c.abs().max()) for c in project_velocity(gradient, box)) < 1e-5 * max(
        float(c.abs().max()) for c in gradient
    )
    flow = project_velocity(random_flow(box, 7), box)
    both = project_velocity((flow[0] + gradient[0], flow[1] + gradient[1], flow[2] + gradient[2]), box)
    for a, b in zip(flow, both, strict=True):
        assert torch.allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("speed", [0.3, 2.7, 40.0])
def test_advection_makes_nothing_new(speed: float) -> None:
    box = BOX
    generator = torch.Generator().manual_seed(8)
    wind = speed * torch.randn(3, *box.shape, generator=generator)
    fields = torch.rand(2, *box.shape, generator=generator) * 3 - 1
    fields[1] = 0.7
    for _ in range(3):
        moved = advect_field(fields, wind, 0.05, box.cell)
        assert torch.allclose(moved[1], fields[1], rtol=1e-6)
        assert moved[0].min() >= fields[0].min() and moved[0].max() <= fields[0].max()
        fields = moved


def test_advection_by_whole_cells_is_exact() -> None:
    field = torch.rand(1, 12, 10, 11, generator=torch.Generator().manual_seed(9))
    wind = torch.tensor([2.0, -1.0, 3.0]).reshape(3, 1, 1, 1).expand(3, 12, 10, 11)
    moved = advect_field(field, wind, 1.0, 1.0)
    assert torch.allclose(moved[0, 2:-2, 1:-1, 3:-3], field[0, :-4, 2:, :-6], atol=1e-5)  # away from the ends


def test_rotation_brings_a_blob_back() -> None:
    """One turn in 60 steps of up to 2.5 cells; the correction keeps what plain interpolation would lose."""
    box = SmokeBox((40, 40, 16), 1 / 40)
    x, y, z = box.axes()
    wind = torch.stack(torch.broadcast_tensors(-2 * math.pi * y, 2 * math.pi * x, 0 * z + 0 * x))
    start = blob(box, (0.22, 0.0, 0.2), 0.1)[None]
    field = start
    for _ in range(15):
        field = advect_field(field, wind, 1 / 60, box.cell)
    assert centroid(field[0], box)[:2] == pytest.approx(
        [0.0, 0.22], abs=0.25 * box.cell
    )  # a quarter turn, anticlockwise
    for _ in range(45):
        field = advect_field(field, wind, 1 / 60, box.cell)
    assert centroid(field[0], box) == pytest.approx(centroid(start[0], box), abs=0.25 * box.cell)
    assert field.max() > 0.75
    assert float((field - start).abs().mean() / start.mean()) < 0.25


def test_hot_gas_rises_and_soot_falls() -> None:
    box = SmokeBox((20, 20, 30), 1 / 20)
    hot = blob(box, (0.0, 0.0, 0.7), 0.15)
    nothing = torch.zeros(box.shape)
    settings = GasProperties(buoyancy=3.0, weight=3.0, confinement=0.0, cooling=0.0, dissipation=0.0)
    for density, temperature, sign in ((nothing, hot, 1), (hot, nothing, -1)):
        state = GasState(box.air_at_rest(), density, temperature, nothing)
        for _ in range(8):
            state = advance_gas(state, settings, box, GasForcing(), 1 / 30)
        centre = centroid(state.temperature + state.density, box)
        assert sign * (centre[2] - 0.7) > 0.02
        assert centre[:2] == pytest.approx([0, 0], abs=1e-3)


def test_fuel_burns_to_heat_and_soot() -> None:
    box = BOX
    full, nothing = torch.ones(box.shape), torch.zeros(box.shape)
    settings = GasProperties(
        buoyancy=0.0, weight=0.0, confinement=0.0, cooling=0.0, dissipation=0.0, burn=2.0, heat=0.8, soot=0.5
    )
    state = GasState(box.air_at_rest(), nothing, nothing, full)
    for _ in range(50):
        state = step_gas(state, settings, box, GasForcing(), 0.01)
    assert float(state.fuel.max()) < 1e-5  # 1 / burn = 0.5 s
    assert torch.allclose(state.temperature, 0.8 * full, atol=1e-4)
    assert torch.allclose(state.density, 0.5 * full, atol=0.02)


def test_noise_is_a_function_of_seed_place_and_time() -> None:
    axes = SmokeBox((20, 20, 20), 1 / 20).axes()
    first = TurbulenceNoise(1).field(0, axes, 7.0, 3.0, 0.4)
    assert torch.equal(first, TurbulenceNoise(1).field(0, axes, 7.0, 3.0, 0.4))
    for other in (
        TurbulenceNoise(2).field(0, axes, 7.0, 3.0, 0.4),
        TurbulenceNoise(1).field(1, axes, 7.0, 3.0, 0.4),
        TurbulenceNoise(1).field(0, axes, 7.0, 3.0, 0.9),
    ):
        assert float((first - other).abs().mean()) > 0.1
    near = TurbulenceNoise(1).field(0, axes, 7.0, 3.0, 0.4001)
    assert float((first - near).abs().max()) < 0.01
    part = TurbulenceNoise(1).field(0, (axes[0][3:9], axes[1], axes[2][:, :, 5:]), 7.0, 3.0, 0.4)
    assert torch.allclose(part, first[3:9, :, 5:], atol=1e-5)
    assert 0.2 < float(first.std()) < 1.0

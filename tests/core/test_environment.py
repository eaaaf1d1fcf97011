"""Images of the light all around: directions, energy, and the few lights that stand for them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from torch import Tensor

from neuprim.core.environment import Environment, read_environment
from neuprim.core.errors import DataError


def dark(height: int = 8) -> Tensor:
    return torch.zeros(height, 2 * height, 3)


def wild(height: int, seed: int = 0) -> Tensor:
    """Random radiance over six orders of magnitude, a third of it black."""
    g = torch.Generator().manual_seed(seed)
    values = 10 ** (6 * torch.rand(height, 2 * height, 3, generator=g) - 3)
    return values * (torch.rand(height, 2 * height, 1, generator=g) > 0.33)


def direction(row: int, column: int, height: int) -> list[float]:
    """Of a texel with up = z: the middle column is +x, right of it towards -y."""
    polar, azimuth = math.pi * (row + 0.5) / height, 2 * math.pi * (0.5 - (column + 0.5) / (2 * height))
    return [math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)]


# ---------------------------------------------------------------- where light comes from


@pytest.mark.parametrize(
    ("row", "column", "expected"),
    [
        (64, 128, (1, 0, 0)),
        (64, 192, (0, -1, 0)),
        (64, 64, (0, 1, 0)),
        (64, 0, (-1, 0, 0)),
        (0, 17, (0, 0, 1)),
        (127, 200, (0, 0, -1)),
    ],
)
def test_which_texel_is_which_direction(row: int, column: int, expected: tuple[int, int, int]) -> None:
    image = dark(128)
    image[row, column] = 1.0
    (found,) = Environment(image).directional_lights(5).directions
    assert found.tolist() == pytest.approx(expected, abs=0.03)
    assert found.tolist() == pytest.approx(direction(row, column, 128), abs=1e-12)


# ---------------------------------------------------------------- energy


@pytest.mark.parametrize("count", [1, 2, 3, 7, 64, 500])
@pytest.mark.parametrize("height", [3, 20, 530])
def test_energy_is_kept_for_any_number_of_lights(height: int, count: int) -> None:
    image = wild(height)
    environment = Environment(image)
    lights = environment.directional_lights(count)
    polar = (torch.arange(height, dtype=torch.float64) * math.pi / height).cos()
    solid = (polar - torch.cat([polar[1:], -torch.ones(1, dtype=torch.float64)])) * math.pi / height
    expected = (image.double() * solid[:, None, None]).sum((0, 1))
    assert torch.allclose(lights.irradiance.sum(0), expected, rtol=1e-12)
    assert torch.allclose(environment.irradiance, expected, rtol=1e-12)
    shining = int((image.amax(-1) > 0).sum())
    assert len(lights.directions) == min(count, shining)
    assert torch.allclose(lights.directions.norm(dim=1), torch.ones(len(lights.directions), dtype=torch.float64))
    assert bool((lights.irradiance >= 0).all()) and bool((lights.irradiance.sum(1) > 0).all())


def test_many_lights_light_a_surface_like_the_whole() -> None:
    """Irradiance under a half-dark random environment, of surfaces facing every way."""
    image = wild(32, seed=4).clamp_max(30.0)
    every, few = Environment(image).directional_lights(4096), Environment(image).directional_lights(256)
    normals = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64), dim=1
    )
    exact, found = ((normals @ b.directions.T).clamp_min(0) @ b.irradiance for b in (every, few))
    assert len(every.directions) > 1000
    assert float((found / exact - 1).abs().max()) < 0.03


def test_a_sun_gets_a_light_of_its_own() -> None:
    image = torch.full((128, 256, 3), 0.5)
    image[30:32, 100:102] = 5e4
    lights = Environment(image).directional_lights(32)
    sun = torch.tensor(direction(30, 100, 128), dtype=torch.float64)
    brightest = int(lights.irradiance.sum(1).argmax())
    assert float(lights.directions[brightest] @ sun) > math.cos(math.radians(2.0))
    assert len(lights.directions) == 32


# ---------------------------------------------------------------- files


@pytest.mark.parametrize(("value", "message"), [(np.nan, "nan"), (np.inf, "inf"), (-np.inf, "-inf"), (-0.5, r"-0\.5")])
def test_impossible_radiance(tmp_path: Path, value: float, message: str) -> None:
    image = dark(8)
    image[3, 7, 1] = value
    channels = {name: image[..., i].contiguous().numpy() for i, name in enumerate("RGB")}
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(tmp_path / "bad.exr"))  # the project's own writer refuses
    with pytest.raises(DataError, match=rf"bad\.exr: .*{message} at row 3, column 7, channel 1; expected"):
        read_environment(tmp_path / "bad.exr")

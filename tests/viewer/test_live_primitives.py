"""Primitives to look at and to choose."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neuprim.core.channels import Channels
from neuprim.core.errors import ConfigError
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.density import TimeDensity
from neuprim.tasks.static.fields import SphericalHarmonics
from neuprim.viewer.frame import Look
from neuprim.viewer.primitives import described, ellipsoid_of, ellipsoids_of, strongest
from tests.page_models import camera_at, random_model

RGB = Channels(("R", "G", "B"), "srgb", None, "static")
SETTINGS = RenderSettings(backend="reference")


def weights(model: Primitives, look: Look, x: float, y: float) -> torch.Tensor:
    """(N,) what each primitive contributes to the image at a place of it, by the renderer's own sums."""
    camera = look.camera
    one = type(camera)(camera.viewmat, camera.fx, camera.fy, camera.cx - x + 0.5, camera.cy - y + 0.5, 1, 1)
    for value in model.params.values():
        value.requires_grad_()
    output = render(model, one, look.conditions, SETTINGS)
    tally = output.watch(torch.ones(1, 1))
    output.rgb.sum().backward()
    return tally.of_all(model.count)[0].detach()


@pytest.mark.parametrize("timed", [False, True])
def test_the_primitive_under_the_mouse_is_the_one_that_contributes_most(timed: bool) -> None:
    fields = (
        (TimeDensity(2, "window+motion", edge=2), TimeHarmonics(1))
        if timed
        else (CosineDensity(2, edge=2), SphericalHarmonics(1))
    )
    model = random_model(*fields, count=60, seed=2)
    look = Look(camera_at((0.3, -3.0, 1.0)), {"time": torch.tensor(0.3)} if timed else {})
    camera, found = look.camera, []
    for x, y in [(20.5, 18.5), (35.5, 28.5), (40.5, 30.5), (52.5, 33.5), (36.5, 20.5), (1.5, 1.5)]:
        ray = torch.tensor([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0], dtype=torch.float64)
        expected = weights(model, look, x, y)
        row = strongest(model, look, 3.0 * (camera.viewmat[:3, :3].T @ ray).numpy(), SETTINGS)
        assert row == (int(expected.argmax()) if float(expected.max()) > 0 else None)
        found.append(row)
    assert len(set(found)) > 3 and None in found


def test_ellipsoids_are_where_the_frame_has_them() -> None:
    model = random_model(TimeDensity(2, "window+motion", edge=2), TimeHarmonics(1), count=40)
    look = Look(camera_at((0.3, -3.0, 1.0)), {"time": torch.tensor(0.3)})
    active = model.active(look.conditions)
    every = ellipsoids_of(model, look, RGB, 1000)
    assert np.array_equal(every.rows, active.rows.numpy()) and 0 < len(every.rows) < 40  # type: ignore[union-attr]
    assert np.allclose(every.positions, active.geometry.means) and np.allclose(every.scales, active.geometry.scales)
    assert (
        np.allclose(np.linalg.norm(every.wxyz, axis=1), 1, atol=1e-6)
        and every.colours.dtype == np.uint8
        and every.colours.std() > 5
    )
    few = ellipsoids_of(model, look, RGB, 5)
    assert len(few.rows) == 5 and set(few.rows) < set(every.rows)
    one = ellipsoid_of(model, look, int(every.rows[3]))
    assert one is not None and np.array_equal(one.positions[0], every.positions[3])
    gone = next(i for i in range(40) if i not in every.rows)
    assert ellipsoid_of(model, look, gone) is None
    with pytest.raises(ConfigError, match="primitive 40: the model has 40 primitives, 0 to 39"):
        ellipsoid_of(model, look, 40)


def test_parameters_in_words() -> None:
    model = random_model(CosineDensity(2, edge=2), SphericalHarmonics(3), count=3)
    lines = described(model, 1).splitlines()
    assert lines[0] == "primitive 1 of 3" and lines[1].startswith("semi-axes ")
    assert [line.partition(":")[0] for line in lines[2:]] == list(model.params)
    assert any(line.endswith("(45 numbers)") for line in lines)
    assert f"means: {' '.join(f'{x:.4g}' for x in model.params['means'][1].tolist())}" in lines

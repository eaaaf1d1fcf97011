"""Pages draw what the float64 reference draws: every field, near and far, cut and inside. Read back from headless
Chromium as numbers."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuprim.core.cameras import Camera
from neuprim.core.io.images import to_uint8
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import render
from neuprim.core.settings import RenderSettings
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.scattering import ScatteringHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.relight.colour import LightHarmonics, LightNetwork
from neuprim.tasks.relight.surface import SurfaceColour
from neuprim.tasks.static import SphericalHarmonics, SphericalLobes
from neuprim.webpage import PageView
from tests.browsers import Tab, open_tab
from tests.page_models import LIGHT, SETTINGS, camera_at, page_of, random_model

ERROR = 1e-5
EYES = ((0.3, -3.0, 1.0), (2.0, 2.0, -1.5), (-0.4, 0.2, 0.1))
"""Two from outside, one among the primitives."""


Conditions = dict[str, torch.Tensor]


def error(
    tab: Tab, model: Primitives, camera: Camera, conditions: Conditions, settings: RenderSettings = SETTINGS
) -> float:
    """Largest difference of colours and transmittances from the reference backend."""
    with torch.no_grad():
        truth = render(model, camera, conditions, replace(settings, backend="reference"))
    found = tab.numbers(camera, conditions)
    assert float(truth.alpha.max()) > 0.3
    colour, alpha = found[..., :3] - truth.rgb.double().numpy(), 1 - found[..., 3] - truth.alpha.double().numpy()
    return float(max(np.abs(colour).max(), np.abs(alpha).max()))


@pytest.mark.parametrize(("neurons", "edge"), [(0, 1), (2, 0), (5, 2), (8, 1)])
def test_static_models(neurons: int, edge: int, chromium: Any, tmp_path: Path) -> None:
    degree = {0: 0, 2: 1, 5: 2, 8: 3}[neurons]
    model = random_model(CosineDensity(neurons, edge=edge, gain=edge > 0), SphericalHarmonics(degree))
    page_of(model, tmp_path / "p.html")
    with open_tab(chromium, tmp_path / "p.html") as tab:
        for eye in EYES:
            assert error(tab, model, camera_at(eye), {}) < ERROR
        assert tab.faults == []


@pytest.mark.parametrize("lobes", [0, 1, 3])
def test_colours_of_lobes(lobes: int, chromium: Any, tmp_path: Path) -> None:
    """Some have no axis, the shortest that has one, or a sharpness beyond the limit."""
    model = random_model(CosineDensity(2, edge=2), SphericalLobes(lobes))
    if lobes:
        model.params["lobe_axis"][:5] = 0
        model.params["lobe_axis"][5:10] *= 1e-20
        model.params["lobe_log_sharpness"][10:20] = torch.linspace(-50, 50, 10)[:, None]
        model.params["lobe_amplitude"] *= 3
    page_of(model, tmp_path / "p.html")
    with open_tab(chromium, tmp_path / "p.html") as tab:
        for eye in EYES:
            assert error(tab, model, camera_at(eye), {}) < ERROR
        assert tab.faults == []


@pytest.mark.parametrize("edge", [0, 1, 2])
def test_chords_that_the_near_plane_cuts(edge: int, chromium: Any, tmp_path: Path) -> None:
    settings = replace(SETTINGS, near=2.6)
    model = random_model(CosineDensity(4, edge=edge), SphericalHarmonics(1), seed=1)
    page_of(model, tmp_path / "p.html", settings=settings)
    with open_tab(chromium, tmp_path / "p.html") as tab:
        assert error(tab, model, camera_at((0.3, -3.0, 1.0)), {}, settings) < ERROR


def test_from_very_far(chromium: Any, tmp_path: Path) -> None:
    """At 1e5 times the distance, with the lens to match."""
    model = random_model(CosineDensity(4, edge=2), SphericalHarmonics(2), seed=2)
    page_of(model, tmp_path / "p.html")
    with open_tab(chromium, tmp_path / "p.html") as tab:
        assert error(tab, model, camera_at((3e4, -3e5, 1e5), focal=8e6), {}) < ERROR


@pytest.mark.parametrize(
    ("time", "colour"),
    [
        ("none", TimeHarmonics(0, powers=0, waves=0)),
        ("window+motion", TimeHarmonics(1, powers=2, waves=0)),
        ("phase+offset", TimeHarmonics(0, powers=0, waves=3, frequencies="printed")),
        ("phase+offset+window+motion", TimeHarmonics(3)),
    ],
)
def test_dynamic_models(time: str, colour: TimeHarmonics, chromium: Any, tmp_path: Path) -> None:
    model = random_model(TimeDensity(3, time, edge=2, gain=True), colour, count=90)
    xi = torch.tensor(0.3)
    page_of(model, tmp_path / "p.html", {"time": xi})
    with open_tab(chromium, tmp_path / "p.html") as tab:
        for moment in (0.0, 0.37, 1.0):
            assert error(tab, model, camera_at(EYES[0]), {"time": torch.tensor(moment, dtype=torch.float64)}) < ERROR
        assert tab.faults == []


@pytest.mark.parametrize("count", [0, 60])
def test_a_start_at_which_nothing_is_active(count: int, chromium: Any, tmp_path: Path) -> None:
    """The page is empty there, and right at other times; empty throughout without primitives."""
    model = random_model(
        TimeDensity(3, "window+motion", edge=2, gain=True), TimeHarmonics(1, powers=2, waves=0), count=count
    )
    model.params["log_window"].fill_(math.log(0.05))
    model.params["window_center"].fill_(0.8)
    for level, views in ((0, []), (1, [PageView("first", camera_at(EYES[0]), {"time": torch.tensor(0.1)})])):
        held = page_of(model, tmp_path / "p.html", {"time": torch.tensor(0.1)}, level=level, views=views).model
        with open_tab(chromium, tmp_path / "p.html") as tab:
            assert f"0 of {count} primitives" in tab.page.inner_text("#info")
            for moment in (0.1, 0.8, 0.0):
                time = {"time": torch.tensor(moment, dtype=torch.float64)}
                found = tab.numbers(camera_at(EYES[0]), time)
                if moment == 0.8 and count:
                    assert error(tab, held, camera_at(EYES[0]), time) < ERROR
                else:
                    assert (found[..., :3] == 0).all() and (found[..., 3] == 1).all()
            assert tab.faults == [] and tab.page.inner_text("#fault") == ""


@pytest.mark.parametrize("time", ["phase", "window+motion"])
def test_models_joined_from_chunks(time: str, chromium: Any, tmp_path: Path) -> None:
    """Before, in and after the seams."""
    seams = ((0.25, 0.375), (0.625, 0.75))
    model = random_model(
        TimeDensity(3, time, edge=2, gain=True, seams=seams), TimeHarmonics(0, powers=0, waves=0), count=90
    )
    model.params["chunk"] = torch.arange(90.0)[:, None] % 3
    page_of(model, tmp_path / "p.html", {"time": torch.tensor(0.3)})
    with open_tab(chromium, tmp_path / "p.html") as tab:
        for moment in (0.1, 0.3, 0.5, 0.75, 1.0):
            assert error(tab, model, camera_at(EYES[0]), {"time": torch.tensor(moment, dtype=torch.float64)}) < ERROR
        assert tab.faults == []


def assert_equal_under_lights(model: Primitives, bound: float, chromium: Any, tmp_path: Path) -> None:
    page_of(model, tmp_path / "p.html", LIGHT)
    with open_tab(chromium, tmp_path / "p.html") as tab:
        for light in (LIGHT["light"], torch.tensor([-1.0, 0.5, 3.0]), torch.tensor([0.0, 0.0, -0.3])):
            assert error(tab, model, camera_at(EYES[0]), {**LIGHT, "light": light.double()}) < bound
        assert tab.faults == []


@pytest.mark.parametrize(
    ("hidden", "visibility", "falloff"),
    [(0, "none", True), (16, "none", True), (3, "primitive", False), (5, "pixel", True)],
)
def test_relit_models(hidden: int, visibility: str, falloff: bool, chromium: Any, tmp_path: Path) -> None:
    """The depth images out of the light are drawn by the page too. What lies near their shadows' edges amplifies their
    rounding."""
    form = "multiplicative" if falloff else "additive"
    colour = LightNetwork(hidden, form=form, visibility=visibility, falloff=falloff)
    model, bound = random_model(CosineDensity(2, edge=2), colour, seed=3), ERROR if visibility == "none" else 5 * ERROR
    assert_equal_under_lights(model, bound, chromium, tmp_path)


@pytest.mark.parametrize(("octaves", "anisotropy"), [(1, 0.0), (3, 0.0), (2, 0.5)])
def test_smoke_under_a_light(octaves: int, anisotropy: float, chromium: Any, tmp_path: Path) -> None:
    """Light passes sixteen depth images, each with its own rounding."""
    colour = ScatteringHarmonics(1, powers=1, waves=1, typical=2.0, octaves=octaves, share=0.4, anisotropy=anisotropy)
    model = random_model(TimeDensity(0, "window+motion", edge=2, gain=True), colour, count=80, seed=6)
    time = torch.tensor(0.4, dtype=torch.float64)
    near, far = torch.tensor([0.3, -0.2, 0.1]), torch.tensor([4e3, -3e3, 8e3])
    strength = torch.tensor([2.0, 1.0, 4.0])
    page_of(model, tmp_path / "p.html", {"time": time, "light": far, "light_intensity": strength})
    with open_tab(chromium, tmp_path / "p.html") as tab:
        for light in (far, near):
            conditions = {"time": time, "light": light, "light_intensity": strength}
            # seen from 1,000 radii away, float32 depths err by 6e-5 radii, where a slab absorbs over 0.12 radii
            bound = 60 * ERROR if light is far else ERROR
            assert error(tab, model, camera_at(EYES[0]), conditions) < bound
        assert tab.faults == []


@pytest.mark.parametrize(
    ("lobes", "indirect", "visibility", "falloff"),
    [(0, 0, "none", True), (8, 4, "none", False), (2, 4, "primitive", True), (1, 1, "primitive", False)],
)
def test_lit_surfaces(lobes: int, indirect: int, visibility: str, falloff: bool, chromium: Any, tmp_path: Path) -> None:
    colour = SurfaceColour(lobes, indirect, visibility=visibility, falloff=falloff)
    model, bound = random_model(CosineDensity(2, edge=2), colour, seed=7), ERROR if visibility == "none" else 5 * ERROR
    assert_equal_under_lights(model, bound, chromium, tmp_path)


@pytest.mark.parametrize("degree", [0, 5, 8])
def test_harmonics_of_the_light(degree: int, chromium: Any, tmp_path: Path) -> None:
    model = random_model(CosineDensity(2), LightHarmonics(degree, falloff=True), seed=4)
    page_of(model, tmp_path / "p.html", LIGHT)
    with open_tab(chromium, tmp_path / "p.html") as tab:
        assert error(tab, model, camera_at(EYES[0]), LIGHT) < ERROR


def test_cuts_are_the_settings(chromium: Any, tmp_path: Path) -> None:
    """Pairs fainter than alpha_min are left out; single ones may fall on the other side of it."""
    settings = replace(SETTINGS, alpha_min=0.05, alpha_max=0.6)
    model = random_model(CosineDensity(2, edge=1), SphericalHarmonics(1), seed=5)
    page_of(model, tmp_path / "p.html", settings=settings)
    with open_tab(chromium, tmp_path / "p.html") as tab:
        camera = camera_at(EYES[0])
        with torch.no_grad():
            truth = render(model, camera, {}, replace(settings, backend="reference")).rgb.double().numpy()
            uncut = render(model, camera, {}, replace(SETTINGS, backend="reference")).rgb.double().numpy()
        wrong = np.abs(tab.numbers(camera)[..., :3] - truth)
        assert np.quantile(wrong, 0.999) < ERROR and np.abs(uncut - truth).max() > 0.01


def test_depth_and_density_slices(chromium: Any, tmp_path: Path) -> None:
    model = random_model(CosineDensity(3, edge=1, gain=True), SphericalHarmonics(0), seed=6)
    page_of(model, tmp_path / "p.html")
    camera, plane = camera_at(EYES[0]), 3.0
    with torch.no_grad():
        truth = render(model, camera, {}, replace(SETTINGS, backend="reference", depth=True))
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
        view = camera.viewmat.double()
        points = ((plane * torch.from_numpy(rays) - view[:3, 3]) @ view[:3, :3]).reshape(-1, 3)
        sigma = torch.zeros(len(points), dtype=torch.float64)
        shape = model.geometry
        means, turns, scales = shape.means.double(), shape.rotations.double(), shape.scales.double()
        for i in range(model.count):
            inside = (((points - means[i]) @ turns[i] / scales[i]).square().sum(-1) < 1).nonzero()[:, 0]
            sigma[inside] += model.active({}, torch.float64).sigma(torch.full((len(inside),), i), points[inside])
    assert truth.depth is not None
    with open_tab(chromium, tmp_path / "p.html") as tab:
        found = tab.numbers(camera, mode="DEPTH")
        hit = truth.alpha.numpy() > 0.05
        depth = found[..., 0] / np.maximum(1 - found[..., 3], 1e-12)
        assert np.abs(depth - truth.depth.double().numpy())[hit].max() < 1e-4
        slices = tab.numbers(camera, mode="SLICE", plane=plane)[..., 0].reshape(-1)
        assert sigma.max() > 1 and np.abs(slices - sigma.numpy()).max() < 1e-4 * float(sigma.max())


def test_what_is_seen_is_the_display_s(chromium: Any, tmp_path: Path) -> None:
    """Canvas bytes: over the background, through the sRGB curve where values are linear."""
    model = random_model(CosineDensity(2, edge=2), SphericalHarmonics(1), seed=7)
    background = torch.tensor([0.2, 0.5, 0.8])
    camera = camera_at(EYES[0])
    with torch.no_grad():
        truth = render(model, camera, {}, replace(SETTINGS, backend="reference"), background).rgb
    for linear in (False, True):
        page_of(model, tmp_path / "p.html", background=background.tolist(), linear=linear)
        encoded = (
            torch.where(truth > 0.0031308, 1.055 * truth.clamp_min(1e-9) ** (1 / 2.4) - 0.055, 12.92 * truth)
            if linear
            else truth
        )
        with open_tab(chromium, tmp_path / "p.html") as tab:
            wrong = np.abs(tab.shown(camera).astype(int) - to_uint8(encoded).numpy().astype(int))
            assert wrong.max() <= 1 and (wrong > 0).mean() < 0.01


@pytest.mark.parametrize("level", [0, 1, 5])
def test_the_page_has_the_numbers_that_python_says(level: int, chromium: Any, tmp_path: Path) -> None:
    model = random_model(CosineDensity(3, edge=2, gain=True), SphericalHarmonics(2), seed=8)
    page = page_of(model, tmp_path / "p.html", level=level)
    with open_tab(chromium, tmp_path / "p.html") as tab:
        assert error(tab, page.model, camera_at(EYES[0]), {}) < ERROR
    if level == 0:
        assert all(torch.equal(page.model.params[name], value) for name, value in model.params.items())

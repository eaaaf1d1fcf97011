"""What a page is made of: numbers that come back, what it refuses, no word of strangers that could run. Without a
browser."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.core.errors import ConfigError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.edge import edge_profile
from neuprim.core.model.gaussian import GaussianDensity
from neuprim.core.render import light as light_rendering
from neuprim.tasks.relight.colour import LightNetwork
from neuprim.tasks.relight.surface import SurfaceColour
from neuprim.tasks.relight.surface_constants import GATE, SHORTEST, WRAP
from neuprim.tasks.static import SphericalHarmonics
from neuprim.webpage import PageView
from neuprim.webpage.model_page import pack_webpage_model, shader_constants, stored_up_axis
from tests.page_models import LIGHT, SETTINGS, camera_at, header_of, page_of, random_model


def test_what_a_level_keeps(tmp_path: Path) -> None:
    """Fewer bytes and larger errors from level to level; level 0 keeps every bit."""
    model = random_model(CosineDensity(4, edge=2, gain=True), SphericalHarmonics(3), count=400)
    sizes, errors = [], []
    for level in range(6):
        packed = pack_webpage_model(model, level)
        sizes.append(len(packed.data))
        order = torch.cdist(packed.model.params["means"], model.params["means"]).argmin(1)  # the file's own order
        errors.append(float((packed.model.params["sh_rest"] - model.params["sh_rest"][order]).abs().max()))
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > 1.5 * sizes[1]
    assert errors == sorted(errors) and errors[0] == 0.0 < errors[1] < 0.01
    with pytest.raises(ConfigError, match="--level 6: expected one of 1, 2, 3, 4, 5"):
        pack_webpage_model(model, 6)


@pytest.mark.parametrize("edge", [0, 1, 2])
def test_polynomials_are_good_to_float32(edge: int) -> None:
    found, v = shader_constants(edge), torch.linspace(-0.5, 0.5, 1001, dtype=torch.float64)
    truths = {
        "cos": (2 * torch.pi * v).cos(),
        "sinc": torch.special.sinc(2 * v),
        "edge": edge_profile(2 * torch.pi * v, edge),
    }
    for name, truth in truths.items():
        value = torch.zeros_like(v)
        for coefficient in found[name]:
            value = value * v.square() + coefficient
        assert float((value - truth).abs().max()) < 1e-9, name  # a hundredth of what float32 rounds
    assert sum(found["weights"]) == pytest.approx(1.0)


def test_a_field_without_a_script_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="density field GaussianDensity has no JavaScript version"):
        page_of(random_model(GaussianDensity(), SphericalHarmonics(0)), tmp_path / "p.html")


@pytest.mark.parametrize("text", ["() => 1</script><script>alert(1)", "() => '<!--'", 7])
def test_a_script_that_would_end_its_element_is_refused(
    text: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CosineDensity, "script", lambda self: text)
    with pytest.raises(ConfigError, match=r"density field CosineDensity: script\(\) must return JavaScript text"):
        page_of(random_model(CosineDensity(1), SphericalHarmonics(0)), tmp_path / "p.html")


def test_names_do_not_become_parts_of_the_page(tmp_path: Path) -> None:
    """Neither by HTML nor by the marks that parts are put in place of."""
    hostile = "</script><script>alert(1)</script>@numbers@"
    views = [PageView(hostile, camera_at((0.3, -3.0, 1.0)), {})]
    model = random_model(CosineDensity(1), SphericalHarmonics(0))
    page = page_of(model, tmp_path / "p.html", name=hostile, subtitle=hostile, views=views)
    plain = page_of(model, tmp_path / "q.html")
    assert page.text.count("<script") == plain.text.count("<script") == 4
    assert page.text.count("</script>") == plain.text.count("</script>")
    assert header_of(page.text)["views"][0]["name"] == hostile
    assert "@numbers@" in header_of(page.text)["name"]


def test_the_policy_lets_nothing_else_run_or_load(tmp_path: Path) -> None:
    text = page_of(random_model(CosineDensity(1), SphericalHarmonics(0)), tmp_path / "p.html").text
    policy = re.search(r'Content-Security-Policy" content="(.*?)"', text)
    assert policy and policy[1].startswith("default-src 'none'; script-src 'nonce-")
    assert "unsafe-inline" not in policy[1].split("style-src")[0]
    assert "http:" not in text and "https:" not in text
    assert not re.search(r"<(script|link|img|iframe)[^>]*\s(src|href)=[\"'](?!data:|\")", text)


def test_pages_are_the_same_bytes_again(tmp_path: Path) -> None:
    model = random_model(CosineDensity(2), SphericalHarmonics(1))
    assert page_of(model, tmp_path / "p.html", level=2).text == page_of(model, tmp_path / "q.html", level=2).text


def test_a_damaged_header_has_an_upward_axis_all_the_same() -> None:
    for up in ([0, 0, 0], [1, None, 2], [1, 2], "z", [float("nan"), 0, 0]):
        assert stored_up_axis({"data": {"up": up}}) == (0.0, 0.0, 1.0)
    assert stored_up_axis({"data": {"up": [0, -1, 0]}}) == (0.0, -1.0, 0.0) and stored_up_axis({}) == (0.0, 0.0, 1.0)


def test_the_controls_of_conditions(tmp_path: Path) -> None:
    header = header_of(page_of(random_model(CosineDensity(1), LightNetwork(2)), tmp_path / "p.html", LIGHT).text)
    light, intensity = header["conditions"]
    assert light["place"] and not intensity["place"] and light["value"] == pytest.approx([1.5, -2.0, 2.5])
    assert header["renderer"] == {"alpha_min": SETTINGS.alpha_min, "alpha_max": SETTINGS.alpha_max}


def test_the_script_s_shadows_are_those_of_the_model() -> None:
    """Constants that stand in both languages."""
    assert (light_rendering.FADE, light_rendering.EXTENTS, light_rendering.PIXEL_FADE) == (1 / 50, 1.5, 1 / 10)
    for text in (LightNetwork(2).script(), SurfaceColour().script()):
        for name, value in (("size", light_rendering.SIZE), ("layers", light_rendering.LAYERS)):
            assert f"{name}: {value}" in text
    assert 'fade: visibility === "pixel" ? 1 / 10 : 1 / 50, extents: 1.5 ' in LightNetwork(2).script()
    assert "fade: 1 / 50, extents: 1.5 " in SurfaceColour().script()
    assert f"wrap = {WRAP}, gate = {GATE:g}, shortest = 1e-6" in text and SHORTEST == 1e-6

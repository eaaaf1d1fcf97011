"""Deep images: samples that composite to the image, in front of and behind other things as the ray integral says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels
from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.runs.color_space import load_output_color_space
from neuprim.runs.deep_images import DeepImage, draw_deep_image
from neuprim.runs.measure import render_light_sum
from neuprim.runs.render_config import RenderConfig, RunExrLayers
from neuprim.runs.shutter import Shutter
from neuprim.tasks.dynamic import TASK as DYNAMIC
from neuprim.tasks.relight.colour import LightNetwork
from tests import scenes
from tests.lit_models import light
from tests.lit_models import model as lit
from tests.pretend_card import CARD, pretended
from tests.timed_models import model as timed

VIEW = View("a view", scenes.camera(40, 32, distance=2.6), {"time": torch.tensor(0.4)})
EXACT = RenderSettings(backend="reference", transmittance_min=0.0)


def volume(count: int = 60) -> Primitives:
    return timed("window", count=count, dtype=torch.float32)


def composited(image: DeepImage) -> Tensor:
    """The samples of each pixel over each other, in order: (H, W, C + 1) light and alpha."""
    height, width = image.counts.shape
    found = torch.zeros(height * width, image.rgb.shape[1] + 1, dtype=torch.float64)
    pixels = torch.repeat_interleave(torch.arange(height * width), image.counts.flatten())
    for pixel, rgb, alpha in zip(pixels.tolist(), image.rgb.double(), image.alpha.double(), strict=True):
        found[pixel] += (1 - found[pixel, -1]) * torch.cat([rgb, alpha[None]])
    return found.reshape(height, width, -1)


def front_transmittance(image: DeepImage, depth: float) -> Tensor:
    """(H, W) transmittance up to a depth, as OpenEXR's rules for samples with a length give it."""
    height, width = image.counts.shape
    pixels = torch.repeat_interleave(torch.arange(height * width), image.counts.flatten())
    front, back = image.front.double(), image.back.double()
    part = ((depth - front) / (back - front)).clamp(0, 1)
    logs = torch.zeros(height * width, dtype=torch.float64)
    return logs.index_add(0, pixels, part * torch.log1p(-image.alpha.double())).exp().reshape(height, width)


@pytest.mark.parametrize("most", [1, 5, 1000])
def test_composited_samples_are_the_image(most: int) -> None:
    model = volume()
    image = draw_deep_image(model, VIEW, EXACT, (), most)
    expected = render(model, VIEW.camera, VIEW.conditions, EXACT)
    found = composited(image)
    assert (found[..., :3] - expected.rgb).abs().max() < 1e-6 and (found[..., 3] - expected.alpha).abs().max() < 1e-6
    assert int(image.counts.max()) <= most and (image.counts > 0).eq(expected.alpha > 0).all()
    assert most == 1 or int(image.counts.max()) > min(most, 15) // 2
    assert (image.alpha > 0).all() and (image.back >= image.front).all()


def test_samples_of_a_pixel_do_not_overlap_even_at_equal_depths() -> None:
    model = volume()
    with torch.no_grad():
        model.params["means"][:, :] = model.params["means"][:1]
        model.params["means"][:30, 0] += torch.linspace(0, 0.3, 30)
    image = draw_deep_image(model, VIEW, EXACT, (), 8)
    pixels = torch.repeat_interleave(torch.arange(image.counts.numel()), image.counts.flatten())
    same = pixels[1:] == pixels[:-1]
    assert same.any() and (image.front[1:] >= image.back[:-1])[same].all()
    assert (image.back[1:] > image.back[:-1])[same].all()


@pytest.mark.parametrize("at", [2.2, 2.6, 3.0])
def test_what_lies_in_the_smoke_is_hidden_as_much(at: float) -> None:
    """Against the exact transmittance: that of all matter over that of the matter behind a near plane."""
    model, settings = volume(300), replace(EXACT, near=0.01)
    with torch.no_grad():
        model.params["log_scales"] -= 0.7
    behind = 1 - render(model, VIEW.camera, VIEW.conditions, replace(settings, near=at)).alpha.double()
    whole = 1 - render(model, VIEW.camera, VIEW.conditions, settings).alpha.double()
    clear = behind > 1e-3
    errors = {}
    for most in (1, 8):
        found = front_transmittance(draw_deep_image(model, VIEW, settings, (), most), at)
        errors[most] = float((found - whole / behind)[clear].square().mean().sqrt())
    assert errors[8] < 0.05 and errors[8] < errors[1], errors


def test_lights_are_summed() -> None:
    model = lit(LightNetwork(3), torch.float32)
    lights = [light(*where, strength=s) for *where, s in ((2, -1, 3, 1.0), (-2, 0, 1, 0.5))]
    view = replace(VIEW, conditions=lights[0])
    found = composited(draw_deep_image(model, view, EXACT, lights, 4))
    expected = render_light_sum(model, view, lights, EXACT, torch.zeros(3), lambda alpha: None)
    assert (found[..., :3] - expected).abs().max() < 1e-5


@pytest.mark.parametrize("half", [False, True])
def test_an_empty_view_has_no_samples(half: bool, tmp_path: Path) -> None:
    away = replace(
        VIEW, camera=replace(VIEW.camera, viewmat=VIEW.camera.viewmat * torch.tensor([1, 1, -1, 1.0])[:, None])
    )
    image = draw_deep_image(volume(), away, EXACT, (), 4)
    assert not image.counts.any() and len(image.alpha) == 0 and image.rgb.shape == (0, 3)
    writer(half=half).write(tmp_path / "a.exr", volume(), away)
    found, _ = stored(tmp_path / "a.exr")
    assert all(x is None or len(x) == 0 for x in found["A"].ravel())


def test_a_shadow_per_pixel_is_refused() -> None:
    view = replace(VIEW, conditions=light(2, -1, 3))
    with pytest.raises(ConfigError, match="--deep: the model has a shadow per pixel; expected one per primitive"):
        draw_deep_image(lit(LightNetwork(3, visibility="pixel"), torch.float32), view, EXACT, (), 4)


# ---------------------------------------------------------------- files


def writer(**changes: Any) -> RunExrLayers:
    made = RunExrLayers(Path("fire"), DYNAMIC, Channels(color_space="linear"), RenderConfig(EXACT), torch.zeros(3))
    return replace(made, deep=8, **changes)


def stored(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}, dict(file.header())


def test_the_file_has_the_samples_in_units_of_the_data(tmp_path: Path) -> None:
    image = draw_deep_image(volume(), VIEW, EXACT, (), 8)
    world = World(torch.diag(torch.tensor([0.5, 0.5, 0.5, 1.0], dtype=torch.float64)))
    writer(world=world, half=True).write(tmp_path / "a.exr", volume(), VIEW)
    found, header = stored(tmp_path / "a.exr")
    assert header["type"] == OpenEXR.deepscanline and set(found) == {*"RGBA", "Z", "ZBack"}
    counts = [[0 if x is None else len(x) for x in row] for row in found["A"]]
    assert counts == image.counts.tolist() and header["neuprim:condition:time"] == pytest.approx(0.4)
    values = {name: np.concatenate([x for x in pixels.ravel() if x is not None]) for name, pixels in found.items()}
    assert {name: str(v.dtype) for name, v in values.items()} == {
        **dict.fromkeys("RGBA", "float16"), "Z": "float32", "ZBack": "float32"
    }  # fmt: skip
    np.testing.assert_allclose(values["Z"], 2 * image.front.numpy(), rtol=1e-6)
    np.testing.assert_allclose(values["ZBack"], 2 * image.back.numpy(), rtol=1e-6)
    np.testing.assert_allclose(values["A"], image.alpha.half().numpy())
    np.testing.assert_allclose(values["G"], image.rgb[:, 1].half().numpy())


def test_colours_are_converted(tmp_path: Path) -> None:
    space = load_output_color_space("ACEScg")
    image = draw_deep_image(volume(), VIEW, EXACT, (), 8)
    writer(color_space=space).write(tmp_path / "a.exr", volume(), VIEW)
    found, _ = stored(tmp_path / "a.exr")
    red = np.concatenate([x for x in found["R"].ravel() if x is not None])
    np.testing.assert_allclose(red, space.convert(image.rgb)[:, 0].numpy(), rtol=1e-5, atol=1e-7)


def test_a_model_on_a_card_makes_the_same_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = writer(point=RenderConfig())
    made.write(tmp_path / "a.exr", volume(), VIEW)
    with pretended(monkeypatch):
        made.write(tmp_path / "b.exr", volume().to(CARD), VIEW)
    a, b = (stored(tmp_path / name)[0] for name in ("a.exr", "b.exr"))
    for name in ("A", "Z", "ZBack"):
        x, y = (np.concatenate([v for v in found[name].ravel() if v is not None]) for found in (a, b))
        np.testing.assert_allclose(x, y, atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"channels": Channels(color_space="srgb")}, "a model in linear light; the colours of this model are sRGB"),
        ({"names": "beauty"}, "no --layers"),
        ({"shutter": Shutter(0.5, 2, 1.0, (0.0, 1.0))}, "no --shutter"),
        ({"crop": True}, "no --crop"),
        ({"compression": "dwaa"}, "no --compression"),
        ({"point": RenderConfig(EXACT, resolution=0.5)}, "resolution=1"),
        ({"point": RenderConfig(replace(EXACT, sort="entry"))}, "renderer.sort=center"),
        ({"point": RenderConfig(replace(EXACT, samples=2))}, "renderer.samples=1"),
        ({"channels": Channels(("X", "Y", "Z"), color_space="linear")}, "channels with other names than A, Z"),
    ],
)
def test_options_without_meaning_are_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=f"--deep: expected {words}"):
        writer(**changes)


@pytest.mark.slow
def test_another_reader_flattens_it_to_the_image(tmp_path: Path) -> None:
    oiio = pytest.importorskip("OpenImageIO", reason="needs OpenImageIO: pip install OpenImageIO")
    writer().write(tmp_path / "a.exr", volume(), VIEW)
    flat = oiio.ImageBufAlgo.flatten(oiio.ImageBuf(str(tmp_path / "a.exr")))
    found, names = flat.get_pixels(oiio.FLOAT), list(flat.spec().channelnames)
    with torch.no_grad():
        expected = render(volume(), VIEW.camera, VIEW.conditions, EXACT)
    for i, name in enumerate("RGB"):
        assert np.abs(found[..., names.index(name)] - expected.rgb[..., i].numpy()).max() < 1e-5
    assert np.abs(found[..., names.index("A")] - expected.alpha.numpy()).max() < 1e-5

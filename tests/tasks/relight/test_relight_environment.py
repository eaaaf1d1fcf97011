"""Light from all around a relit model: against one point light, against the light's own arithmetic, and on the command
line."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.cli import main
from neuprim.config import compose
from neuprim.core import checkpoint
from neuprim.core.data import View
from neuprim.core.environment import Environment
from neuprim.core.errors import DataError
from neuprim.core.io.exr import write_exr
from neuprim.core.io.images import read_image
from neuprim.core.light_conditions import MAX_LIGHT_ANGLE, lights_from_environment, summarize_lights
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.task import SceneContext
from neuprim.plugins.attribution import call_task_facts
from neuprim.runs.measure import render_light_sum
from neuprim.scenes.lit import build_lit_solids, shade_point_light
from neuprim.scenes.raycast import Scene
from neuprim.tasks.relight import TASK
from neuprim.tasks.relight.colour import LightNetwork
from tests import scenes

UNSHADOWED = "none"  # LightNetwork's ``visibility``
SETTINGS = RenderSettings(backend="reference")


def facts(distance: float = 4.5, falloff: str = "inverse_square", exposure: float = 1.0, **more: Any) -> dict[str, Any]:
    """As a data set with lights all over the upper hemisphere tells them."""
    g = torch.Generator().manual_seed(0)
    offsets = torch.nn.functional.normalize(torch.randn(400, 3, generator=g), dim=1)
    offsets[:, 2] = offsets[:, 2].abs()
    center = torch.tensor([0.1, 0.2, 0.3])
    lights = summarize_lights(distance * offsets + center, center, falloff, exposure)
    return {"up": [0.0, 0.0, 1.0], "center": [0.1, 0.2, 0.3], "lights": lights} | more


def texel(row: int = 5, column: int = 9, height: int = 16) -> Tensor:
    image = torch.zeros(height, 2 * height, 3)
    image[row, column] = torch.tensor([900.0, 600.0, 300.0])
    return image


def some_model() -> Primitives:
    field = LightNetwork(3, visibility=UNSHADOWED, falloff=True)
    g = torch.Generator().manual_seed(5)
    t = {k: v for k, v in scenes.tensors(12, 2, seed=3).items() if k != "colors"}
    t |= {s.name: 0.5 * torch.randn((12, *s.shape), generator=g) for s in field.parameters()}
    t["c_dc"] = t["c_dc"].abs() + 0.5
    return Primitives(CosineDensity(2), field, t)


# ---------------------------------------------------------------- intensities


@pytest.mark.parametrize(
    ("falloff", "exposure", "factor"),
    [("inverse_square", 1.0, 3.0**2), ("inverse_square", 2.5, 2.5 * 9), ("none", 1.0, 1 / math.pi)],
)
def test_intensity_gives_the_centre_the_environments_irradiance(falloff: str, exposure: float, factor: float) -> None:
    environment = Environment(texel())
    (light,) = lights_from_environment(environment, 64, facts(3.0, falloff, exposure)).conditions
    (beam,) = zip(*vars(environment.directional_lights(64)).values(), strict=True)
    offset = light["light"].double() - torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    assert torch.allclose(offset, 3.0 * beam[0], atol=1e-6)
    assert torch.allclose(light["light_intensity"].double(), factor * beam[1], rtol=1e-6)


def test_a_white_sky_shows_albedo() -> None:
    """The ray caster's own shading of the built-in slab: a matt surface under uniform light of 1 is as bright as its
    albedo."""
    scene = Scene([s for s in build_lit_solids() if s.name == "slab"])
    told = {**facts(1e4), "center": [0.0, 0.0, 0.0]}
    lights = lights_from_environment(Environment(torch.ones(64, 128, 3)), 600, told).conditions
    total = np.zeros(3)
    for light in lights:
        seen = shade_point_light(scene, [0.2, 0.1, 3.0], [[0.0, 0.0, -1.0]], light["light"].numpy(), 1.0)
        total += seen.rgb[0].astype(np.float64) * light["light_intensity"].double().numpy()
    albedo = scene.intersect([0.2, 0.1, 3.0], np.array([[0.0, 0.0, -1.0]], np.float32)).albedo[0]
    assert albedo.min() > 0.4
    assert total == pytest.approx(albedo, rel=0.02)


@pytest.mark.parametrize("count", [1, 5, 64])
def test_energy_through_the_model_for_any_number_of_lights(count: int) -> None:
    """A constant colour c at the lights' centre receives all of the energy: 4 pi c under white."""
    field = LightNetwork(0, visibility=UNSHADOWED, falloff=True)
    t = {k: v[:1] for k, v in scenes.tensors(1, 1).items() if k != "colors"}
    t |= {"means": torch.tensor([[0.1, 0.2, 0.3]]), "c_dc": torch.tensor([[0.3, 0.2, 0.1]])}
    t |= {s.name: torch.zeros(1, *s.shape) for s in field.parameters() if s.name != "c_dc"}
    model = Primitives(CosineDensity(1), field, t)
    lights = lights_from_environment(Environment(torch.ones(32, 64, 3)), count, facts()).conditions
    view = View("v", scenes.camera(12, 10))
    seen = render_light_sum(model, view, lights, SETTINGS, torch.zeros(3))
    alpha = render(model, view.camera, lights[0], SETTINGS).alpha[..., None]
    assert len(lights) == count and alpha.max() > 0.1
    assert torch.allclose(seen, 4 * math.pi * alpha * t["c_dc"], rtol=1e-5, atol=1e-7)


# ---------------------------------------------------------------- images


def test_one_texel_is_one_light_and_the_background_counts_once() -> None:
    model, view, sky = some_model(), View("v", scenes.camera(16, 12)), torch.tensor([0.5, 0.7, 0.9])
    (light,) = lights_from_environment(Environment(texel()), 64, facts()).conditions
    one = render(model, view.camera, light, SETTINGS, sky).rgb
    assert one.max() > 1.0
    assert torch.allclose(render_light_sum(model, view, [light], SETTINGS, sky), one, atol=1e-6)
    halves = [{**light, "light_intensity": light["light_intensity"] * s} for s in (0.25, 0.75)]
    assert torch.allclose(render_light_sum(model, view, halves, SETTINGS, sky), one, atol=1e-5)


def test_darkness_is_one_light_of_no_intensity() -> None:
    found = lights_from_environment(Environment(torch.zeros(4, 8, 3)), 64, facts())
    assert [c["light_intensity"].tolist() for c in found.conditions] == [[0, 0, 0]]
    assert found.notes == ("the environment is black",)


# ---------------------------------------------------------------- what was never seen


def test_light_from_below_is_announced() -> None:
    below = torch.zeros(32, 64, 3)
    below[24:] = 1.0
    (note,) = lights_from_environment(Environment(below), 16, facts()).notes
    assert note.startswith(f"100% of the environment's light comes from more than {MAX_LIGHT_ANGLE:g} degrees")
    above = below.flip(0)
    assert lights_from_environment(Environment(above), 16, facts()).notes == ()


def test_the_summary_covers_the_lights() -> None:
    g = torch.Generator().manual_seed(1)
    lights = (
        torch.nn.functional.normalize(torch.randn(3000, 3, generator=g), dim=1) * torch.linspace(2, 4, 3000)[:, None]
    )
    found = summarize_lights(lights, torch.zeros(3), "none", 2.0)
    kept = torch.tensor(found["directions"])
    units = torch.nn.functional.normalize(lights, dim=1)
    assert kept.shape == (256, 3) and found["distance"] == pytest.approx(3.0, abs=0.01) and found["exposure"] == 2.0
    assert float((units @ kept.T).amax(1).min()) > math.cos(math.radians(10.0))
    assert len(json.dumps(found)) < 8192
    assert len(summarize_lights(lights[:5], torch.zeros(3), "none", 1.0)["directions"]) == 5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lights": None}, "lights is null; expected an object"),
        ({"center": [0, 0]}, "center is a list of 2; expected 3 numbers"),
        ({"lights": {**facts()["lights"], "distance": -1.0}}, r"distance is -1\.0; expected a distance above 0"),
        ({"lights": {**facts()["lights"], "falloff": "cubic"}}, 'falloff is "cubic"; expected none or inverse_square'),
        (
            {"lights": {**facts()["lights"], "directions": []}},
            "directions is a list of 0; expected 1 to 256 directions",
        ),
        ({"lights": {**facts()["lights"], "directions": [[1, 2, "x"]]}}, "expected a finite number"),
        ({"lights": {**facts()["lights"], "directions": [[0, 0, 1]] * 257}}, "directions is a list of 257"),
    ],
)
def test_damaged_headers(change: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=f"the model's header: data.*{message}"):
        lights_from_environment(Environment(texel()), 4, {**facts(), **change})


def test_a_data_set_tells_where_its_lights_were(tmp_path: Path) -> None:
    small = {"size": 8, "train_views": 100, "test_views": 3, "supersampling": 1}
    dataset = TASK.scene("lit_solids").load(small, SceneContext(0, tmp_path))
    told = json.loads(json.dumps(call_task_facts(TASK, dataset)))
    assert told["up"] == [0, 0, 1] and len(told["lights"]["directions"]) == 100
    assert 4.0 < told["lights"]["distance"] < 5.0 and told["lights"]["falloff"] == "inverse_square"
    above = torch.zeros(32, 64, 3)
    above[:5] = 1.0
    assert lights_from_environment(Environment(above), 8, told).notes == ()


# ---------------------------------------------------------------- commands


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    """A run directory with a model that nobody trained, and cameras; no data are needed."""
    folder = tmp_path / "run"
    folder.mkdir()
    words = ["task=relight", "scene=olat", "scene.path=nowhere", "renderer.backend=reference", f"output_dir='{folder}'"]
    (folder / "config.yaml").write_text(compose(words).to_yaml())
    header = {"background": [0.5, 0.5, 0.5], "color_space": "linear", "data": facts()}
    checkpoint.save_model(folder / "model.safetensors", some_model(), "relight", header)
    pose = torch.linalg.inv(scenes.camera().viewmat) @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    frames = [{"file_path": "a", "transform_matrix": pose.tolist()}]
    (tmp_path / "one.json").write_text(json.dumps({"w": 16, "h": 12, "camera_angle_x": 0.7, "frames": frames}))
    write_exr(tmp_path / "texel.exr", texel(), half=False)
    return folder


def drawn(run: Path, name: str, *flags: str) -> Tensor:
    out = run.parent / f"{name}.exr"
    words = ["render", str(run), "--camera", str(run.parent / "one.json"), "--layers", "beauty", "--out", str(out)]
    assert main([*words, *flags]) == 0
    return read_image(out)


def test_one_texel_is_the_flag_light(finished: Path) -> None:
    (light,) = lights_from_environment(Environment(texel()), 1, facts()).conditions
    words = {k: ",".join(f"{x:.9g}" for x in v.tolist()) for k, v in light.items()}
    one = drawn(finished, "light", f"--light={words['light']}", f"--light-intensity={words['light_intensity']}")
    file = str(finished.parent / "texel.exr")
    assert torch.allclose(drawn(finished, "around", "--environment", file), one, atol=1e-6)
    assert one.std() > 0.05 and torch.allclose(one[0, 0], torch.full((3,), 0.5), atol=1e-6)
    double = drawn(finished, "double", "--environment", file, "--environment-scale", "2")
    assert not torch.allclose(double, one, atol=1e-2) and torch.allclose(double[0, 0], one[0, 0], atol=1e-6)

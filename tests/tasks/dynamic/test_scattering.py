"""Smoke that is lit: views under several lights, transmittance to a light, and whole runs."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from neuprim.cli import main
from neuprim.config import compose
from neuprim.core.environment import Environment
from neuprim.core.errors import ConfigError
from neuprim.core.io.exr import write_exr
from neuprim.core.model.cosine import cosine_density
from neuprim.core.model.fields import Constant
from neuprim.core.model.geometry import GEOMETRY_SPECS, Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.light import shade_volume_by_light
from neuprim.core.task import SceneContext
from neuprim.runs.measure import render_light_sum
from neuprim.runs.open import load_run, open_run
from neuprim.runs.run import run
from neuprim.tasks.dynamic.scattering import (
    ScatteringHarmonics,
    light_smoke_by_environment,
    phase_factor,
    scattered_light,
)
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.dynamic.volume.lit_medium import draw_lights
from neuprim.tasks.dynamic.volume.volume_scene import load_volume_scene
from tests.page_models import camera_at
from tests.tasks.dynamic import sequences

SETTINGS = RenderSettings(near=1e-3)
SMALL = "scene.size=24 scene.cameras=6 scene.samples=1 model.primitives=60 train.iterations=60".split()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sequences.write_blobs(tmp_path_factory.mktemp("ball"), {n: 6.0 + 3 * n for n in range(1, 4)})


def cloud(count: int = 300, seed: int = 0) -> Primitives:
    """Soft balls that overlap as those of smoke do, optically about 2 deep."""
    generator = torch.Generator().manual_seed(seed)
    density, colour = TimeDensity(0, "none", edge=2, gain=True), ScatteringHarmonics(0, powers=0, waves=0)
    means = torch.randn(count, 3, generator=generator)
    given = {
        "means": 0.4 * means / means.norm(dim=1, keepdim=True) * torch.rand(count, 1, generator=generator) ** (1 / 3),
        "log_scales": torch.full((count, 3), 0.12).log() + 0.2 * torch.randn(count, 3, generator=generator),
        "quats": torch.randn(count, 4, generator=generator),
        "b2": 0.1 + 0.3 * torch.rand(count, 1, generator=generator),
    }
    params = {}
    for spec in (*GEOMETRY_SPECS, *density.parameters(), *colour.parameters()):
        drawn = 0.3 * torch.randn(count, *spec.shape, generator=generator)
        params[spec.name] = given.get(spec.name, torch.zeros_like(drawn) if spec.name == "log_gain" else drawn.abs())
    return Primitives(density, colour, params)


def shaded(model: Primitives, light: Tensor) -> Tensor:
    conditions = {"time": torch.tensor(0.5), "light": light}
    geometry, density = model.lower_density(conditions)
    found = shade_volume_by_light(geometry, density, conditions, SETTINGS).primitives
    assert found is not None
    return found


@functools.cache
def exact_transmittance(light: tuple[float, float, float], steps: int = 100) -> Tensor:
    """exp(-integral of sigma) from each centre of the cloud to the light, float64, by the midpoint rule over 2 scene
    units; 400 steps differ by .0013 at most."""
    model = cloud()
    geometry, form = model.lower_density({"time": torch.tensor(0.5)})
    means = geometry.means.double()
    towards = torch.tensor(light).double() - means
    length = towards.norm(dim=1).clamp_max(2.0)
    units = towards / towards.norm(dim=1, keepdim=True)
    place = Geometry(means, geometry.log_scales.double(), geometry.quats.double())
    depth, count = torch.zeros(len(means), dtype=torch.float64), len(means)
    prim = torch.arange(count).repeat(count)
    for k in range(steps):
        points = means + units * (length * (k + 0.5) / steps)[:, None]
        sigma = cosine_density(form, place, prim, points.repeat_interleave(count, 0)).clamp_min(0)
        depth += sigma.reshape(count, count).sum(1) * length / steps
    return (-depth).exp()


@pytest.mark.parametrize(
    "light, most",
    [
        ((3e3, -2e3, 4e3), 0.15),
        ((0.0, 0.0, 1e4), 0.15),
        ((1e6, 0.0, 0.0), 0.16),
        ((0.0, 0.0, 1.5), 0.15),
        ((-1.2, 0.3, 0.1), 0.15),
        ((0.52, 0.0, 0.0), 0.15),  # at the edge of the cloud; the others are inside of it
        ((0.2, 0.1, -0.1), 0.16),
        ((1e-4, 0.0, 0.0), 0.3),  # amid all centres: some balls contain it
        ((0.0, 0.0, 0.0), 0.3),
    ],
)
def test_light_arrives_as_the_extinction_lets_it(
    light: tuple[float, float, float], most: float, either_way: str
) -> None:
    found, exact = shaded(cloud(), torch.tensor(light)).double(), exact_transmittance(light)
    assert exact.min() < 0.2 and exact.max() > 0.7
    wrong = (found - exact).abs()
    assert float(wrong.mean()) < 0.025 and float(wrong.max()) < most
    assert float(torch.corrcoef(torch.stack([found, exact]))[0, 1]) > 0.97


@pytest.mark.parametrize(
    "light", [(0.0, 0.0, 0.0), (1e-4, 0, 0), (0.2, 0.1, -0.1), (0, 0, 1e4), (1e6, 0, 0), (0.52, 0, 0)]
)
def test_lights_at_the_extremes(light: tuple[float, float, float]) -> None:
    model = cloud(60)
    place = torch.tensor(light)
    for one in (place, model.params["means"][0].clone()):
        found = shaded(model, one)
        assert bool(((found >= 0) & (found <= 1)).all())
    frame = {"time": torch.tensor(0.5), "light": place, "light_intensity": torch.ones(3)}
    for anisotropy in (0.0, 0.95, -0.95):
        model.colour = ScatteringHarmonics(0, powers=0, waves=0, octaves=2, anisotropy=anisotropy)
        for eye in ((2.0, 2.0, 1.0), (0.2, 0.1, -0.1)):  # the second among the primitives, at one of the lights
            assert bool(torch.isfinite(render(model, camera_at(eye), frame, SETTINGS).rgb).all())
        params = {name: value.detach().requires_grad_() for name, value in model.params.items()}
        one = Primitives(model.density, model.colour, params)
        render(one, camera_at((2.0, 2.0, 1.0)), frame, SETTINGS).rgb.sum().backward()
        assert all(value.grad is None or bool(torch.isfinite(value.grad).all()) for value in params.values())


def test_octaves_of_scattering() -> None:
    """Each is weaker than the one before, and reaches deeper; the shading is relative to the unoccluded light."""
    transmittance = torch.tensor([1.0, 0.25, 0.0])
    assert scattered_light(transmittance, 1, 0.5).tolist() == [1.0, 0.25, 0.0]
    assert scattered_light(transmittance, 3, 0.5).tolist() == pytest.approx([1.75, 0.25 + 0.25 + 0.5**2.5, 0.0])
    model, light = cloud(80), torch.tensor([2.0, -1.0, 3.0])
    frame = {"time": torch.tensor(0.5), "light": light, "light_intensity": torch.ones(3)}
    single = shaded(model, light)
    model.colour = ScatteringHarmonics(0, powers=0, waves=0, octaves=3, share=0.4)
    geometry, density = model.lower_density(frame)
    shading = model.colour.shade(geometry, density, camera_at((2.0, 2.0, 1.0)), frame, SETTINGS)
    assert shading is not None and shading.primitives is not None and float(shading.primitives.max()) <= 1.0
    colour = model.colour.lower(model.of(model.colour), geometry, camera_at((2.0, 2.0, 1.0)), frame)
    assert isinstance(colour, Constant)
    arriving = shading.primitives[:, None] * colour.rgb
    expected = scattered_light(single, 3, 0.4)[:, None] * model.params["scattered"]
    assert torch.allclose(arriving, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("octaves", [1, 2])
@pytest.mark.parametrize("light", [(2.0, -1.0, 3.0), (5e3, 1e3, 0.0)])
def test_smoke_scatters_more_light_forward(octaves: int, light: tuple[float, float, float]) -> None:
    """Against the phase function itself, in float64, from cameras opposite to the light, beside it and in front."""
    model, place = cloud(40), torch.tensor(light)
    colour = ScatteringHarmonics(0, powers=0, waves=0, octaves=octaves, share=0.4, anisotropy=0.6)
    frame = {"time": torch.tensor(0.5), "light": place, "light_intensity": torch.full((3,), 2.0)}
    arriving, (geometry, density) = shaded(model, place).double(), model.lower_density(frame)
    bright = []
    for direction in (-place, torch.linalg.cross(place, torch.tensor([0.0, 0.0, 1.0])), place):
        camera = camera_at((3.0 * direction / direction.norm()).tolist())
        lowered = colour.lower(model.of(colour) | model.of(model.colour), geometry, camera, frame)
        shading = colour.shade(geometry, density, camera, frame, SETTINGS).primitives
        assert isinstance(lowered, Constant) and shading is not None and bool((shading <= 1 + 1e-6).all())
        means = geometry.means.double()
        cosine = (normalize(place - means, dim=1) * normalize(means - camera.position, dim=1)).sum(1)
        expected = torch.zeros(40, dtype=torch.float64)
        for o in range(octaves):
            g = 0.6 / 2**o
            phase = (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
            expected += 4 * math.pi * 0.4**o * arriving ** (1 / 2**o) * phase
        found = (shading[:, None] * lowered.rgb).double()
        assert torch.allclose(found, 2 * expected[:, None] * model.params["scattered"], rtol=1e-4, atol=1e-6)
        bright.append(float(found.sum()))
    assert bright[0] > 4 * bright[1] > 4 * bright[2]


def test_the_phase_factor_has_mean_1_and_no_pole() -> None:
    cosine = torch.linspace(-1, 1, 200_001, dtype=torch.float64)
    for anisotropy in (-0.95, -0.3, 0.0, 0.5, 0.95):
        factor = phase_factor(cosine, anisotropy)
        assert float(torch.trapezoid(factor, cosine)) / 2 == pytest.approx(1.0, rel=1e-5)
        assert float(factor.min()) > 0 and float(factor.max()) < 1e3
        mean = float(torch.trapezoid(factor * cosine, cosine)) / 2
        assert mean == pytest.approx(anisotropy, abs=1e-5)  # g is the mean cosine


@pytest.mark.parametrize(
    "wrong",
    [{"octaves": 0}, {"octaves": 9}, {"octaves": True}, {"share": 1.5}, {"share": -0.1}, {"anisotropy": 0.96},
     {"anisotropy": float("nan")}],
)  # fmt: skip
def test_impossible_scattering_is_refused(wrong: dict[str, Any]) -> None:
    (name,) = wrong
    with pytest.raises(ValueError, match=rf"^{name} .*; expected"):
        ScatteringHarmonics(0, **wrong)


def test_an_empty_frame_is_dark() -> None:
    model = cloud(4)
    none = Primitives(model.density, model.colour, {name: value[:0] for name, value in model.params.items()})
    frame = {"time": torch.tensor(0.5), "light": torch.ones(3), "light_intensity": torch.ones(3)}
    assert not render(none, camera_at((2.0, 2.0, 1.0)), frame, SETTINGS).rgb.any()


def test_the_image_is_affine_in_the_light() -> None:
    model = cloud(80)
    for value in model.params.values():
        value.requires_grad_()

    def drawn(strength: float) -> Tensor:
        frame = {"time": torch.tensor(0.5), "light": torch.tensor([2.0, -1.0, 3.0])}
        return render(
            model, camera_at((2.0, 2.0, 1.0)), {**frame, "light_intensity": torch.full((3,), strength)}, SETTINGS
        ).rgb

    dark, one, two = drawn(0.0), drawn(1.0), drawn(2.0)
    assert float((one - dark).max()) > 0.05 and torch.allclose(two - dark, 2 * (one - dark), atol=1e-5)
    one.sum().backward()
    for name in ("scattered", "sh_dc", "means", "b2"):
        gradient = model.params[name].grad
        assert gradient is not None and bool(torch.isfinite(gradient).all()) and gradient.abs().max() > 0, name
    own = model.colour.isotropic(model.of(model.colour), {"time": torch.tensor(0.5)})
    assert own is not None and model.colour.harmonics(model.of(model.colour), {"time": torch.tensor(0.5)}) is None


# ---------------------------------------------------------------- data


def test_cameras_take_the_lights_in_turns_and_held_out_ones_have_others(files: Path, tmp_path: Path) -> None:
    data = sequences.dataset(files, tmp_path, lights=3, cameras=8)
    capture = sequences.recorded(data).capture
    for t, frame in enumerate(capture.frames):
        drawn = [capture.optics.light, *draw_lights(capture.optics, 2, frame.number), *draw_lights(capture.optics, 2)]
        towards = [normalize(torch.tensor(one.direction), dim=0) for one in drawn if one is not None]
        assert len(towards) == 5 and all(one[2] > 0.1 for one in towards)
        seen = [data.train.view(c * 3 + t).conditions for c in range(6)] + [
            data.test.view(c * 3 + t).conditions for c in range(2)
        ]
        for conditions, number in zip(seen, (0, 1, 2, 0, 1, 2, 3, 4), strict=True):
            light = normalize(conditions["light"], dim=0)
            assert torch.allclose(light, towards[number].float(), atol=1e-6)
            assert conditions["light_intensity"].tolist() == pytest.approx([5.0, 5.0, 5.2])
    assert draw_lights(capture.optics, 2, 1) != draw_lights(capture.optics, 2, 2)


def test_a_view_shows_its_own_light(files: Path, tmp_path: Path) -> None:
    """The brighter half of a ball is the one that the light shines on."""
    data = sequences.dataset(
        files, tmp_path, lights=4, size=32, cameras=10, optics={"emission": 0.0, "extinction": 60.0}
    )
    checked = 0
    for i in range(len(data.train)):
        view, pixels = data.train.view(i), data.train.pixels(i)
        assert pixels.alpha is not None
        towards = view.camera.viewmat[:3, :3].float() @ normalize(view.conditions["light"], dim=0)
        bright, alpha = pixels.rgb.mean(-1), pixels.alpha
        rows, columns = (torch.arange(32.0) for _ in range(2))
        across = float((bright.sum(0) * columns).sum() / bright.sum() - (alpha.sum(0) * columns).sum() / alpha.sum())
        down = float((bright.sum(1) * rows).sum() / bright.sum() - (alpha.sum(1) * rows).sum() / alpha.sum())
        if float(towards[:2].norm()) > 0.6:
            checked += 1
            assert across * float(towards[0]) + down * float(towards[1]) > 0
    assert checked > 5


def test_one_light_is_none_to_know(files: Path, tmp_path: Path) -> None:
    assert set(sequences.dataset(files, tmp_path).train.view(0).conditions) == {"time"}
    words = {"vdb": str(files), "size": 24, "cameras": 6, "look": "embergen_fire", "lights": 2, "samples": 1}
    with pytest.raises(ConfigError, match="look embergen_fire has no light"):
        load_volume_scene({**words, "grids": {"temperature": "density"}}, SceneContext(0, tmp_path / "cache"))


# ---------------------------------------------------------------- runs


@pytest.fixture(scope="module")
def lit(files: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("lit") / "run"
    scene = ["task=dynamic", "scene=vdb", f"scene.vdb='{files}'", "scene.look=smoke_fire", "scene.lights=3"]
    return run(compose([*scene, *SMALL, f"output_dir='{target}'"]))


def test_time_and_light_move_together(lit: Path, tmp_path: Path) -> None:
    assert [spec.name for spec in load_run(lit).task.conditions] == ["time", "light", "light_intensity"]
    target = tmp_path / "film.webp"
    words = ["--camera", "orbit", "--time", "0:1", "--light", "orbit:4:40:6", "--light-intensity", "5"]
    assert main(["render", str(lit), *words, "--out", str(target)]) == 0 and target.stat().st_size > 100
    assert main(["render", str(lit), "--camera", "test", "--light", "1,0,2", "--out", str(tmp_path / "still")]) == 0


def test_voxels_do_not_ask_for_a_light(lit: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["export", str(lit), "--format", "vdb", "--time", "0.5"]
    assert main([*words, "--out", str(tmp_path / "a.vdb")]) == 0 and (tmp_path / "a.vdb").is_file()
    assert main([*words, "--light", "1,0,2", "--out", str(tmp_path / "b.vdb")]) == 2
    assert "--light: the export does not depend on this condition" in capsys.readouterr().err
    assert (
        main(["export", str(lit), "--format", "gaussian-ply", "--time", "0.5", "--out", str(tmp_path / "g.ply")]) == 2
    )
    assert "--light: required" in capsys.readouterr().err


def test_layers_of_light(lit: Path, tmp_path: Path) -> None:
    words = ["--camera", "orbit", "--frames", "1", "--time", "0.5", "--light", "1,1,2", "--light-intensity", "5"]
    assert main(["render", str(lit), *words, "--format", "exr", "--out", str(tmp_path)]) == 0
    (path,) = tmp_path.glob("*.exr")
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    assert {"unshadowed.R", "visibility.Y", "emission.R", "absorption.R"} <= set(found)
    shown = found["A"] > 0.1
    assert (found["unshadowed.R"] >= found["R"] - 1e-3)[shown].all()
    assert (found["visibility.Y"][shown] > 0).all() and (found["visibility.Y"][shown] < 1).any()


def test_light_from_all_around_leaves_what_shines_once(lit: Path, tmp_path: Path) -> None:
    """Twice the lights of half the strength make the same image, flames and ambient light included."""
    made = open_run(lit)
    view = made.dataset().test.view(4)
    sky = light_smoke_by_environment(Environment(torch.full((16, 32, 3), 0.5)), 8, made.header["data"])
    assert len(sky.conditions) > 4 and [float(c["shines"]) for c in sky.conditions[:3]] == [1.0, 0.0, 0.0]
    black = torch.zeros(3)
    whole = render_light_sum(made.model, view, sky.conditions, made.settings, black)
    dark = render_light_sum(made.model, view, [{"light_intensity": torch.zeros(3)}], made.settings, black)
    halves = [
        {**c, "light_intensity": c["light_intensity"] / 2, "shines": c["shines"] * part}
        for c in sky.conditions
        for part in (1.0, 0.0)
    ]
    assert torch.allclose(render_light_sum(made.model, view, halves, made.settings, black), whole, atol=1e-5)
    assert float((whole - dark).max()) > 0.01 and float((whole - dark).min()) > -1e-6
    write_exr(tmp_path / "sky.exr", torch.full((16, 32, 3), 0.5))
    words = ["render", str(lit), "--camera", "test", "--time", "0.5", "--environment", str(tmp_path / "sky.exr")]
    assert main([*words, "--environment-samples", "4", "--out", str(tmp_path / "sky")]) == 0


def test_a_model_of_one_light_takes_no_other(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = ["task=dynamic", "scene=vdb", f"scene.vdb='{files}'", "scene.look=smoke_fire"]
    baked = run(compose([*scene, *SMALL, f"output_dir='{tmp_path / 'baked'}'"]))
    assert main(["render", str(baked), "--camera", "test", "--light", "1,0,2"]) == 2
    assert "--light" in capsys.readouterr().err
    write_exr(tmp_path / "sky.exr", torch.full((8, 16, 3), 0.5))
    assert main(["render", str(baked), "--camera", "test", "--environment", str(tmp_path / "sky.exr")]) == 2
    assert "this model's light is fixed" in capsys.readouterr().err

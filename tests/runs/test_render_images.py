"""Which frames a film has, and views as layers of one file: linear light that adds up, numbers that are as they were
drawn, and a header that says what is what."""

from __future__ import annotations

import importlib.util
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from torch import Tensor

from neuprim.__main__ import main
from neuprim.core.cameras.pinhole import CameraViews
from neuprim.core.channels import Channels
from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.core.io.images import srgb_to_linear
from neuprim.core.model.fields import Constant
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.layer_frame import LayerSpec
from neuprim.plugins.attribution import ReturnError
from neuprim.runs.color_space import load_output_color_space
from neuprim.runs.measure import render_light_sum
from neuprim.runs.render_config import RenderConfig, RunExrLayers
from neuprim.runs.render_images import _run_views_of_camera_file, _view_file_names, set_run_view_conditions
from neuprim.tasks.dynamic import TASK as DYNAMIC
from neuprim.tasks.relight import TASK as RELIGHT
from neuprim.tasks.relight.colour import LightNetwork
from tests import scenes
from tests.lit_models import light
from tests.lit_models import model as lit
from tests.plugins.marked import write_run
from tests.pretend_card import CARD, pretended
from tests.timed_models import model as timed

CAMERA = scenes.camera(20, 16, distance=2.6)
REFERENCE = RenderSettings(backend="reference")
BLUE = torch.tensor([0.1, 0.2, 0.7])


def volume() -> Primitives:
    return timed("window", count=16, dtype=torch.float32)


VIEW = View("a view", CAMERA, {"time": torch.tensor(0.4)})


def layers(space: str = "linear", **changes: Any) -> RunExrLayers:
    return replace(
        RunExrLayers(Path("runs/fire"), DYNAMIC, Channels(color_space=space), RenderConfig(), BLUE), **changes
    )


def written(path: Path, how: RunExrLayers, model: Primitives, view: View) -> tuple[dict[str, Tensor], dict[str, Any]]:
    how.write(path, model, view)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: torch.from_numpy(np.array(c.pixels)) for name, c in file.channels().items()}, dict(file.header())


def rgb(found: dict[str, Tensor], prefix: str = "") -> Tensor:
    return torch.stack([found[prefix + c] for c in "RGB"], -1)


def drawn(model: Primitives, view: View, background: Tensor | None = None) -> Any:
    with torch.no_grad():
        return render(model, view.camera, view.conditions, replace(REFERENCE, depth=True), background)


def test_every_layer_of_a_volume_is_the_references(tmp_path: Path) -> None:
    found, _ = written(tmp_path / "a.exr", layers(), volume(), VIEW)
    expected = drawn(volume(), VIEW)
    sums = {f"{name}.{c}" for name in ("emission", "absorption") for c in "RGB"}
    assert set(found) == {*"RGBA", "depth.Z", "density.Y", *sums}
    assert all(plane.dtype == torch.float32 for plane in found.values())
    assert (rgb(found) - expected.rgb).abs().max() < 1e-5 and (found["A"] - expected.alpha).abs().max() < 1e-5
    assert (found["depth.Z"] - expected.depth).abs().max() < 1e-3
    assert (rgb(found, "emission.") - rgb(found, "absorption.") - rgb(found)).abs().max() < 1e-6
    assert found["density.Y"].max() > 0.3 and rgb(found).max() > 0.1


def test_a_model_in_srgb_values_is_written_as_linear_light(tmp_path: Path) -> None:
    found, header = written(tmp_path / "a.exr", layers("srgb"), volume(), VIEW)
    expected = drawn(volume(), VIEW)
    assert set(found) == {*"RGBA", "depth.Z", "density.Y"}, "sums of sRGB values are no light"
    alpha = expected.alpha[..., None]
    assert (rgb(found) - alpha * srgb_to_linear(expected.rgb / alpha.clamp_min(1e-30))).abs().max() < 1e-5
    assert header["neuprim:colorSpace"] == "linear light, of a model whose colours are sRGB values"
    assert np.allclose(header["neuprim:background"], srgb_to_linear(BLUE), atol=1e-6)
    with pytest.raises(
        ConfigError, match=r"--layers emission: layers of light need linear colours, but the model's are sRGB"
    ):
        layers("srgb", names="emission")


@pytest.mark.parametrize("space", ["linear", "srgb"])
def test_beauty_without_alpha_lies_over_the_background(tmp_path: Path, space: str) -> None:
    found, header = written(tmp_path / "a.exr", layers(space, names="beauty,depth"), volume(), VIEW)
    expected = drawn(volume(), VIEW, BLUE).rgb
    assert set(found) == {*"RGB", "depth.Z"} and "over the background" in header["neuprim:layer:beauty"]
    assert (rgb(found) - (expected if space == "linear" else srgb_to_linear(expected))).abs().max() < 1e-5


def test_cropped_files_have_all_of_the_model(tmp_path: Path) -> None:
    view = replace(VIEW, camera=scenes.camera(60, 40, distance=9.0))
    found, header = written(tmp_path / "a.exr", layers(crop=True, compression="piz"), volume(), view)
    whole, _ = written(tmp_path / "b.exr", layers(), volume(), view)
    (x0, y0), (x1, y1) = (corner.tolist() for corner in header["dataWindow"])
    assert 0 < x0 < x1 < 59 and 0 < y0 < y1 < 39 and header["compression"] == OpenEXR.PIZ_COMPRESSION
    for name, plane in whole.items():
        assert torch.equal(found[name], plane[y0 : y1 + 1, x0 : x1 + 1])
        plane[y0 : y1 + 1, x0 : x1 + 1] = 0
        assert not plane.any(), name
    with pytest.raises(ConfigError, match=r"--crop: without the layer alpha, beauty contains the background"):
        layers(crop=True, names="beauty,depth")


def test_half_is_for_light_and_alpha(tmp_path: Path) -> None:
    found, _ = written(tmp_path / "a.exr", layers(half=True), volume(), VIEW)
    assert {name for name, plane in found.items() if plane.dtype == torch.float32} == {"depth.Z", "density.Y"}
    full, _ = written(tmp_path / "b.exr", layers(), volume(), VIEW)
    assert all(torch.equal(plane.float(), full[n].to(plane.dtype).float()) for n, plane in found.items())


def test_the_header_says_camera_conditions_and_meaning(tmp_path: Path) -> None:
    _, header = written(tmp_path / "a.exr", layers(), volume(), VIEW)
    points = torch.tensor([[0.2, -0.1, 0.3]], dtype=torch.float64)
    row = np.append(points[0].numpy(), 1.0) @ header["worldToNDC"]
    assert np.abs(row[:2] / row[3] * (20, 16) - CAMERA.project(points)[0][0].numpy()).max() < 1e-4
    assert header["neuprim:condition:time"] == pytest.approx(0.4) and header["neuprim:near"] == pytest.approx(
        REFERENCE.near
    )
    assert (header["neuprim:run"], header["neuprim:task"], header["neuprim:view"]) == ("fire", "dynamic", "a view")
    assert header["software"].startswith("neuprim ") and "camera z" in header["neuprim:layer:depth"]
    assert np.allclose(header["chromaticities"], (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329))


@pytest.mark.parametrize(("fps", "expected"), [(24.0, "24"), (23.976, "24000/1001"), (None, None)])
def test_the_header_says_the_frame_rate(tmp_path: Path, fps: float | None, expected: str | None) -> None:
    _, header = written(tmp_path / "a.exr", replace(layers(), fps=fps), volume(), VIEW)
    assert (None if expected is None else Fraction(expected)) == header.get("framesPerSecond")


def test_lights_apart_add_up_to_the_beauty(tmp_path: Path) -> None:
    model = lit(LightNetwork(3), torch.float32)
    lights = [light(*where, strength=s) for *where, s in ((2, -1, 3, 1.0), (-2, 0, 1, 0.5), (0, 2, 2, 2.0))]
    how = replace(layers(), task=RELIGHT, lights=lights, names="beauty,alpha,unshadowed,lights")
    found, header = written(tmp_path / "a.exr", how, model, replace(VIEW, conditions={}))
    apart = [rgb(found, f"light_{i:03d}.") for i in range(3)]
    assert (sum(apart) - rgb(found)).abs().max() < 1e-5 and min(image.max() for image in apart) > 0.05  # type: ignore[arg-type]
    for image, one in zip(apart, lights, strict=True):
        assert (image - drawn(model, replace(VIEW, conditions=one)).rgb).abs().max() < 1e-5
    assert (
        np.array_equal(header["neuprim:light_001:light"], np.float32([-2, 0, 1]))
        and "neuprim:condition:light" not in header
    )
    whole = render_light_sum(model, replace(VIEW, conditions={}), lights, RenderSettings(), BLUE)
    over, _ = written(tmp_path / "b.exr", replace(how, names="beauty"), model, replace(VIEW, conditions={}))
    assert (rgb(over) - whole).abs().max() < 1e-5
    with pytest.raises(ConfigError, match="--layers lights: 129 lights need one layer each; expected at most 128"):
        replace(how, lights=lights * 43)


def test_a_layer_that_the_model_lacks_is_left_out_or_refused_by_name(tmp_path: Path) -> None:
    model = lit(LightNetwork(3, visibility="none"), torch.float32)
    how, view = replace(layers(), task=RELIGHT), replace(VIEW, conditions=light())
    assert set(written(tmp_path / "a.exr", how, model, view)[0]) == {*"RGBA", "depth.Z", "density.Y"}
    with pytest.raises(ConfigError, match="--layers visibility: this run's model has no such layer"):
        replace(how, names="visibility").write(tmp_path / "b.exr", model, view)
    assert not (tmp_path / "b.exr").exists()


def test_a_lower_resolution_keeps_means_at_silhouettes(tmp_path: Path) -> None:
    found, _ = written(tmp_path / "a.exr", layers(point=RenderConfig(resolution=0.5)), volume(), VIEW)
    assert found["depth.Z"].shape == (16, 20)
    seen = found["depth.Z"][found["A"] > 0]
    small = drawn(volume(), replace(VIEW, camera=CAMERA.resized(10, 8))).depth
    assert seen.min() > small[small > 0].min() - 1e-4, "no mean with the 0 beside it"


def test_layers_of_others_in_any_channels(tmp_path: Path) -> None:
    own = (
        LayerSpec("twice", "twice the light", lambda f: f.composite(Constant(2 * f.lowered.colour.flat))),
        LayerSpec("where", "mean position", lambda f: f.drawn.rgb[..., :2], ("X", "Y")),
    )
    bands = Channels(("450nm", "550nm", "NIR"), "linear")
    how = layers(channels=bands, task=replace(DYNAMIC, layers=own))
    found, header = written(tmp_path / "a.exr", how, volume(), VIEW)
    others = {*(f"twice.{c}" for c in bands.names), "where.X", "where.Y"}
    assert set(found) == {*bands.names, "A", "depth.Z", "density.Y", *others}
    assert (found["twice.NIR"] - 2 * found["NIR"]).abs().max() < 1e-6 and "chromaticities" not in header


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda f: f.drawn.alpha, r"twice: found torch.float32 of shape \(16, 20\); expected .* \(16, 20, 3\)"),
        (lambda f: f.drawn.rgb / 0, "twice: found .* NaN or infinite values"),
        (lambda f: 3, "twice: found a int; expected floats"),
    ],
)
def test_wrong_layers_of_others_are_refused(tmp_path: Path, draw: Any, message: str) -> None:
    task = replace(DYNAMIC, layers=(LayerSpec("twice", "wrong", draw),))
    with pytest.raises(ReturnError, match=message):
        layers(task=task).write(tmp_path / "b.exr", volume(), VIEW)


@pytest.mark.parametrize("shadows", ["pixel", "volume"])
def test_a_model_on_a_card_makes_the_same_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shadows: str) -> None:
    """Nothing is taken from two devices at once."""
    if shadows == "volume":
        how, model, view = layers(), volume(), VIEW
    else:
        how, model = replace(layers(), task=RELIGHT), lit(LightNetwork(3, visibility=shadows), torch.float32)
        view = replace(VIEW, conditions=light(1.5, -2.0, 2.0))
    expected, _ = written(tmp_path / "a.exr", how, model, view)
    with pretended(monkeypatch):
        there = model.to(CARD)
        assert there.device == CARD
        how.write(tmp_path / "b.exr", there, view)
    with OpenEXR.File(str(tmp_path / "b.exr"), separate_channels=True) as file:
        found = {name: torch.from_numpy(np.array(c.pixels)) for name, c in file.channels().items()}
    assert found.keys() == expected.keys()
    for name, plane in found.items():
        assert (plane - expected[name]).abs().max() < 1e-4, name


# ---------------------------------------------------------------- frames

BOTH = replace(RELIGHT, conditions=(*DYNAMIC.conditions, *RELIGHT.conditions))
VIEWS = [View(f"v{i}", scenes.camera(8 + i, 8), {"light_intensity": torch.ones(3)}) for i in range(4)]


def test_time_and_light_go_along_together() -> None:
    views, animated = set_run_view_conditions(VIEWS[:1], BOTH, {"time": "0:1:48", "light": "orbit"})
    assert animated and len(views) == 48 == len({v.name for v in views})
    times = torch.stack([v.conditions["time"] for v in views])
    assert torch.allclose(times, torch.linspace(0, 1, 48), atol=1e-6)
    angles = torch.stack([torch.atan2(v.conditions["light"][1], v.conditions["light"][0]) for v in views]) % (
        2 * torch.pi
    )
    assert torch.allclose(angles, torch.arange(48) * (2 * torch.pi / 48), atol=1e-5)
    assert all(v.conditions["light_intensity"].tolist() == [1, 1, 1] for v in views)


def test_cameras_are_spread_over_the_frames_and_frames_over_the_cameras() -> None:
    views, _ = set_run_view_conditions(VIEWS, BOTH, {"time": "0:1:8", "light": "1,2,3"})
    assert [v.camera.width for v in views] == [8, 8, 9, 9, 10, 10, 11, 11]
    views, animated = set_run_view_conditions(VIEWS, BOTH, {"time": "0,1", "light": "orbit"})
    assert (
        animated
        and [float(v.conditions["time"]) for v in views] == [0, 0, 1, 1]
        and [v.camera.width for v in views] == [8, 9, 10, 11]
    )


def test_one_value_is_no_animation() -> None:
    views, animated = set_run_view_conditions(VIEWS, BOTH, {"time": "0.5", "light": "1,2,3"})
    assert not animated and [v.name for v in views] == ["v0", "v1", "v2", "v3"]


def test_lengths_that_differ_and_what_is_missing_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"--time 0:1:48 has 48 frames and --light orbit:4:40:60 has 60 frames"):
        set_run_view_conditions(VIEWS, BOTH, {"time": "0:1:48", "light": "orbit:4:40:60"})
    with pytest.raises(ConfigError, match="view v0 has no time, which task 'relight' needs; give --time"):
        set_run_view_conditions(VIEWS, BOTH, {"light": "1,2,3"})


def test_a_files_times_are_the_frames_where_the_task_has_a_time() -> None:
    file = CameraViews(tuple((v.name, v.camera) for v in VIEWS), times=(0.0, 0.25, 0.5, 1.0))
    assert [float(v.conditions["time"]) for v in _run_views_of_camera_file(file, DYNAMIC, {}, "c.json")] == [
        0.0,
        0.25,
        0.5,
        1.0,
    ]
    assert [v.conditions for v in _run_views_of_camera_file(file, DYNAMIC, {"time": "0.5"}, "")] == [{}] * 4, (
        "what the user says comes first"
    )
    assert [v.conditions for v in _run_views_of_camera_file(file, RELIGHT, {}, "")] == [{}] * 4
    assert [v.conditions for v in _run_views_of_camera_file(replace(file, times=None), DYNAMIC, {}, "")] == [{}] * 4
    views, animated = set_run_view_conditions(
        _run_views_of_camera_file(file, BOTH, {}, ""), BOTH, {"light": "orbit:4:40:4", "light_intensity": "2"}
    )
    assert animated and [float(v.conditions["time"]) for v in views] == [0.0, 0.25, 0.5, 1.0]

    with pytest.raises(ConfigError, match=r"c\.json: time: 3 is outside its range, 0 to 1"):
        _run_views_of_camera_file(replace(file, times=(0.0, 0.5, 3.0, 1.0)), DYNAMIC, {}, "c.json")


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the frames 1001 to 1010."""
    words = ["task=dynamic", "scene=vdb", "scene.vdb=nowhere"]
    folder = tmp_path_factory.mktemp("shots") / "run"
    return write_run(folder, volume(), words, color_space="linear", data={"frames": [1001, 1010]})


def json_cameras(path: Path, places: Sequence[float]) -> Path:
    rows = [[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 2.6], [0, 0, 0, 1]] for x in places]
    file = {"w": 8, "h": 8, "camera_angle_x": 0.7, "frames": [{"transform_matrix": matrix} for matrix in rows]}
    path.write_text(json.dumps(file))
    return path


def usd_cameras(path: Path, first: int, last: int) -> Path:
    """A camera whose x is its time code - 1000, in thousandths."""
    at = ", ".join(f"{code}: ({(code - 1000) / 1000}, 0, 2.6)" for code in range(first, last + 1))
    path.write_text(
        f"#usda 1.0\n(\n startTimeCode = {first}\n endTimeCode = {last}\n)\n"
        'def Camera "C"\n{\n float focalLength = 20\n double3 xformOp:translate.timeSamples = {' + at + "}\n"
        ' uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
    )
    return path


def drawn_shot(run: Path, cameras: Path, frame: str, out: Path) -> dict[str, int]:
    """File name -> x of the camera in thousandths."""
    words = ["--camera", str(cameras), "--size", "8x8", "--frame", frame, "--format", "exr", "--out", str(out)]
    assert main(["render", str(run), *words]) == 0
    headers = {file.name: OpenEXR.File(str(file)).header() for file in out.iterdir()}
    return {name: round(-1000 * float(h["neuprim:worldToCamera"][3, 0])) for name, h in sorted(headers.items())}


@pytest.mark.parametrize(
    ("codes", "frame", "expected"),
    [
        ((1001, 1010), "1004-1006", {1004: 4, 1005: 5, 1006: 6}),
        ((1001, 1010), "1005", {1005: 5}),
        ((1003, 1006), "1003-1006", {1003: 3, 1004: 4, 1005: 5, 1006: 6}),
        ((1, 3), "1004-1006", {1004: -999, 1005: -998, 1006: -997}),  # by order
    ],
)
def test_time_codes_of_usd_are_frame_numbers(
    shot: Path, tmp_path: Path, codes: tuple[int, int], frame: str, expected: dict[int, int]
) -> None:
    pytest.importorskip("pxr", reason="needs usd-core: pip install 'neuprim[usd]'")
    found = drawn_shot(shot, usd_cameras(tmp_path / "c.usda", *codes), frame, tmp_path / "out")
    assert found == {f"c.{number}.exr": x for number, x in expected.items()}


def test_frames_that_do_not_fit_the_cameras(shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    three = json_cameras(tmp_path / "c.json", (0.001, 0.002, 0.003))
    assert list(drawn_shot(shot, three, "1002-1004", tmp_path / "a").values()) == [1, 2, 3]
    assert list(drawn_shot(shot, three, "1002", tmp_path / "b").values()) == [1, 2, 3], "all cameras at one time"
    bad = [(three, "1001-1002", "2 frames, but FILE has 3 cameras; expected one frame, or as many frames as cameras")]
    if importlib.util.find_spec("pxr"):
        late = usd_cameras(tmp_path / "late.usda", 1003, 1006)
        known = "FILE has 4 cameras (of frames 1003 to 1006); expected frames in that range, or as many frames"
        bad += [(late, "1001-1008", f"8 frames, but {known}"), (late, "1001", f"1 frame, but {known}")]
    for file, frame, message in bad:
        out = ["--size", "8x8", "--out", str(tmp_path / "out")]
        assert main(["render", str(shot), "--camera", str(file), "--frame", frame, *out]) == 2
        assert f"--frame {frame}: {message.replace('FILE', str(file))}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("out", "file"),
    [(None, "run/frames/c.v001.webp"), ("fire_v1.2", "fire_v1.2.webp"), ("fire.gif", "fire.webp")],
)
def test_a_version_is_no_suffix_of_an_animation(shot: Path, tmp_path: Path, out: str | None, file: str) -> None:
    run = tmp_path / "run"
    shutil.copytree(shot, run)
    words = ["--camera", str(json_cameras(tmp_path / "c.v001.json", (0.0, 0.1))), "--time", "0,1", "--format", "webp"]
    assert main(["render", str(run), *words, *([] if out is None else ["--out", str(tmp_path / out)])]) == 0
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.webp")] == [file]


@pytest.mark.parametrize("kind", ["png", "exr", "gif"])
def test_some_empty_images_are_named(shot: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = json_cameras(tmp_path / "c.json", (0.0, *[99.0] * 9, 0.1))
    words = ["--camera", str(cameras), "--time", "0.5", "--format", kind, "--out", str(tmp_path / "out")]
    assert main(["render", str(shot), *words]) == 0
    names = ", ".join(f"camera_{i:03d}" for i in range(1, 9))
    assert f"9 of 11 images are empty: {names}, ...\n" in capsys.readouterr().err


def test_no_two_views_share_a_file() -> None:
    assert _view_file_names(("a/b", "c d")) == ["a_b", "c_d"]
    assert _view_file_names(("a/b", "a_b", "A_B")) == ["000_a_b", "001_a_b", "002_A_B"]


def test_only_layers_of_light_are_converted(tmp_path: Path) -> None:
    space, model = load_output_color_space("ACEScg"), volume()
    plain, head = written(tmp_path / "plain.exr", layers(), model, VIEW)
    found, converted = written(tmp_path / "aces.exr", layers(color_space=space), model, VIEW)
    assert found.keys() == plain.keys()
    for prefix in ("", "emission.", "absorption."):
        was, now = (torch.stack([file[prefix + c] for c in "RGB"], -1) for file in (plain, found))
        assert float(was.max()) > 0.1 and torch.allclose(now, space.convert(was), atol=1e-6)
    for name in ("A", "depth.Z", "density.Y"):
        assert torch.equal(found[name], plain[name])
    assert converted["oiio:ColorSpace"] == "ACEScg" and "oiio:ColorSpace" not in head
    assert converted["neuprim:colorSpace"] == "linear light, in ACEScg"
    assert np.allclose(converted["chromaticities"], space.chromaticities)
    background = space.convert(torch.tensor(head["neuprim:background"]))
    assert np.allclose(converted["neuprim:background"], background)
    _, unknown = written(tmp_path / "p3.exr", layers(color_space=load_output_color_space("Linear P3-D65")), model, VIEW)
    assert "chromaticities" not in unknown


def test_colour_spaces_need_colours() -> None:
    with pytest.raises(ConfigError, match="expected channels R, G, B; found a, b"):
        layers(color_space=load_output_color_space("ACEScg"), channels=Channels(("a", "b"), color_space="linear"))

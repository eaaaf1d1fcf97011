"""The lit solids: light with known answers, views, files, and the same pixels through the loader of their layout."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from neuprim.core.data import Dataset
from neuprim.core.data.dataset import hold_out_views
from neuprim.core.data.image_views import ImageViews
from neuprim.core.task import SceneContext
from neuprim.scenes import PIXEL_CLASSES
from neuprim.scenes import lit as generator
from neuprim.scenes.image_set import scene_camera_pose
from neuprim.scenes.lit import (
    FIELD_OF_VIEW,
    INTENSITY,
    PARTS,
    LitSettings,
    ShadedRays,
    build_lit_solids,
    draw_lit_solids,
    generate_lit_solids,
    place_cameras_and_lights,
    shade_point_light,
)
from neuprim.scenes.raycast import Scene
from neuprim.scenes.shapes import Solid, ball, chamfered_box, parse_solid_srgb, uniform_colour
from neuprim.tasks import relight
from neuprim.tasks.relight.datasets import load_lit_solids_for_relighting as load
from neuprim.tasks.relight.datasets import load_olat, read_lit_pixel_classes
from neuprim.tasks.relight.lighting import dataset_lighting

GREY = "#808080"
FLOOR = Solid("floor", chamfered_box([4, 4, 0.1], [0, 0, -0.05], 0.001), uniform_colour(GREY), 0.0)
BLOCK = Solid("block", chamfered_box([0.4, 0.4, 0.2], [0, 0, 0.6], 0.0005), uniform_colour("#ffffff"), 0.0)
SMALL = {"size": 24, "train_views": 4, "test_views": 3, "supersampling": 2}
FEW_FRAMES = 4
CAST, ATTACHED, HIGHLIGHT = map(PIXEL_CLASSES.index, ("cast_shadow", "attached_shadow", "highlight"))


def down(scene: Scene, points: list[tuple[float, float]], light: tuple[float, float, float]) -> ShadedRays:
    """What rays straight down from a height of 0.3 see at (x, y) points."""
    origins = np.array([[x, y, 0.3] for x, y in points])
    return shade_point_light(scene, origins, np.tile([[0.0, 0.0, -1.0]], (len(points), 1)), light, 2.0)


def names(shaded: ShadedRays) -> list[str]:
    return [PIXEL_CLASSES[c] for c in shaded.classes]


def test_lambert_under_a_point_light() -> None:
    points = [(0.3, -0.2), (0.0, 0.0), (-1.0, 1.5)]
    seen = down(Scene([FLOOR]), points, (0.3, -0.2, 2.0))
    for (x, y), rgb in zip(points, seen.rgb, strict=True):
        square = (x - 0.3) ** 2 + (y + 0.2) ** 2 + 4.0
        np.testing.assert_allclose(
            rgb, parse_solid_srgb(GREY) / np.pi * (2.0 / np.sqrt(square)) * 2.0 / square, rtol=1e-4
        )
    assert names(seen) == ["lit"] * 3
    np.testing.assert_array_equal(seen.rgb, seen.unshadowed)


def test_the_shadow_of_a_box_lies_where_its_edges_project() -> None:
    """Under a light at (1, 0, 2) the upper edge of the far side projects to 1 - 1.2 * 2 / 1.3, the lower one of the
    near side to 1 - 0.8 * 2 / 1.5."""
    seen = down(Scene([FLOOR, BLOCK]), [(x, 0.0) for x in (-0.86, -0.83, -0.4, -0.08, -0.05, 0.2)], (1.0, 0.0, 2.0))
    assert names(seen) == ["lit", "cast_shadow", "cast_shadow", "cast_shadow", "lit", "lit"]
    cast = seen.classes == CAST
    assert not seen.rgb[cast].any() and (seen.unshadowed[cast] > 0.01).all()
    alone = down(Scene([FLOOR]), [(-0.4, 0.0)], (1.0, 0.0, 2.0))
    np.testing.assert_allclose(seen.unshadowed[2], alone.rgb[0], rtol=1e-5)


def test_what_faces_away_is_in_attached_shadow() -> None:
    sphere = Scene([Solid("ball", ball([0, 0, 0], 0.5), uniform_colour("#ffffff"), 0.0)])
    origins = np.stack([np.full(6, 3.0), np.zeros(6), [0.45, 0.2, 0.1, 0.02, -0.1, -0.4]], axis=1)
    seen = shade_point_light(sphere, origins, np.tile([[-1.0, 0, 0]], (6, 1)), (0.0, 0.0, 5.0), 1.0)
    # The terminator of a light at distance 5 from the middle lies at height 0.5 * 0.5 / 5 = 0.05.
    assert names(seen) == ["lit"] * 3 + ["attached_shadow"] * 3
    assert not seen.unshadowed[3:].any()


def test_the_highlight_lies_where_the_normal_is_the_half_vector() -> None:
    sphere = Scene([Solid("ball", ball([0, 0, 0], 1.0), uniform_colour("#101010"), 0.6, specular=1.5)])
    eye, light = np.array([4.2, 0.0, 1.0]), np.array([1.5, 3.0, 3.0])
    pose, plane = scene_camera_pose(eye), np.tan(FIELD_OF_VIEW / 2)
    image = draw_lit_solids(sphere, pose, light, 128, 1)
    row, column = np.unravel_index(image.rgba[..., 1].argmax(), (128, 128))
    ray = pose[:3, :3] @ [((column + 0.5) / 64 - 1) * plane, (1 - (row + 0.5) / 64) * plane, -1.0]
    hits = sphere.intersect(eye[None], ray[None])
    to_eye, to_light = (v - hits.position[0] for v in (eye, light))
    half = to_eye / np.linalg.norm(to_eye) + to_light / np.linalg.norm(to_light)
    assert hits.normal[0] @ half / np.linalg.norm(half) > np.cos(np.radians(3.0))
    assert image.classes[row, column] == HIGHLIGHT and 0.001 < (image.classes == HIGHLIGHT).mean() < 0.1


def test_a_pixel_has_the_class_of_most_of_its_rays() -> None:
    scene, pose, light = Scene([FLOOR, BLOCK]), scene_camera_pose(np.array([2.0, -3.0, 2.5])), np.array([1.0, 1.0, 4.0])
    coarse, fine = draw_lit_solids(scene, pose, light, 16, 4), draw_lit_solids(scene, pose, light, 64, 1)
    alpha = fine.rgba[..., 3].reshape(16, 4, 16, 4).sum((1, 3))
    np.testing.assert_array_equal(coarse.rgba[..., 3] * 16, alpha)
    blocks = fine.classes.reshape(16, 4, 16, 4).transpose(0, 2, 1, 3).reshape(16, 16, 16)
    for value in (CAST, ATTACHED):
        most = (blocks == value).sum(-1) > alpha / 2
        np.testing.assert_array_equal(coarse.classes == value, most & (alpha >= 8))
    np.testing.assert_array_equal(coarse.classes == 0, alpha < 8)


def test_parts_of_the_test_split_have_seen_what_they_say() -> None:
    found = place_cameras_and_lights(100, 20)
    cameras, lights = ({s.camera.tobytes() for s in found["train"]}, {s.light.tobytes() for s in found["train"]})
    counts = dict.fromkeys(PARTS, 0)
    for view in found["test"]:
        part = next(p for p in PARTS if view.name.startswith(p))
        counts[part] += 1
        assert (view.camera.tobytes() in cameras) == (part == "new_light"), view.name
        assert (view.light.tobytes() in lights) == (part == "new_view"), view.name
    assert list(counts.values()) == [7, 7, 6] and len({s.name for s in found["test"]}) == 20


# ---------------------------------------------------------------- the data set


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(build_lit_solids())


@pytest.fixture(scope="module", autouse=True)
def one_scene(scene: Scene) -> Iterator[None]:
    """Building the scene takes a second: once is enough; nor does the film need all of its frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generator, "Scene", lambda solids: scene)
        patch.setattr(generator, "build_lit_solids", list)
        patch.setattr(generator, "CIRCLE_FRAMES", FEW_FRAMES)
        yield


@pytest.fixture(scope="module")
def context(tmp_path_factory: pytest.TempPathFactory) -> SceneContext:
    return SceneContext(seed=0, cache_dir=tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def forty(context: SceneContext, one_scene: None) -> Dataset:
    """Enough views to mean something."""
    return load({"size": 48, "train_views": 40, "test_views": 12}, context)


def test_the_loader_of_the_layout_reads_the_same_pixels_and_lights(context: SceneContext, scene: Scene) -> None:
    dataset, folder = load(SMALL, context), generate_lit_solids(LitSettings(**SMALL), context.cache_dir)
    plain = load_olat({"path": str(folder), "falloff": "inverse_square"}, context)
    assert len(dataset.train) == 4 and [dataset.test.view(i).name for i in range(3)] == [f"{part}_00" for part in PARTS]
    for mine, theirs in ((dataset.train, plain.train), (dataset.test, plain.test)):
        for i in range(len(mine)):
            a, b = mine.view(i), theirs.view(i)
            assert a.name == b.name and torch.equal(a.camera.viewmat, b.camera.viewmat) and a.camera.fx == b.camera.fx
            assert all(torch.equal(a.conditions[k], b.conditions[k]) for k in ("light", "light_intensity"))
            assert torch.equal(mine.pixels(i).rgb, theirs.pixels(i).rgb)
    view = json.loads((folder / "transforms_train.json").read_text())["frames"][2]
    fresh = draw_lit_solids(scene, np.array(view["transform_matrix"]), np.array(view["pl_pos"]), 24, 2)
    stored = fresh.rgba[..., :3].astype(np.float16).astype(np.float32)
    np.testing.assert_array_equal(dataset.train.pixels(2).rgb.numpy(), stored)
    assert isinstance(dataset.train, ImageViews)
    np.testing.assert_array_equal(read_lit_pixel_classes(dataset.train, 2).numpy(), fresh.classes)


def test_the_data_set_says_what_it_is(context: SceneContext) -> None:
    dataset = load({**SMALL, "background": "random"}, context)
    kind = (dataset.name, dataset.data_source, dataset.color_space, dataset_lighting(dataset).falloff)
    assert kind == ("lit_solids", "generated", "linear", "inverse_square")
    assert dataset.background.tolist() == [0.0, 0.0, 0.0] and dataset.random_background and dataset.exposure == 1.0
    assert not load(SMALL, context).random_background
    conditions = dataset.train.view(0).conditions
    assert conditions["light"].shape == (3,) and 4.0 <= float(conditions["light"].norm()) <= 5.0
    assert conditions["light_intensity"].tolist() == pytest.approx([INTENSITY] * 3)
    assert all(value.dtype == torch.float32 for value in conditions.values())
    (clip,) = relight.relight_clips(dataset)
    assert clip.source is not None and len(clip.views) == len(clip.source) == FEW_FRAMES
    assert clip.name == "light_round" and clip.source.view(1).name == "light_01"
    lights = torch.stack([v.conditions["light"] for v in relight.light_orbit(dataset, 5)])
    assert len(lights.unique(dim=0)) == 5 and bool((lights[:, 2] > 2.0).all())
    assert bool((lights.norm(dim=1) >= 4.0).all() and (lights.norm(dim=1) <= 5.0).all())


def test_classes_agree_with_the_images(forty: Dataset) -> None:
    known = dataset_lighting(forty)
    assert known.classes is not None
    shown, rgb, free = [], [], []
    for i in range(len(forty.test)):
        pixels = forty.test.pixels(i)
        assert pixels.alpha is not None and torch.equal(known.classes(forty.test, i) == 0, pixels.alpha < 0.5)
        shown.append(known.classes(forty.test, i))
        rgb.append(pixels.rgb)
        image = known.baselines["no_cast_shadows"](forty.test, i)
        assert image is not None
        free.append(image)
    kinds, seen, unshadowed = torch.stack(shown), torch.stack(rgb).mean(-1), torch.stack(free).mean(-1)
    assert bool((torch.stack(rgb) <= torch.stack(free) + 1e-3).all())
    by_class = {name: seen[kinds == value] for value, name in enumerate(PIXEL_CLASSES)}
    assert all(len(values) > 3 for values in by_class.values())
    assert by_class["cast_shadow"].mean() < 0.3 * unshadowed[kinds == CAST].mean()
    assert by_class["cast_shadow"].quantile(0.7) == 0  # hard shadows: only edges share a pixel with light
    assert by_class["attached_shadow"].mean() < 0.1 * by_class["lit"].mean() < 0.1 * by_class["highlight"].mean()
    assert by_class["highlight"].min() > 0.2


def test_classes_and_baselines_follow_views_that_are_held_out(forty: Dataset) -> None:
    held, known = hold_out_views(forty, 8), dataset_lighting(forty)
    assert known.classes is not None
    for i in range(len(held.test)):
        alpha = held.test.pixels(i).alpha
        assert alpha is not None and torch.equal(known.classes(held.test, i) == 0, alpha < 0.5)
    assert set(relight.lighting_baseline_scores(held)) == {"black", "no_cast_shadows"}


def test_baselines_rank_as_they_should(forty: Dataset) -> None:
    numbers = relight.diagnose_lighting(forty, None)  # type: ignore[arg-type]  # nothing here depends on the model
    scores = {name: entry["psnr_linear_clamped"] for name, entry in numbers["baselines"].items()}
    assert set(scores) == {"black", "no_cast_shadows", "nearest_light_of_25"}
    assert 8 < scores["black"] < scores["no_cast_shadows"] - 3 < 30
    assert scores["black"] < scores["nearest_light_of_25"] < 35
    shares = numbers["class_percent"]
    assert sum(shares.values()) == pytest.approx(100) and set(shares) == set(PIXEL_CLASSES[1:])
    free = numbers["baselines"]["no_cast_shadows"]
    assert free["psnr_pooled_cast_shadow"] < free["psnr_pooled_lit"] - 8

"""The built-in scene as a data set: files, cache, classes, baselines, and the same pixels through the loader of its
layout."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.data import Dataset
from neuprim.core.data.image_views import ImageViews
from neuprim.core.task import SceneContext
from neuprim.scenes import PIXEL_CLASSES
from neuprim.scenes import lit as generator
from neuprim.scenes.image_set import camera_pose
from neuprim.scenes.lit import (
    INTENSITY,
    PARTS,
    LitSettings,
    build_lit_solids,
    draw_lit_solids,
    generate_lit_solids,
)
from neuprim.scenes.raycast import Scene
from neuprim.tasks.relight import evaluation, olat
from neuprim.tasks.relight.lighting import lighting_of
from neuprim.tasks.relight.lit_solids import classes, load

SMALL = {"size": 24, "train_views": 4, "test_views": 3, "supersampling": 2}
FEW_FRAMES = 4


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(build_lit_solids())


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def one_scene(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Building the scene takes a second: once is enough; nor does the film need all of its frames."""
    monkeypatch.setattr(generator, "Scene", lambda build_lit_solids: scene)
    monkeypatch.setattr(generator, "build_lit_solids", list)
    monkeypatch.setattr("neuprim.scenes.lit.CIRCLE_FRAMES", FEW_FRAMES)
    yield


@pytest.fixture(scope="module")
def forty(cache: Path, scene: Scene) -> Dataset:
    """Enough views to mean something."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generator, "Scene", lambda build_lit_solids: scene)
        patch.setattr("neuprim.scenes.lit.CIRCLE_FRAMES", FEW_FRAMES)
        return load({"size": 48, "train_views": 40, "test_views": 12}, SceneContext(seed=0, cache_dir=cache))


def class_map(dataset: Dataset, index: int) -> torch.Tensor:
    """Of a test view."""
    known = lighting_of(dataset).classes
    assert known is not None
    return known(index)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# What it reads as
# ----------------------------------------------------------------------------------------------------------------------


def test_the_loader_of_the_layout_reads_the_same_pixels_and_lights(cache: Path, scene: Scene) -> None:
    context = SceneContext(seed=3, cache_dir=cache)
    dataset, folder = load(SMALL, context), generate_lit_solids(LitSettings(**SMALL), cache)
    plain = olat.load({"path": str(folder), "falloff": "inverse_square"}, context)
    assert len(dataset.train) == 4 and [dataset.test.view(i).name for i in range(3)] == [f"{part}_00" for part in PARTS]
    for mine, theirs in ((dataset.train, plain.train), (dataset.test, plain.test)):
        for i in range(len(mine)):
            a, b = mine.view(i), theirs.view(i)
            assert a.name == b.name and torch.equal(a.camera.viewmat, b.camera.viewmat) and a.camera.fx == b.camera.fx
            assert all(torch.equal(a.conditions[k], b.conditions[k]) for k in ("light", "light_intensity"))
            assert torch.equal(mine.pixels(i).rgb, theirs.pixels(i).rgb)
    view = json.loads((folder / "transforms_train.json").read_text())["frames"][2]
    pose = np.array(view["transform_matrix"])
    fresh = draw_lit_solids(scene, pose, np.array(view["pl_pos"]), 24, 2)
    np.testing.assert_array_equal(
        dataset.train.pixels(2).rgb.numpy(), fresh.rgba[..., :3].astype(np.float16).astype(np.float32)
    )
    assert isinstance(dataset.train, ImageViews)
    np.testing.assert_array_equal(classes(dataset.train, 2).numpy(), fresh.classes)
    np.testing.assert_allclose(pose, camera_pose(pose[:3, 3]), atol=1e-12)


def test_the_data_set_says_what_it_is(cache: Path) -> None:
    dataset = load({**SMALL, "background": "random"}, SceneContext(seed=0, cache_dir=cache))
    assert (dataset.name, dataset.data_source, dataset.color_space, lighting_of(dataset).falloff) == (
        "lit_solids",
        "generated",
        "linear",
        "inverse_square",
    )
    assert dataset.background.tolist() == [0.0, 0.0, 0.0] and dataset.random_background and dataset.exposure == 1.0
    assert not load(SMALL, SceneContext(seed=0, cache_dir=cache)).random_background
    conditions = dataset.train.view(0).conditions
    assert conditions["light"].shape == (3,) and 4.0 <= float(conditions["light"].norm()) <= 5.0
    assert conditions["light_intensity"].tolist() == pytest.approx([INTENSITY] * 3)
    assert all(value.dtype == torch.float32 for value in conditions.values())
    (clip,) = evaluation.clips(dataset)
    assert clip.source is not None and len(clip.views) == len(clip.source) == FEW_FRAMES
    assert clip.name == "light_round" and clip.source.view(1).name == "light_01"
    views = evaluation.orbit(dataset, 5)
    assert len({v.conditions["light"].numpy().tobytes() for v in views}) == 5
    assert all(
        4.0 <= float(v.conditions["light"].norm()) <= 5.0 and float(v.conditions["light"][2]) > 2.0 for v in views
    )


def test_classes_agree_with_the_images(forty: Dataset) -> None:
    brightness: dict[str, list[torch.Tensor]] = {name: [] for name in PIXEL_CLASSES}
    free_brightness: dict[str, list[torch.Tensor]] = {name: [] for name in PIXEL_CLASSES}
    for i in range(len(forty.test)):
        shown, pixels, free = (
            class_map(forty, i),
            forty.test.pixels(i),
            lighting_of(forty).baselines["no_cast_shadows"](i),
        )
        assert pixels.alpha is not None and torch.equal(shown == 0, pixels.alpha < 0.5)
        assert (pixels.rgb <= free + 1e-3).all()
        for value, name in enumerate(PIXEL_CLASSES):
            mine = shown == value
            brightness[name].append(pixels.rgb[mine].mean(-1))
            free_brightness[name].append(free[mine].mean(-1))
    rgb, free_rgb = ({k: torch.cat(v) for k, v in d.items()} for d in (brightness, free_brightness))
    assert all(len(v) > 3 for v in rgb.values())
    assert rgb["cast_shadow"].mean() < 0.3 * free_rgb["cast_shadow"].mean()
    assert rgb["cast_shadow"].quantile(0.7) == 0  # hard shadows: only edges share a pixel with light
    assert rgb["attached_shadow"].mean() < 0.1 * rgb["lit"].mean() < 0.1 * rgb["highlight"].mean()
    assert rgb["highlight"].min() > 0.2


def test_baselines_rank_as_they_should(forty: Dataset) -> None:
    numbers = evaluation.diagnose(forty, None)  # type: ignore[arg-type]  # nothing here depends on the model
    scores = {name: entry["psnr_linear_clamped"] for name, entry in numbers["baselines"].items()}
    assert set(scores) == {"black", "no_cast_shadows", "nearest_light_of_25"}
    assert (
        8 < scores["black"] < scores["no_cast_shadows"] - 3 < 30
        and scores["black"] < scores["nearest_light_of_25"] < 35
    )
    shares = numbers["class_percent"]
    assert sum(shares.values()) == pytest.approx(100) and set(shares) == set(PIXEL_CLASSES[1:])
    free = numbers["baselines"]["no_cast_shadows"]
    assert free["psnr_pooled_cast_shadow"] < free["psnr_pooled_lit"] - 8

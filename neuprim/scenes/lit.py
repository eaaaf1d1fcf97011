"""Generator of the scene ``lit_solids``: solids under one point light per image, in the file layout of GS³.

    transforms_{train,test,circle}.json    camera_angle_x, poses with OpenGL axes, pl_pos, pl_intensity
    train/r_0000.exr                 RGBA, linear radiance divided by the exposure, premultiplied, half floats
    train/r_0000_unshadowed.exr      the same image without cast shadows
    train/r_0000_classes.png         8-bit grey, index into :data:`neuprim.scenes.PIXEL_CLASSES`
    test/new_light_03_nearest.exr    test views only: the same view, lit by the nearest of 25 training lights

A pixel's class is "background" if fewer than half of its rays hit a surface. Otherwise, the pixel has the class of more
than half of the rays that hit a surface; if there is no such class, the pixel is "lit". The light has the intensity
:data:`INTENSITY` in every image. Scene, cameras and lights do not depend on a seed: equal settings give equal files.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from neuprim.core.io.exr import write_exr
from neuprim.core.validation import Range, validate_fields
from neuprim.scenes import PIXEL_CLASSES
from neuprim.scenes.image_set import (
    ImageSize,
    Progress,
    SceneImageSet,
    Supersampling,
    average_scene_rays,
    hash_scene_settings,
    scene_camera_pose,
    scene_direction,
    scene_ray_bands,
)
from neuprim.scenes.raycast import Scene
from neuprim.scenes.shading import reflectance_lobes, shading_dot
from neuprim.scenes.shapes import FLOOR, Solid, build_solids, lathe, ring, uniform_colour

GENERATOR_VERSION = 1
"""Part of the cache's key: raise it with every change to solids, cameras, lights, shading or file layout."""

DISTANCE = (4.0, 5.0)  # least and largest distance of cameras and lights from the origin, scene units

FIELD_OF_VIEW = 2 * float(np.arcsin(1.19 / DISTANCE[0]))
"""Field of view, radians. The nearest camera sees the whole sphere of radius 1.19 around the origin."""

INTENSITY = 69.2
"""Radiant intensity of the lights divided by the exposure. The value is chosen so that the 99.5th percentile of the
training images is 1 with default settings."""

PARTS = ("new_view", "new_light", "new_both")
"""Parts of the test split: new camera with a training light, training camera with a new light, new camera with a new
light."""

NEAR_LIGHTS = 25  # the baseline "nearest light" knows the lights of this many training images, the first ones

CIRCLE_FRAMES = 36
_CAMERA_POLAR, _LIGHT_POLAR = math.radians(75.0), math.radians(60.0)

_BRIGHT = 0.5 / (np.pi * (sum(DISTANCE) / 2) ** 2)
"""Least radiance of a highlight in the pixel class "highlight", divided by the light's intensity, 1/length^2."""

_LIT, _CAST, _ATTACHED, _HIGHLIGHT = map(PIXEL_CLASSES.index, ("lit", "cast_shadow", "attached_shadow", "highlight"))


@dataclass(frozen=True)
class LitSettings:
    """Settings of ``scene=lit_solids``: image width and height in pixels, images per split, rays per pixel per axis."""

    size: ImageSize = 256
    train_views: Annotated[int, Range(1, 100000)] = 500
    test_views: Annotated[int, Range(1, 10000)] = 100
    supersampling: Supersampling = 2

    def __post_init__(self) -> None:
        validate_fields(self, "scene")

    def key(self) -> str:
        return hash_scene_settings(self, GENERATOR_VERSION)


class LitView(NamedTuple):
    """A view of ``lit_solids``: its name and the (3,) positions of camera and light.

    In test views, ``near_light`` is the training light whose direction is closest, for a simple baseline image.
    """

    name: str
    camera: NDArray[np.float64]
    light: NDArray[np.float64]
    near_light: NDArray[np.float64] | None = None


class LitImage(NamedTuple):
    """Image of ``lit_solids``: linear radiance, radiance without cast shadows, and the class of each pixel.

    ``rgba`` and ``unshadowed`` are (H, W, 4) with premultiplied alpha. ``classes`` (H, W) has indices into
    :data:`neuprim.scenes.PIXEL_CLASSES`.
    """

    rgba: NDArray[np.float32]
    unshadowed: NDArray[np.float32]
    classes: NDArray[np.uint8]


def generate_lit_solids(
    settings: LitSettings, cache_dir: Path, progress: Progress = lambda text, fraction: None
) -> Path:
    """Write the images of ``scene=lit_solids`` unless they exist; return the folder ``cache_dir/lit_solids-KEY``."""

    def draw(scene: Scene, view: LitView, paths: Sequence[Path]) -> None:
        pose, quality = scene_camera_pose(view.camera), (settings.size, settings.supersampling)
        taken = draw_lit_solids(scene, pose, view.light, *quality)
        Image.fromarray(taken.classes).save(paths[2])
        images = [taken.rgba, taken.unshadowed]
        if view.near_light is not None:
            images.append(draw_lit_solids(scene, pose, view.near_light, *quality).rgba)
        for path, image in zip([*paths[:2], *paths[3:]], images, strict=True):
            write_exr(path, torch.from_numpy(image), half=True)

    return SceneImageSet(
        name="lit_solids",
        key=settings.key(),
        size=settings.size,
        splits=place_cameras_and_lights(settings.train_views, settings.test_views),
        lens={"camera_angle_x": FIELD_OF_VIEW, "camera_near": DISTANCE[0] - 1.5, "camera_far": DISTANCE[1] + 1.5},
        build=lambda: Scene(build_lit_solids()),
        frame=_lit_frame_entry,
        files=_lit_solids_image_files,
        draw=draw,
    ).generate(cache_dir, progress)


def _lit_solids_image_files(view: LitView) -> list[str]:
    nearest = [] if view.near_light is None else [f"{view.name}_nearest.exr"]
    return [f"{view.name}.exr", f"{view.name}_unshadowed.exr", f"{view.name}_classes.png", *nearest]


def _lit_frame_entry(split: str, view: LitView) -> dict[str, Any]:
    return {
        "file_path": f"./{split}/{view.name}",
        "file_ext": ".exr",
        "transform_matrix": scene_camera_pose(view.camera).tolist(),
        "pl_pos": view.light.tolist(),
        "pl_intensity": [INTENSITY] * 3,
    }


# ---------------------------------------------------------------- cameras and lights


def place_cameras_and_lights(train_views: int, test_views: int) -> dict[str, list[LitView]]:
    """Return the views of ``lit_solids`` by split: "train", "test", "circle".

    Cameras face the origin. Cameras and lights are 4 to 5 scene units from the origin: cameras at most 75 degrees from
    the zenith, lights at most 60 degrees. Directions are uniform on the spherical cap, and distances are uniform. The
    test split has three :data:`PARTS`, whose sizes differ by one view at most. "circle" is a video from one new camera,
    with a light that goes around the solids once.
    """
    digits = max(4, len(str(train_views)))
    cameras, lights = _draw_lit_positions(1, train_views)
    train = [LitView(f"r_{i:0{digits}d}", cameras[i], lights[i]) for i in range(train_views)]
    new_cameras, new_lights = _draw_lit_positions(2, test_views)
    # Test views with a training light do not use the lights that the baseline knows, if there are others.
    first = NEAR_LIGHTS if train_views > NEAR_LIGHTS else 0
    counts = [(test_views + 2 - part) // 3 for part in range(3)]
    digits = max(2, len(str(test_views)) - 1)
    test = []
    for part, name in enumerate(PARTS):
        for i in range(counts[part]):
            fresh = sum(counts[:part]) + i
            seen = first + i * (train_views - first) // max(counts[part], 1)
            camera = cameras[seen] if name == "new_light" else new_cameras[fresh]
            light = lights[seen] if name == "new_view" else new_lights[fresh]
            near = max(lights[:NEAR_LIGHTS], key=lambda known: float(known @ light / np.linalg.norm(known)))
            test.append(LitView(f"{name}_{i:0{digits}d}", camera, light, near))
    middle = sum(DISTANCE) / 2
    eye = middle * scene_direction(math.cos(math.radians(58.0)), -1.1)
    turns = [2 * math.pi * i / CIRCLE_FRAMES for i in range(CIRCLE_FRAMES)]
    around = [middle * scene_direction(math.cos(math.radians(45.0)), turn) for turn in turns]
    circle = [LitView(f"light_{i:02d}", eye, light) for i, light in enumerate(around)]
    return {"train": train, "test": test, "circle": circle}


def _draw_lit_positions(key: int, count: int) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Draw random positions of ``count`` cameras and lights, seeded by ``key``. A larger ``count`` only adds more."""
    numbers = np.random.default_rng([20241208, key]).random((count, 6))
    return [_position_above_lit_solids(n[:3], _CAMERA_POLAR) for n in numbers], [
        _position_above_lit_solids(n[3:], _LIGHT_POLAR) for n in numbers
    ]


def _position_above_lit_solids(numbers: NDArray[np.float64], polar: float) -> NDArray[np.float64]:
    """Map three numbers 0..1 to a position (3,) whose direction is within ``polar`` radians of the zenith.

    Uniform random numbers give directions that are uniform on the spherical cap.
    """
    cosine = 1.0 - numbers[0] * (1.0 - math.cos(polar))
    return (DISTANCE[0] + numbers[2] * (DISTANCE[1] - DISTANCE[0])) * scene_direction(cosine, 2 * math.pi * numbers[1])


# ---------------------------------------------------------------- drawing


def build_lit_solids() -> list[Solid]:
    """Build the bodies of the scene ``lit_solids``: a slab, a ring, and the bodies of the scene ``solids``.

    The plate of the scene ``solids`` is left out. The slab is bright, so that shadows on it are visible. The ring is
    dark and has highlights.
    """
    thick, edge, major, minor = 0.1, 0.012, 0.235, 0.1
    profile = [(0.0, 1.0 - edge), (edge, 1.0), (thick - edge, 1.0), (thick, 1.0 - edge)]
    slab = lathe([0, 0, FLOOR - thick], [0, 0, 1], profile, sections=256)
    polished = ring([-0.66, 0.2, FLOOR + major + minor], [1.0, 0.35, 0.0], major, minor)
    return [
        Solid("slab", slab, uniform_colour("#c9c2b4"), 0.0),
        *(solid for solid in build_solids() if solid.name != "plate"),
        Solid("glossy ring", polished, uniform_colour("#3a1c4a"), 0.35, specular=2.8),
    ]


def draw_lit_solids(
    scene: Scene, pose: NDArray[np.float64], light: NDArray[np.float64], size: int, supersampling: int
) -> LitImage:
    """Render ``scene`` from ``pose`` (camera to world, OpenGL axes), with a light of :data:`INTENSITY` at ``light``."""
    parts = []
    for directions in scene_ray_bands(pose, FIELD_OF_VIEW, size, supersampling):
        seen = shade_point_light(scene, pose[:3, 3], directions, light, INTENSITY)
        kinds = seen.classes[:, None] == np.arange(len(PIXEL_CLASSES), dtype=np.uint8)
        values = np.concatenate([seen.rgb, seen.unshadowed, kinds], axis=1, dtype=np.float32)
        parts.append(average_scene_rays(values, size, supersampling))
    mean = np.concatenate(parts)
    shares = mean[..., 6:]
    alpha = shares[..., 1:].sum(axis=-1, keepdims=True)
    classes = np.where(alpha[..., 0] < 0.5, 0, _LIT).astype(np.uint8)
    for value in range(2, len(PIXEL_CLASSES)):
        classes[(classes > 0) & (shares[..., value] > alpha[..., 0] / 2)] = value
    rgba, unshadowed = (np.concatenate([colour, alpha], axis=-1) for colour in (mean[..., :3], mean[..., 3:6]))
    return LitImage(rgba, unshadowed, classes)


class ShadedRays(NamedTuple):
    """Result for N shaded rays: (N, 3) linear radiance, with and without cast shadows, and (N,) pixel classes."""

    rgb: NDArray[np.float32]
    unshadowed: NDArray[np.float32]
    classes: NDArray[np.uint8]


def shade_point_light(
    scene: Scene, origins: ArrayLike, directions: ArrayLike, light: ArrayLike, intensity: float
) -> ShadedRays:
    """Cast N rays and shade them under one point light at ``light`` (3,).

    Radiance is (albedo / pi + highlight) * cos(incidence) * intensity / distance^2, or 0 in shadow; the highlight is
    the Blinn-Phong term of :mod:`neuprim.scenes.shading`. The class of a ray is "attached_shadow" if the surface faces
    away from the light, "cast_shadow" if another surface occludes the light, "highlight" if the highlight is brighter
    than the diffuse part and than :data:`_BRIGHT`, and "lit" otherwise. A ray without a hit is "background".
    """
    d = np.asarray(directions, dtype=np.float32)
    hits = scene.intersect(origins, d)
    way = np.asarray(light, dtype=np.float32) - hits.position
    square = shading_dot(way, way)
    to_light = (way / np.sqrt(square)[:, None]).astype(np.float32, copy=False)
    cosine, highlight = reflectance_lobes(hits, -d[hits.hit], to_light)
    facing = (cosine > 0) & (shading_dot(hits.face, to_light) > 0)
    irradiance = np.where(facing, cosine * np.float32(intensity / np.pi) / square, np.float32(0))
    unshadowed = (hits.albedo + highlight[:, None]) * irradiance[:, None]
    starts = hits.lifted()[facing]  # what faces away needs no ray
    visible = facing.copy()
    visible[facing] = ~scene.occluded(starts, np.asarray(light, dtype=np.float32) - starts, 1.0)
    gleam = highlight * irradiance
    shining = visible & (highlight > hits.albedo.max(axis=1)) & (gleam > np.float32(_BRIGHT * intensity))
    classes = np.where(facing, np.where(visible, np.where(shining, _HIGHLIGHT, _LIT), _CAST), _ATTACHED)
    shaded = ShadedRays(np.zeros(d.shape, np.float32), np.zeros(d.shape, np.float32), np.zeros(len(d), np.uint8))
    shaded.rgb[hits.hit] = unshadowed * visible[:, None]
    shaded.unshadowed[hits.hit] = unshadowed
    shaded.classes[hits.hit] = classes
    return shaded

"""Load relighting data, one point light per image: the file layout of GS³ and NRHints, and built-in ``lit_solids``.

Keys of ``transforms_SPLIT.json``:

* in each frame, or for all frames at the top level: the intrinsics of :mod:`neuprim.core.cameras.intrinsics`, and
  ``pl_intensity`` (three numbers or one, default 1)
* at the top level: ``camera_near`` and ``camera_far``, which are only checked
* in each frame: ``pl_pos``, the position of the light
* in each frame, the image: ``img_path``, else ``file_path`` with ``file_ext``. GS³ writes absolute paths of its
  machine, so the longest tail of ``img_path`` that exists is used.
* in each frame, the pose: [R_opt^T | T_opt], world to camera with OpenCV axes, else ``transform_matrix``

PNG and JPEG files contain sRGB with straight alpha and are converted to linear light. OpenEXR files contain linear
light, premultiplied by alpha.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from neuprim.core.cameras import Camera, opengl_to_viewmat
from neuprim.core.data import Clip, Dataset, ViewSet
from neuprim.core.data.dataset import Correction, ViewSubset
from neuprim.core.data.image_views import ImageFrame, ImageViews
from neuprim.core.data.posed_images import (
    IMAGE_SUFFIXES,
    Background,
    FolderSettings,
    HoldOut,
    SceneDetails,
    SplitName,
    assemble_dataset,
    find_data_folder,
    find_image,
    image_frame_in_scene,
)
from neuprim.core.data.transforms_json import TransformsLayout, read_image_frames, read_image_splits
from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.images import read_image
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.task import SceneContext
from neuprim.core.validation import Accepts, Range, validate_settings
from neuprim.scenes.lit import NEAR_LIGHTS, PARTS, LitSettings, generate_lit_solids
from neuprim.tasks.relight.lighting import Lighting, measure_falloff, olat_percentile_exposure

_KEYS = ("camera_near", "camera_far", "img_path", "file_ext", "pl_pos", "pl_intensity", "R_opt", "T_opt")

_CORRECTIONS: dict[str, dict[str, Correction]] = {
    "light": {"light": "offset", "light_intensity": "factor"},
    "camera": {"camera": "pose"},
}


@dataclass(frozen=True)
class OlatSettings(FolderSettings):
    """Settings of ``scene=olat``."""

    background: Background = "black"
    # train_split, test_split: names in transforms_NAME.json
    train_split: SplitName = "train"
    test_split: SplitName = "test"
    # n: for tuning, evaluate on every n-th training view instead of the test split; 0: evaluate on the test split
    hold_out: HoldOut = 0
    # "inverse_square" if the light weakens with the square of its distance; "none" if it does not; "auto": measured
    # from the training images
    falloff: Literal["auto", "none", "inverse_square"] = "auto"
    # "camera": positions of lights are in camera coordinates of each frame, as for a flash: x right, y up, z backward
    light_space: Literal["world", "camera"] = "world"
    # properties of the training views that are known only roughly, and therefore learned with the model: lights (with
    # their intensities), cameras
    refine: list[Literal["light", "camera"]] = field(default_factory=list)
    # divisor of the image values; None for 1; "auto" for the 99.5th percentile of the training images
    exposure: Annotated[float, Range(above=0)] | Literal["auto"] | None = None
    ignore_corrections: bool = False  # read poses from transform_matrix, even if a frame has the optimised R_opt, T_opt


def load_olat(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load ``scene=olat`` (one light at a time) from ``settings["path"]``; values are linear light over exposure."""
    options = validate_settings(OlatSettings, settings, "scene")
    folder = find_data_folder(options.path)
    train, test = read_image_splits(
        folder,
        options.train_split,
        options.test_split,
        options.hold_out,
        lambda split: read_olat_split(folder, split, options),
    )
    details = SceneDetails(
        up=torch.tensor([0.0, 0.0, 1.0]),
        to_linear=True,
        exposure=(lambda views: olat_percentile_exposure(views, str(folder)))
        if options.exposure == "auto"
        else options.exposure or 1.0,
        positions=("light",),
    )
    dataset = assemble_dataset(str(folder), folder.resolve().name, train, test, options, context, details)
    falloff = measure_falloff(dataset) if options.falloff == "auto" else options.falloff
    kinds = {name: kind for part in options.refine for name, kind in _CORRECTIONS[part].items()}
    return replace(dataset, extra=Lighting(falloff), refine=kinds)


def read_olat_split(folder: Path, split: str, options: OlatSettings) -> list[ImageFrame]:
    """Read the views of one split with the conditions "light" (world coordinates) and "light_intensity".

    Raises DataError for missing or wrong fields.
    """
    document = JsonReader.open(folder / f"transforms_{split}.json")
    near = document.number_or("camera_near", 0.0)
    if document.number_or("camera_far", near + 1.0) <= near:
        raise document.fail("camera_far", f"a distance above camera_near, {near:g}")
    layout = TransformsLayout(
        _KEYS, _olat_frame_name, _find_olat_image, lambda record: _olat_viewmat(record, options.ignore_corrections)
    )
    records, frames = read_image_frames(folder, document, list(document.objects("frames")), options, layout)
    lit = []
    for record, frame in zip(records, frames, strict=True):
        light = record.array("pl_pos", (3,), "the point light's position, 3 numbers")
        if options.light_space == "camera":
            light = _light_of_camera(frame.camera, light)
        intensity = _light_intensity(record if record.has("pl_intensity") else document)
        lit.append(replace(frame, conditions={"light": light, "light_intensity": intensity}))
    if split == options.train_split and len(lit) > 1 and len({tuple(f.conditions["light"].tolist()) for f in lit}) == 1:
        warn_once(
            f"{document.where}: pl_pos is the same in all frames, so no image shows the scene under another light; "
            "set scene.light_space=camera if pl_pos is relative to the camera"
        )
    return lit


def _light_of_camera(camera: Camera, light: Tensor) -> Tensor:
    """Convert a point from camera coordinates (x right, y up, z backward) to (3,) world coordinates."""
    view = camera.viewmat.double()
    return view[:3, :3].T @ (light.double() * light.new_tensor([1, -1, -1]) - view[:3, 3])


def _olat_frame_name(record: JsonReader) -> str:
    return record.text("file_path" if record.has("file_path") or not record.has("img_path") else "img_path")


def _find_olat_image(folder: Path, record: JsonReader) -> Path | None:
    """Return the image file of ``record``, an entry of ``frames`` in the JSON file; None if the file is missing."""
    if record.has("img_path"):
        parts = record.text("img_path").replace("\\", "/").split("/")
        tails = (
            _existing_olat_file(folder / "/".join(parts[i:])) for i in range(len(parts))
        )  # an absolute path stays one when joined
        found = next((file for file in tails if file is not None), None)
        if found is not None or not record.has("file_path"):
            return found
    name = record.text("file_path")
    if not record.has("file_ext"):
        return find_image(folder, name)
    suffix = "." + record.text("file_ext").removeprefix(".")
    if suffix not in IMAGE_SUFFIXES:
        raise record.fail("file_ext", "one of .png, .jpg, .jpeg, .webp, .exr")
    return _existing_olat_file(folder / (name.removesuffix(suffix).replace("\\", "/") + suffix))


def _existing_olat_file(path: Path) -> Path | None:
    try:
        return path if path.is_file() else None
    except OSError:  # a name longer than the file system can hold
        return None


def _olat_viewmat(record: JsonReader, ignore_corrections: bool) -> Tensor:
    """Return the (4, 4) float64 world-to-camera matrix, OpenCV axes, of ``record``, a JSON entry in ``frames``.

    The optimised pose (R_opt, T_opt) is used if it exists and is not ignored, else ``transform_matrix``.
    """
    corrected = record.has("R_opt") or record.has("T_opt")
    if not corrected or ignore_corrections:
        if corrected and not record.has("transform_matrix"):
            raise record.fail(
                "transform_matrix", "4 rows of 4 numbers, as scene.ignore_corrections=true leaves R_opt and T_opt out"
            )
        return opengl_to_viewmat(record.matrix("transform_matrix"))
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = record.array("R_opt", (3, 3), "3 rows of 3 numbers, the camera's axes beside T_opt").T
    view[:3, 3] = record.array("T_opt", (3,), "3 numbers beside R_opt")
    return view


def _light_intensity(source: JsonReader) -> Tensor:
    """Return the light's RGB intensity, the JSON value ``pl_intensity``, as (3,) float32; (1, 1, 1) if missing."""
    expected = "3 numbers of at least 0, or one"
    if not source.has("pl_intensity"):
        return torch.ones(3)
    if isinstance(source.values["pl_intensity"], list):
        value = source.array("pl_intensity", (3,), expected)
    else:
        value = torch.full((3,), source.number("pl_intensity", expected), dtype=torch.float64)
    if bool((value < 0).any()):
        raise DataError(f"{source.where}: pl_intensity is {source.values['pl_intensity']}; expected {expected}")
    return value.float()


_Background = Annotated[
    str, Accepts(("black", "random").__contains__, "black or random: nothing but the light shines here")
]


@dataclass(frozen=True)
class LitSolidsSettings(LitSettings):
    """Settings of ``scene=lit_solids``, for rendering the images and for reading them."""

    background: _Background = "black"  # "black", or "random": training composites random colours
    hold_out: HoldOut = 0  # n: for tuning, every n-th training view is a test view; 0: the rendered test split


def load_lit_solids_for_relighting(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load the scene ``lit_solids``, whose images are rendered to ``context.cache_dir`` on first use."""
    options = validate_settings(LitSolidsSettings, settings, "scene")
    drawn = LitSettings(**{f.name: getattr(options, f.name) for f in fields(LitSettings)})
    folder = generate_lit_solids(drawn, context.cache_dir, context.progress)
    reading = {"background": options.background, "hold_out": options.hold_out}
    dataset = load_olat({"path": str(folder), "falloff": "inverse_square", **reading}, context)
    rays = drawn.supersampling
    return replace(
        dataset,
        name="lit_solids",
        data_source="generated",
        background=torch.zeros(3),
        bounds=torch.tensor([[-1.0, -1.0, -0.65], [1.0, 1.0, 1.0]]),
        downsampling=f"rendered at {drawn.size}x{drawn.size}, {rays}x{rays} rays per pixel",
        extra=_lit_solids_olat_lighting(dataset, folder),
    )


def _lit_solids_olat_lighting(dataset: Dataset, folder: Path) -> Lighting:
    """Return the :class:`Lighting` of ``lit_solids``: functions that read pixel classes and two baseline images.

    The result also has the names of the parts of the test split, and a video clip in which the light circles.
    """
    names = {"no_cast_shadows": "unshadowed.exr", f"nearest_light_of_{NEAR_LIGHTS}": "nearest.exr"}
    baselines = {name: partial(_read_lit_companion_image, ending) for name, ending in names.items()}
    views = read_olat_split(folder, "circle", OlatSettings(path=folder))
    circle = ImageViews([image_frame_in_scene(f, dataset.world, ("light",)) for f in views], to_linear=True)
    film = Clip("light_round", range(len(circle)), 12.0, circle)
    return Lighting("inverse_square", read_lit_pixel_classes, PARTS, baselines, (film,))


def read_lit_pixel_classes(views: ViewSet, index: int) -> Tensor:
    """Read the (H, W) uint8 pixel classes of a view: indices into :data:`~neuprim.scenes.PIXEL_CLASSES`."""
    path = _lit_companion_path(views, "classes.png", index)
    try:
        with Image.open(path, formats=("PNG",)) as image:
            return torch.from_numpy(np.array(image))
    except (OSError, SyntaxError) as error:
        raise DataError(f"{path}: damaged ({error}); delete its folder to draw the scene again") from None


def _read_lit_companion_image(ending: str, views: ViewSet, index: int) -> Tensor | None:
    """Read a baseline image (H, W, 3) of a view, from the file VIEW_``ending``; return None if there is no such file.

    ``ending`` is "unshadowed.exr" or "nearest.exr"; training views do not have these files. Values are linear light
    divided by the exposure.
    """
    camera, path = views.view(index).camera, _lit_companion_path(views, ending, index)
    return read_image(path, (camera.width, camera.height))[..., :3].float() if path.is_file() else None


def _lit_companion_path(views: ViewSet, ending: str, index: int) -> Path:
    while isinstance(views, ViewSubset):
        views, index = views.source(index)
    assert isinstance(views, ImageViews)  # as posed_images makes them
    file = views.file(index)
    return file.with_name(f"{file.stem}_{ending}")

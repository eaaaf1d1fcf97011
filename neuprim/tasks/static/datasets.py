"""Load images with known cameras: NeRF-synthetic ("blender"), nerfstudio and COLMAP folders, and generated scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.colmap import (
    PINHOLES,
    colmap_viewmat,
    import_pycolmap,
    largest_colmap_model,
    pinhole_parameters,
    read_colmap_model,
)
from neuprim.core.cameras.intrinsics import is_resized_camera_size
from neuprim.core.cameras.pinhole import check_viewmat
from neuprim.core.data import Dataset, PointCloud
from neuprim.core.data.image_views import Distortion, ImageFrame, find_masks
from neuprim.core.data.points_file import read_points
from neuprim.core.data.posed_images import (
    IMAGE_SUFFIXES,
    BadImageViews,
    EveryNth,
    FolderSettings,
    HoldOut,
    SceneDetails,
    SplitName,
    assemble_dataset,
    exif_hint,
    find_data_folder,
    find_image,
    missing_dataset_files_error,
    split_every_nth,
    unique_view_names,
)
from neuprim.core.data.transforms_json import (
    TransformsLayout,
    read_image_frames,
    read_image_splits,
    split_named_images,
)
from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.images import ImageInfo, image_info
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.task import SceneContext
from neuprim.core.validation import nonempty_text, validate_settings
from neuprim.scenes.room import RoomSettings, generate_room
from neuprim.scenes.solids import SolidsSettings, generate_solids


@dataclass(frozen=True)
class BlenderSettings(FolderSettings):
    """Settings of ``scene=blender``."""

    # train_split, test_split: NAME in transforms_NAME.json
    train_split: SplitName = "train"
    test_split: SplitName = "test"
    # n: every n-th training view becomes a test view, and the real test split is not read; 0: the real test split
    hold_out: HoldOut = 0


def load_blender(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load ``scene=blender``, a NeRF-synthetic folder. Straight-alpha PNGs are premultiplied in sRGB values."""
    asked = validate_settings(BlenderSettings, settings, "scene")
    folder = find_data_folder(asked.path)

    def read(split: str) -> list[ImageFrame]:
        document = JsonReader.open(folder / f"transforms_{split}.json")
        _, frames = read_image_frames(folder, document, list(document.objects("frames")), asked, TransformsLayout())
        for frame in frames:
            info, first = frame.info, frames[0].info
            if (info.width, info.height) != (first.width, first.height):
                expected = f"{first.width}x{first.height} as {frames[0].path}{exif_hint(info)}"
                raise DataError(f"{frame.path}: image is {info.width}x{info.height}; expected {expected}")
        return frames

    train, test = read_image_splits(folder, asked.train_split, asked.test_split, asked.hold_out, read)
    details = SceneDetails(up=torch.tensor([0.0, 0.0, 1.0]))
    return assemble_dataset(str(folder), folder.resolve().name, train, test, asked, context, details)


@dataclass(frozen=True)
class NerfstudioSettings(FolderSettings):
    """Settings of ``scene=nerfstudio``."""

    skip_missing: bool = False  # leave out frames whose image is missing; otherwise they are an error
    test_every: EveryNth = 8  # every n-th frame by name is a test view, unless the file lists the names of the splits


def load_nerfstudio(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load ``scene=nerfstudio``, a nerfstudio or instant-ngp capture. Photographs are undistorted and masked."""
    asked = validate_settings(NerfstudioSettings, settings, "scene")
    folder = find_data_folder(asked.path)
    path = folder / "transforms.json"
    document = JsonReader.open(path)
    records = sorted(document.objects("frames"), key=lambda r: r.text("file_path"))
    layout = TransformsLayout(keys=("ply_file_path", "train_filenames", "val_filenames", "test_filenames"), masks=True)
    records, frames = read_image_frames(folder, document, records, asked, layout, asked.skip_missing)
    train, test = split_named_images(document, records, frames, asked.test_every)
    points = None
    if document.has("ply_file_path"):  # in the frame of the poses
        cloud = folder / document.text("ply_file_path")
        if not cloud.is_file():
            raise missing_dataset_files_error(f"{document.where}: ply_file_path", [str(cloud)])
        points = read_points(cloud, 3, "srgb")
    return assemble_dataset(str(path), folder.resolve().name, train, test, asked, context, SceneDetails(points=points))


@dataclass(frozen=True)
class ColmapSettings(FolderSettings):
    """Settings of ``scene=colmap``."""

    # folder of the images; cameras are scaled to the size of reduced images, such as those in ``images_4``
    images: Annotated[str, nonempty_text("the image folder's name, e.g. images_4")] = "images"
    # folder of the reconstruction; "auto" for the reconstruction in ``sparse`` with most posed images
    model: Annotated[str, nonempty_text("the model's folder, or auto")] = "auto"
    test_every: EveryNth = 8  # every n-th image by name, from the first, is a test view
    skip_missing: bool = False  # leave out images that are missing; otherwise they are an error


def load_colmap(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load ``scene=colmap``, a COLMAP project with its points. Photographs are undistorted.

    Pixels that lie outside a photograph after undistortion are masked.
    """
    asked = validate_settings(ColmapSettings, settings, "scene")
    folder = find_data_folder(asked.path)
    model = folder / asked.model
    if asked.model == "auto":
        largest, line = largest_colmap_model(folder)
        model = largest or folder / "sparse" / "0"
        if line:
            warn_once(f"{line} (scene.model=DIR chooses another)")
    reconstruction = read_colmap_model(model)
    frames = _read_colmap_frames(model, folder, reconstruction, asked)
    train, test = split_every_nth(frames, asked.test_every)
    prefix = "" if asked.images == "images" else asked.images
    points = _read_colmap_dataset_points(reconstruction, model)
    details = SceneDetails(points=points, prefix=prefix, home=folder)
    return assemble_dataset(str(model), folder.resolve().name, train, test, asked, context, details)


def _read_colmap_frames(model: Path, folder: Path, reconstruction: Any, asked: ColmapSettings) -> list[ImageFrame]:
    posed = sorted((i for i in reconstruction.images.values() if i.has_pose), key=lambda i: i.name)
    place = folder / asked.images
    if not posed:
        raise DataError(f"{model}: has no images with a pose; expected at least two")
    if not place.is_dir():
        raise DataError(f"{place}: does not exist; expected the folder of images (scene.images)")
    files = [place / i.name if (place / i.name).is_file() else find_image(place, i.name) for i in posed]
    absent = [i.name for i, file in zip(posed, files, strict=True) if file is None]
    if absent and (not asked.skip_missing or len(absent) == len(posed)):
        hint = "" if asked.skip_missing else "; scene.skip_missing=true leaves such images out"
        raise missing_dataset_files_error(str(place), absent, hint)
    present = [(i, file) for i, file in zip(posed, files, strict=True) if file is not None]
    _warn_of_unposed_images(place, {file for _, file in present}, model)
    masks = find_masks(folder, [file for _, file in present], place)
    names = unique_view_names([i.name for i, _ in present], str(model))
    frames: list[ImageFrame] = []
    bad = BadImageViews(str(model), asked.strict)
    for (image, file), mask, name in zip(present, masks, names, strict=True):
        where = f"{model}: camera {image.camera_id} of image {image.name}"
        read = bad.read(name, _read_colmap_dataset_image, image, file, where)
        if read is None:
            continue
        info, viewmat = read
        camera = _colmap_dataset_camera(where, image, viewmat, file, info)
        lens = reconstruction.cameras[image.camera_id]
        distortion = None if lens.model_name in PINHOLES else _ColmapDatasetLens.of(lens, info)
        frames.append(ImageFrame(name, file, camera.validate(where), info, mask, distortion))
    bad.settle(len(present))
    return frames


def _warn_of_unposed_images(place: Path, posed: set[Path], model: Path) -> None:
    """Warn about images in the folder ``place`` that have no pose in the COLMAP reconstruction ``model``."""
    images = {p for p in place.rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES}
    others = [p for p in images - posed if not p.name.startswith("dynamic_mask_")]
    if others:
        found = f"{len(others)} of {len(posed) + len(others)} images have no pose in {model}, e.g. {min(others).name}"
        warn_once(f"{place}: {found}; left out")


def _read_colmap_dataset_image(image: Any, file: Path, where: str) -> tuple[ImageInfo, Tensor]:
    info, viewmat = image_info(file), colmap_viewmat(image)
    check_viewmat(viewmat, where)
    return info, viewmat


def _colmap_dataset_camera(where: str, image: Any, viewmat: Tensor, file: Path, info: ImageInfo) -> Camera:
    lens = image.camera
    size = f"{lens.width}x{lens.height}"
    if lens.width <= 0 or lens.height <= 0 or not np.isfinite(lens.params).all():
        found = f"image size is {size} and parameters are {lens.params}"
        raise DataError(f"{where}: {found}; expected a positive size and finite parameters")
    if not is_resized_camera_size((lens.width, lens.height), (info.width, info.height)):
        expected = f"{size} ({where}) or a reduction of it{exif_hint(info)}"
        raise DataError(f"{file}: image is {info.width}x{info.height}; expected {expected}")
    fx, fy, cx, cy = pinhole_parameters(lens, where)
    return Camera(viewmat, fx, fy, cx, cy, int(lens.width), int(lens.height)).resized(info.width, info.height)


@dataclass(frozen=True)
class _ColmapDatasetLens(Distortion):
    """Lens distortion of any COLMAP camera model, computed by pycolmap and scaled to the size of the image files."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    scale: tuple[float, float]

    @staticmethod
    def of(lens: Any, info: ImageInfo) -> _ColmapDatasetLens:
        scale = (info.width / lens.width, info.height / lens.height)
        return _ColmapDatasetLens(
            lens.model_name, int(lens.width), int(lens.height), tuple(map(float, lens.params)), scale
        )

    def project(self, points: np.ndarray, camera: Camera) -> np.ndarray:
        size = {"width": self.width, "height": self.height}
        lens = import_pycolmap().Camera(model=self.model, **size, params=list(self.params))
        rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        return np.asarray(lens.img_from_cam(rays), dtype=np.float64) * self.scale


def _read_colmap_dataset_points(reconstruction: Any, model: Path) -> PointCloud | None:
    """Return the points of a COLMAP reconstruction in the order of their ids; None if it has no points."""
    points = [p for _, p in sorted(reconstruction.points3D.items())]
    if not points:
        return None
    means = np.array([p.xyz for p in points], dtype=np.float64)
    colors = np.array([p.color for p in points], dtype=np.float64) / 255.0
    keep = np.isfinite(means).all(axis=1)
    if not keep.all():
        found = f"{int((~keep).sum())} of {len(points)} points are not finite"
        raise DataError(f"{model}: points3D: {found}; expected finite coordinates")
    return PointCloud(torch.from_numpy(means), torch.from_numpy(colors).float())


def load_solids_dataset(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load the built-in scene ``solids``, whose images are rendered to ``context.cache_dir`` on first use."""
    folder = generate_solids(validate_settings(SolidsSettings, settings, "scene"), context.cache_dir, context.progress)
    return replace(load_blender({"path": str(folder)}, context), name="solids", data_source="generated")


def load_room_dataset(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load the built-in scene ``room``, whose images are rendered to ``context.cache_dir`` on first use."""
    folder = generate_room(validate_settings(RoomSettings, settings, "scene"), context.cache_dir, context.progress)
    dataset = load_nerfstudio({"path": str(folder)}, context)
    return replace(dataset, name="room", data_source="generated", up=torch.tensor([0.0, 0.0, 1.0]))

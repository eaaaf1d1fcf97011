"""COLMAP reconstructions: ``sparse/0`` and an image folder; needs the extra ``neuprim[colmap]``.

Sizes may differ from image to image. Distorted models are undistorted to a pinhole of the same focal lengths; what a
photograph does not show is masked out. Reduced copies (``images_4``) scale the cameras to the files' actual sizes.

Settings beside the common ones: ``images`` (folder, default "images"), ``model`` (default "sparse/0"), ``test_every``
(default 8: every 8th image by name, from the first, is a test view) and ``skip_missing`` (default false).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from neuprim.core.cameras import Camera
from neuprim.core.cameras.colmap import PINHOLES, pinhole_of, pycolmap_package, read_model, viewmat_of
from neuprim.core.checked import checked, text
from neuprim.core.data import Dataset, PointCloud
from neuprim.core.data.common import every_nth, missing_files, posed_images, unique_names
from neuprim.core.data.distortion import Distortion
from neuprim.core.data.settings import EveryNth, FolderSettings, data_folder
from neuprim.core.data.views import ImageFrame
from neuprim.core.errors import DataError
from neuprim.core.io.images import ImageInfo, image_info
from neuprim.core.task import SceneContext

__all__ = ["ColmapSettings", "load"]


@dataclass(frozen=True)
class ColmapSettings(FolderSettings):
    """What the user may set.

    Attributes:
        images, model: folders of the images and of the reconstruction.
        test_every: every n-th image is held out.
        skip_missing: leave out images that are missing; otherwise they are an error.
    """

    images: Annotated[str, text("the image folder's name, e.g. images_4")] = "images"
    model: Annotated[str, text("the model's folder")] = "sparse/0"
    test_every: EveryNth = 8
    skip_missing: bool = False


def load(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """The reconstruction in the folder ``settings["path"]``; its 3-D points are the initial points.

    Raises:
        BackendUnavailable: pycolmap is not installed.
        ConfigError: unknown or impossible settings.
        DataError: missing or damaged files, unsupported or impossible cameras, image sizes that are no reduction of the
            model's, no posed images, empty splits.
    """
    asked = checked(ColmapSettings, settings, "scene")
    folder = data_folder(asked.path)
    model = folder / asked.model
    reconstruction = read_model(model)
    frames = _read_frames(model, folder / asked.images, reconstruction, asked.skip_missing)
    train, test = every_nth(frames, asked.test_every)
    prefix = "" if asked.images == "images" else asked.images
    points = _read_points(reconstruction, model)
    return posed_images(str(model), folder.resolve().name, train, test, asked, context, points=points, prefix=prefix, home=folder)


def _read_frames(model: Path, folder: Path, reconstruction: Any, skip_missing: bool) -> list[ImageFrame]:
    images = sorted((i for i in reconstruction.images.values() if i.has_pose), key=lambda i: i.name)
    if not images:
        raise DataError(f"{model}: has no images with a pose; expected at least two")
    if not folder.is_dir():
        raise DataError(f"{folder}: does not exist; expected the folder of images (scene.images)")
    absent = [i.name for i in images if not (folder / i.name).is_file()]
    if absent and (not skip_missing or len(absent) == len(images)):
        raise missing_files(str(folder), absent, "" if skip_missing else "; scene.skip_missing=true leaves such images out")
    images = [i for i in images if i.name not in set(absent)]
    frames = []
    for image, name in zip(images, unique_names([i.name for i in images], str(model)), strict=True):
        file = folder / image.name
        info = image_info(file)
        where = f"{model}: camera {image.camera_id} of image {image.name}"
        camera = _camera(where, image, file, info)
        lens = reconstruction.cameras[image.camera_id]
        distortion = None if lens.model_name in PINHOLES else _Lens.of(lens, info)
        frames.append(ImageFrame(name, file, camera.validate(where), info, None, distortion))
    return frames


def _camera(where: str, image: Any, file: Path, info: ImageInfo) -> Camera:
    lens = image.camera
    if lens.width <= 0 or lens.height <= 0 or not np.isfinite(lens.params).all():
        raise DataError(f"{where}: size {lens.width}x{lens.height}, parameters {lens.params}; expected a positive size, finite numbers")
    # a reduced copy keeps its shape to within the rounding of its sides to whole pixels
    scale = max(info.width / lens.width, info.height / lens.height)
    if abs(lens.width * scale - info.width) > 1.0 or abs(lens.height * scale - info.height) > 1.0:
        raise DataError(f"{file}: image is {info.width}x{info.height}; expected {lens.width}x{lens.height} ({where}) or a reduction of it")
    fx, fy, cx, cy = pinhole_of(lens, where)
    return Camera(viewmat_of(image), fx, fy, cx, cy, int(lens.width), int(lens.height)).resized(info.width, info.height)


@dataclass(frozen=True)
class _Lens(Distortion):
    """Any COLMAP camera model, scaled to the files' size; the projection is COLMAP's own."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    scale: tuple[float, float]

    @staticmethod
    def of(lens: Any, info: ImageInfo) -> _Lens:
        scale = (info.width / lens.width, info.height / lens.height)
        return _Lens(lens.model_name, int(lens.width), int(lens.height), tuple(map(float, lens.params)), scale)

    def project(self, points: np.ndarray, camera: Camera) -> np.ndarray:
        lens = pycolmap_package().Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))
        rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        return np.asarray(lens.img_from_cam(rays), dtype=np.float64) * self.scale


def _read_points(reconstruction: Any, model: Path) -> PointCloud | None:
    """The model's points, in order of their numbers; None where it has none."""
    points = [p for _, p in sorted(reconstruction.points3D.items())]
    if not points:
        return None
    means = np.array([p.xyz for p in points], dtype=np.float64)
    colors = np.array([p.color for p in points], dtype=np.float64) / 255.0
    keep = np.isfinite(means).all(axis=1)
    if not keep.all():
        raise DataError(f"{model}: points3D: {int((~keep).sum())} of {len(points)} points are not finite; expected finite coordinates")
    return PointCloud(torch.from_numpy(means), torch.from_numpy(colors).float())

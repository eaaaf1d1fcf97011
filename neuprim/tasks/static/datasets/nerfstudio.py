"""nerfstudio and instant-ngp captures: one ``transforms.json`` with intrinsics, lens distortion, OpenGL poses and
masks.

Frames are read by :mod:`neuprim.core.data.transforms_json`. Images are undistorted; what a photograph does not show is
masked out, as is what ``mask_path`` blackens, or an image in ``masks/`` where no frame names one.

Settings beside the common ones: ``skip_missing`` (default false: absent images are an error that lists them) and
``test_every`` (default 8: every 8th frame by name is a test view where the file has no ``train_filenames``,
``val_filenames`` or
``test_filenames``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuprim.core.data import Dataset, PointCloud
from neuprim.core.data.points_file import read_points
from neuprim.core.data.posed_images import EveryNth, FolderSettings, data_folder, missing_files, posed_images
from neuprim.core.data.transforms_json import Layout, read_frames, split_frames
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.task import SceneContext
from neuprim.core.validation import validate

__all__ = ["NerfstudioSettings", "load"]


@dataclass(frozen=True)
class NerfstudioSettings(FolderSettings):
    """What the user may set.

    Attributes:
        skip_missing: leave out frames whose image is missing; otherwise they are an error.
        test_every: every n-th frame is held out.
    """

    skip_missing: bool = False
    test_every: EveryNth = 8


def load(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """The capture in the folder ``settings["path"]``.

    Raises:
        ConfigError: unknown or impossible settings.
        DataError: missing or damaged files, wrong or missing fields, impossible cameras, an unknown camera model, empty
        splits.
    """
    asked = validate(NerfstudioSettings, settings, "scene")
    folder = data_folder(asked.path)
    path = folder / "transforms.json"
    document = JsonReader.open(path)
    records = sorted(document.objects("frames"), key=lambda r: r.text("file_path"))
    layout = Layout(keys=("ply_file_path", "train_filenames", "val_filenames", "test_filenames"), masks=True)
    records, frames = read_frames(folder, document, records, asked, layout, asked.skip_missing)
    train, test = split_frames(document, records, frames, asked.test_every)
    points = _read_points(folder, document) if document.has("ply_file_path") else None
    return posed_images(str(path), folder.resolve().name, train, test, asked, context, points=points)


def _read_points(folder: Path, document: JsonReader) -> PointCloud:
    """Points of ``ply_file_path``, in the frame of the poses."""
    path = folder / document.text("ply_file_path")
    if not path.is_file():
        raise missing_files(f"{document.where}: ply_file_path", [str(path)])
    return read_points(path, 3, "srgb")

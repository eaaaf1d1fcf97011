"""nerfstudio and instant-ngp captures: one ``transforms.json`` with intrinsics, lens distortion, OpenGL poses and masks.

Frames are read by :mod:`neuprim.core.data.transforms`. Images are undistorted; what a photograph does not show is masked
out, as is what ``mask_path`` blackens.

Settings beside the common ones: ``skip_missing`` (default false: absent images are an error that lists them) and
``test_every`` (default 8: every 8th frame by name is a test view where the file has no ``train_filenames``/``test_filenames``).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuprim.core.data import Dataset, PointCloud
from neuprim.core.data.common import missing_files, posed_images
from neuprim.core.data.points_file import read_points
from neuprim.core.data.records import Record, read_json
from neuprim.core.data.settings import count, data_folder, flag, read_settings
from neuprim.core.data.transforms import read_frames, split_frames
from neuprim.core.task import SceneContext

__all__ = ["load"]

_SETTINGS = {"skip_missing": flag(False), "test_every": count(8, 2, "a whole number of at least 2")}


def load(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """The capture in the folder ``settings["path"]``.

    Raises:
        ConfigError: unknown or impossible settings.
        DataError: missing or damaged files, wrong or missing fields, impossible cameras, an unknown camera model, empty splits.
    """
    values = read_settings(settings, _SETTINGS)
    folder = data_folder(values["path"])
    path = folder / "transforms.json"
    document = read_json(path)
    records = sorted(document.objects("frames"), key=lambda r: r.text("file_path"))
    records, frames = read_frames(folder, document, records, values["skip_missing"])
    train, test = split_frames(document, records, frames, values["test_every"])
    points = _read_points(folder, document) if document.has("ply_file_path") else None
    return posed_images(str(path), folder.resolve().name, train, test, values, context, points=points)


def _read_points(folder: Path, document: Record) -> PointCloud:
    """Points of ``ply_file_path``, in the frame of the poses."""
    path = folder / document.text("ply_file_path")
    if not path.is_file():
        raise missing_files(f"{document.where}: ply_file_path", [str(path)])
    return read_points(path, 3, "srgb")

"""nerfstudio and instant-ngp captures: one ``transforms.json`` with intrinsics, lens distortion, OpenGL poses and masks.

Intrinsics (``fl_x fl_y cx cy w h``, ``k1 k2 k3 k4 p1 p2``, ``camera_angle_x``, ``camera_model``) may stand in the file or in
a frame, which wins. Images are undistorted; what a photograph does not show is masked out, as is what ``mask_path`` blackens.

Settings beside the common ones: ``skip_missing`` (default false: absent images are an error that lists them) and
``test_every`` (default 8: every 8th frame by name is a test view where the file has no ``train_filenames``/``test_filenames``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from neuprim.core.cameras import Camera, opengl_to_viewmat
from neuprim.core.data import Dataset, PointCloud
from neuprim.core.errors import DataError
from neuprim.core.images import ImageInfo, image_info
from neuprim.core.task import SceneContext
from neuprim.tasks.static.datasets.common import every_nth, find_image, missing_files, posed_images, unique_names
from neuprim.tasks.static.datasets.distortion import Distortion, Fisheye, Radial
from neuprim.tasks.static.datasets.records import Record, read_json
from neuprim.tasks.static.datasets.settings import count, data_folder, flag, read_settings
from neuprim.tasks.static.datasets.views import Frame

__all__ = ["load"]

_SETTINGS = {"skip_missing": flag(False), "test_every": count(8, 2, "a whole number of at least 2")}
_RADIAL = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")


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
    records, frames = _read_frames(folder, document, records, values["skip_missing"])
    train, test = _split(document, records, frames, values["test_every"])
    points = _read_points(folder, document) if document.has("ply_file_path") else None
    return posed_images(str(path), folder.resolve().name, train, test, values, context, points=points)


def _read_frames(folder: Path, document: Record, records: list[Record], skip_missing: bool) -> tuple[list[Record], list[Frame]]:
    """The frames whose files exist, and their records."""
    files = [find_image(folder, r.text("file_path")) for r in records]
    absent = [r.text("file_path") for r, f in zip(records, files, strict=True) if f is None]
    if absent and (not skip_missing or len(absent) == len(records)):
        raise missing_files(document.where, absent, "" if skip_missing else "; scene.skip_missing=true leaves such frames out")
    present = [(r, f) for r, f in zip(records, files, strict=True) if f is not None]
    kept = [r for r, _ in present]
    masks = [_mask_file(folder, r if r.has("mask_path") else document) for r in kept]
    lost = [m for m in masks if isinstance(m, str)]
    if lost:
        raise missing_files(f"{document.where}: mask_path", lost)
    names = unique_names([r.text("file_path") for r in kept], document.where)
    frames = []
    for (record, file), mask, name in zip(present, masks, names, strict=True):
        assert not isinstance(mask, str)
        info = image_info(file)
        merged = Record({**document.values, **{k: v for k, v in record.values.items() if v is not None}}, record.where)
        camera = _camera(merged, file, info)
        distortion = _distortion(merged)
        frames.append(Frame(name, file, camera.validate(record.where), info, mask, distortion))
    return kept, frames


def _mask_file(folder: Path, record: Record) -> Path | str | None:
    """The mask's file, its name where there is no such file, or None where no mask is named."""
    if not record.has("mask_path"):
        return None
    name = record.text("mask_path")
    return find_image(folder, name) or name


def _camera(record: Record, file: Path, info: ImageInfo) -> Camera:
    width = record.count("w") if record.has("w") else info.width
    height = record.count("h") if record.has("h") else info.height
    if (width, height) != (info.width, info.height):
        raise DataError(f"{file}: image is {info.width}x{info.height}; expected {width}x{height} (w, h in {record.where})")
    if record.has("fl_x"):
        fx = record.number("fl_x", "a focal length in pixels above 0", 0.0)
        fy = record.number_or("fl_y", fx, "a focal length in pixels above 0", 0.0)
    elif record.has("camera_angle_x"):
        fx = _focal(record, "camera_angle_x", width)
        fy = _focal(record, "camera_angle_y", height) if record.has("camera_angle_y") else fx
    else:
        raise record.fail("fl_x", "a focal length in pixels (or camera_angle_x), in the frame or in the file")
    cx, cy = record.number_or("cx", 0.5 * width), record.number_or("cy", 0.5 * height)
    return Camera(opengl_to_viewmat(record.matrix("transform_matrix")), fx, fy, cx, cy, width, height)


def _focal(record: Record, key: str, size: int) -> float:
    return 0.5 * size / math.tan(0.5 * record.number(key, "a field of view in radians, between 0 and pi", 0.0, math.pi))


def _distortion(record: Record) -> Distortion | None:
    """The lens; None where all of its coefficients are zero."""
    model = record.text("camera_model") if record.has("camera_model") else "OPENCV"
    fisheye = model == "OPENCV_FISHEYE" or record.values.get("is_fisheye") is True
    if not fisheye and model not in _RADIAL:
        raise record.fail("camera_model", "one of " + ", ".join((*_RADIAL, "OPENCV_FISHEYE")))
    k = [record.number_or(f"k{i}", 0.0) for i in (1, 2, 3, 4)]
    if fisheye:
        return Fisheye(*k)
    p = [record.number_or(f"p{i}", 0.0) for i in (1, 2)]
    return Radial(*k, *p) if any(k) or any(p) else None


def _split(document: Record, records: Sequence[Record], frames: Sequence[Frame], every: int) -> tuple[list[Frame], list[Frame]]:
    """By the file's own lists, the one that is absent being the rest of the frames; else every n-th is a test view."""
    lists = {key: set(map(_plain, document.texts(key))) for key in ("train_filenames", "test_filenames") if document.has(key)}
    if not lists:
        return every_nth(frames, every)
    listed = {_plain(r.text("file_path")): f for r, f in zip(records, frames, strict=True)}
    everything = {_plain(r.text("file_path")) for r in document.objects("frames")}
    for key, names in lists.items():
        unknown = sorted(names - everything)
        if unknown:
            raise missing_files(f"{document.where}: {key} names images that no frame has", unknown)
    if len(lists) == 2 and lists["train_filenames"] & lists["test_filenames"]:
        shared = sorted(lists["train_filenames"] & lists["test_filenames"])
        raise DataError(f"{document.where}: train_filenames and test_filenames share {len(shared)} images, e.g. {shared[0]}; expected none")
    test_names = lists["test_filenames"] if "test_filenames" in lists else everything - lists["train_filenames"]
    train_names = lists["train_filenames"] if "train_filenames" in lists else everything - test_names
    return [f for n, f in listed.items() if n in train_names], [f for n, f in listed.items() if n in test_names]


def _plain(text: str) -> str:
    return text.replace("\\", "/").removeprefix("./")


def _read_points(folder: Path, document: Record) -> PointCloud:
    """Points of ``ply_file_path``, in the frame of the poses; colours sRGB 0..1, mid-grey where the file has none."""
    path = folder / document.text("ply_file_path")
    if not path.is_file():
        raise missing_files(f"{document.where}: ply_file_path", [str(path)])
    try:
        cloud: Any = trimesh.load(path, process=False)
        points = np.asarray(cloud.vertices, dtype=np.float64).reshape(-1, 3)
        raw = cloud.colors if isinstance(cloud, trimesh.PointCloud) else getattr(cloud.visual, "vertex_colors", None)
        colors = None if raw is None else np.asarray(raw)
    except Exception as error:  # trimesh raises many types for damaged files
        raise DataError(f"{path}: not a readable PLY point file ({type(error).__name__}: {error})") from None
    if len(points) == 0 or not np.isfinite(points).all():
        raise DataError(f"{path}: has {len(points)} points or coordinates that are not finite; expected at least one finite point")
    rgb = np.full((len(points), 3), 0.5)
    if colors is not None and colors.shape[:1] == (len(points),) and colors.ndim == 2 and colors.shape[1] >= 3:
        rgb = colors[:, :3] / 255.0
    return PointCloud(torch.from_numpy(points).float(), torch.from_numpy(rgb).float())

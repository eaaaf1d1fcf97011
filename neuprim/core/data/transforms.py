"""The frames of ``transforms.json`` files (instant-ngp, nerfstudio, NeRF-synthetic): cameras, lenses, masks, and their splits.

Intrinsics (``fl_x fl_y cx cy w h``, ``k1 k2 k3 k4 p1 p2``, ``camera_angle_x``, ``camera_model``) may stand in the file or in
a frame, which wins. Poses are camera to world with OpenGL axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from neuprim.core.cameras import Camera
from neuprim.core.cameras.intrinsics import camera_of, is_fisheye
from neuprim.core.data.common import every_nth, find_image, missing_files, unique_names
from neuprim.core.data.distortion import Distortion, Fisheye, Radial
from neuprim.core.data.views import ImageFrame
from neuprim.core.errors import DataError
from neuprim.core.io.images import ImageInfo, image_info
from neuprim.core.io.records import Record

__all__ = ["read_frames", "split_frames"]


def read_frames(folder: Path, document: Record, records: list[Record], skip_missing: bool) -> tuple[list[Record], list[ImageFrame]]:
    """The frames whose images exist, and their records, both in the order of ``records``; names are unique among them.

    Args:
        folder: what paths of images and masks are relative to.
        document: the whole file, which gives what a frame does not.
        skip_missing: leave frames without an image out, unless that leaves none.

    Raises:
        DataError: missing or damaged images, missing masks, wrong or missing fields, impossible cameras, an unknown camera model.
    """
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
        frames.append(ImageFrame(name, file, camera.validate(record.where), info, mask, distortion))
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
    return camera_of(record, width, height)


def _distortion(record: Record) -> Distortion | None:
    """The lens; None where all of its coefficients are zero."""
    fisheye = is_fisheye(record)
    k = [record.number_or(f"k{i}", 0.0) for i in (1, 2, 3, 4)]
    if fisheye:
        return Fisheye(*k)
    p = [record.number_or(f"p{i}", 0.0) for i in (1, 2)]
    return Radial(*k, *p) if any(k) or any(p) else None


def split_frames(
    document: Record, records: Sequence[Record], frames: Sequence[ImageFrame], every: int
) -> tuple[list[ImageFrame], list[ImageFrame]]:
    """(training, test) by ``train_filenames`` and ``test_filenames``, the absent one being the rest; else every n-th is a test view.

    Raises:
        DataError: a list names an image that no frame has, or both lists name one.
    """
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

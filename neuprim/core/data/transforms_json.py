"""Read the frames of ``transforms.json`` files: cameras, lenses, masks and splits.

The reader accepts files of instant-ngp, nerfstudio, BlenderNeRF, NeRF-synthetic, D-NeRF, NRHints and GS³.
:mod:`neuprim.core.cameras.intrinsics` reads intrinsics and lenses. Poses are camera to world with OpenGL axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from neuprim.core.cameras import opengl_to_viewmat
from neuprim.core.cameras.intrinsics import (
    CameraTarget,
    describe_unknown_camera_keys,
    has_fisheye_lens,
    read_camera,
    read_lens_coefficients,
    refuse_unsupported_camera_keys,
)
from neuprim.core.cameras.pinhole import check_viewmat
from neuprim.core.data.image_views import Distortion, FisheyeDistortion, ImageFrame, Mask, RadialDistortion, find_masks
from neuprim.core.data.posed_images import (
    BadImageViews,
    FolderSettings,
    MissingFiles,
    exif_hint,
    find_image,
    missing_dataset_files_error,
    split_every_nth,
    unique_view_names,
)
from neuprim.core.errors import ConfigError, DataError, warn_once
from neuprim.core.io.images import image_info
from neuprim.core.io.json_reader import JsonReader

_POSES = ("transform_matrix", "R_opt", "T_opt")


def _image_frame_path(record: JsonReader) -> str:
    return record.text("file_path")


def _image_frame_viewmat(record: JsonReader) -> Tensor:
    return opengl_to_viewmat(record.matrix("transform_matrix"))


@dataclass(frozen=True)
class TransformsLayout:
    """Description of one variant of the ``transforms.json`` format: how to find a frame's image, pose and mask."""

    keys: tuple[str, ...] = ()  # further keys that the loader reads
    name: Callable[[JsonReader], str] = _image_frame_path  # path of a frame's image, as the file states it
    image: Callable[[Path, JsonReader], Path | None] = lambda folder, frame: find_image(
        folder, _image_frame_path(frame)
    )
    viewmat: Callable[[JsonReader], Tensor] = _image_frame_viewmat  # (4, 4) world to camera, OpenCV axes
    masks: bool = False  # whether to look for a folder ``masks`` next to the images if the file names no mask


def read_image_frames(
    folder: Path,
    document: JsonReader,
    records: list[JsonReader],
    settings: FolderSettings,
    layout: TransformsLayout,
    skip_missing: bool = False,
) -> tuple[list[JsonReader], list[ImageFrame]]:
    """Read frames; return the JSON objects and image frames of all undamaged frames, in the order of ``records``.

    ``records`` are the JSON objects of the frames. ``document`` is the whole file; its fields apply to all frames that
    lack these fields. Paths are relative to ``folder``. ``skip_missing`` leaves out frames whose image is missing,
    unless no frame would remain. Raises DataError for missing images or masks, for wrong, contradictory or unsupported
    fields, if most views are bad, or, with ``settings.strict``, if any view is bad.
    """
    for record in (document, *records):
        refuse_unsupported_camera_keys(record)
    images = [(r, layout.image(folder, r)) for r in records]
    absent = [f"{layout.name(r)}{r.values.get('file_ext') or ''}" for r, file in images if file is None]
    if absent and (not skip_missing or len(absent) == len(records)):
        offered = hasattr(settings, "skip_missing") and not skip_missing
        hint = "; scene.skip_missing=true leaves such frames out" if offered else ""
        raise missing_dataset_files_error(document.where, absent, hint)
    present = [(r, file) for r, file in images if file is not None]
    masks = _find_frame_masks(folder, document, present, layout)
    names = unique_view_names([layout.name(r) for r, _ in present], document.where)
    kept: list[JsonReader] = []
    frames: list[ImageFrame] = []
    bad = BadImageViews(document.where, settings.strict)
    for (record, file), mask, name in zip(present, masks, names, strict=True):
        fisheye = has_fisheye_lens(record, document)  # first, as the other keys have no meaning for an unknown lens
        if not _is_image_pose_damaged(record):
            layout.viewmat(record)  # raises for a missing field or one of another kind, which is not damage
        info = bad.read(name, image_info, file)
        viewmat = None if info is None else bad.read(name, _read_image_pose, record, layout)
        if info is None or viewmat is None:
            continue
        target = CameraTarget(info.width, info.height, str(file), exif_hint(info))
        camera = read_camera(record, document, target, viewmat, warn_once).validate(record.where)
        # a stated size says which way up pixels are
        sized = (record.has("w") or document.has("w")) and info.width != info.height
        if info.orientation > 1 and not (sized and info.orientation > 4):
            what = "images with an EXIF orientation are read as they are stored, as COLMAP reads them"
            warn_once(f"{file.parent}: {what}")
        kept.append(record)
        frames.append(ImageFrame(name, file, camera, info, mask, _read_distortion(record, document, fisheye)))
    bad.settle(len(present))
    unknown = describe_unknown_camera_keys(document, records, layout.keys)
    if unknown:
        warn_once(unknown)
    return kept, frames


def _read_image_pose(record: JsonReader, layout: TransformsLayout) -> Tensor:
    viewmat = layout.viewmat(record)
    check_viewmat(viewmat, record.where)
    return viewmat


def _is_image_pose_damaged(record: JsonReader) -> bool:
    """Return whether the pose of a frame contains NaN or infinity, or consists of zeros."""
    poses = [_image_pose_numbers(record.values.get(key)) for key in _POSES]
    return any(not all(map(math.isfinite, numbers)) for numbers in poses) or bool(poses[0] and not any(poses[0]))


def _image_pose_numbers(value: object) -> list[float]:
    """Return all numbers of a JSON value of nested lists, in one list; huge integers become infinity."""
    if isinstance(value, list):
        return [n for item in value for n in _image_pose_numbers(item)]
    if isinstance(value, int) and not isinstance(value, bool):
        return [float(value)] if abs(value) < 2**1000 else [math.inf]
    return [value] if isinstance(value, float) else []


def _find_frame_masks(
    folder: Path, document: JsonReader, present: Sequence[tuple[JsonReader, Path]], layout: TransformsLayout
) -> list[Mask | None]:
    """Return the mask, or None, of each frame in ``present``: pairs of a JSON object and its image file.

    The key ``mask_path`` of the frame or of the whole file names the mask. If this key is missing everywhere, masks are
    searched next to the images for layouts with ``masks``. Raises MissingFiles if a named mask does not exist.
    """
    if layout.masks and not any(r.has("mask_path") for r in (document, *(r for r, _ in present))):
        return find_masks(folder, [file for _, file in present])
    masks, lost = [], []
    for record, _ in present:
        source = record if record.has("mask_path") else document
        name = source.text("mask_path") if source.has("mask_path") else ""
        file = find_image(folder, name) if name else None
        lost += [name] if name and file is None else []
        masks.append(None if file is None else Mask(file))
    if lost:
        raise missing_dataset_files_error(f"{document.where}: mask_path", lost)
    return masks


def _read_distortion(record: JsonReader, document: JsonReader, fisheye: bool) -> Distortion | None:
    """Return the lens distortion of a frame; None for a pinhole, which has only zero coefficients."""
    lens = read_lens_coefficients(record, document)
    k, p = [lens[f"k{i}"] for i in (1, 2, 3, 4)], [lens["p1"], lens["p2"]]
    if fisheye and any(p):
        found = f"p1, p2 are {p[0]:g}, {p[1]:g} for a fisheye lens, which has only k1 to k4"
        raise DataError(f"{record.where}: {found}; expected 0, or undistorted images")
    if fisheye:
        return FisheyeDistortion(*k)
    return RadialDistortion(*k, *p) if any(k) or any(p) else None


def read_image_splits(
    folder: Path, train: str, test: str, hold_out: int, read: Callable[[str], list[ImageFrame]]
) -> tuple[list[ImageFrame], list[ImageFrame]]:
    """Return the (training, test) frames of a data set with one file ``transforms_SPLIT.json`` per split.

    ``train`` and ``test`` name the splits, and ``read`` returns the frames of a split. If ``hold_out`` is not 0, every
    ``hold_out``-th training view becomes a test view, and the split ``test`` is not read.
    """
    frames = read(train)
    if hold_out:
        if len(frames) < 2:
            found = f"{folder} has only {len(frames)} training view"
            raise ConfigError(f"scene.hold_out is {hold_out}, but {found}; expected at least 2 training views")
        return split_every_nth(frames, hold_out)
    path = folder / f"transforms_{test}.json"
    hint = "; scene.hold_out=8 holds out every 8th training view instead"
    if not path.is_file():
        raise MissingFiles(f"{path}: file not found, so there are no test views{hint}")
    try:
        return frames, read(test)
    except MissingFiles as error:
        raise MissingFiles(f"{error}{hint}") from None


def split_named_images(
    document: JsonReader, records: Sequence[JsonReader], frames: Sequence[ImageFrame], every: int
) -> tuple[list[ImageFrame], list[ImageFrame]]:
    """Split frames into (training, test) by lists of names in the file; without lists, every n-th view is a test view.

    Test views are named by ``test_filenames``, or by ``val_filenames`` if ``test_filenames`` is missing or empty.
    Without these lists, all views that are not training views are test views. Training views are named by
    ``train_filenames``. Without this list, all views in no list are training views, so that validation views are never
    trained on. Raises DataError if a list names an unknown image, or if training and test lists overlap.
    """
    keys = [key for key in ("train_filenames", "val_filenames", "test_filenames") if document.has(key)]
    lists = {key: set(map(_plain_image_path, document.texts(key))) for key in keys}
    if not lists:
        return split_every_nth(frames, every)
    listed = {_plain_image_path(r.text("file_path")): f for r, f in zip(records, frames, strict=True)}
    everything = {_plain_image_path(r.text("file_path")) for r in document.objects("frames")}
    for key, names in lists.items():
        unknown = sorted(names - everything)
        if unknown:
            raise missing_dataset_files_error(f"{document.where}: {key} names images that no frame has", unknown)
    held = [key for key in ("test_filenames", "val_filenames") if key in lists]
    judged = next((key for key in held if lists[key]), held[0] if held else "")
    train_names = lists.get("train_filenames", everything.difference(*(lists[key] for key in held)))
    test_names = lists[judged] if judged else everything - train_names
    shared = sorted(train_names & test_names)
    if shared:
        found = f"train_filenames and {judged} share {len(shared)} images, e.g. {shared[0]}"
        raise DataError(f"{document.where}: {found}; expected no image in both lists")
    return [f for n, f in listed.items() if n in train_names], [f for n, f in listed.items() if n in test_names]


def _plain_image_path(text: str) -> str:
    return text.replace("\\", "/").removeprefix("./")

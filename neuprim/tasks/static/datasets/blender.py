"""NeRF-synthetic ("Blender") scenes: ``transforms_SPLIT.json`` with a field of view, OpenGL poses and RGBA images.

Settings beside the common ones: ``train_split`` and ``test_split`` (names in the files' names, default train and test);
``hold_out`` (default 0; n > 1 makes every n-th training view the test split and leaves the real one unread, for tuning).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from neuprim.core.cameras import Camera, opengl_to_viewmat
from neuprim.core.checked import checked
from neuprim.core.data import Dataset
from neuprim.core.data.common import every_nth, find_image, missing_files, posed_images, unique_names
from neuprim.core.data.settings import FolderSettings, HoldOut, SplitName, data_folder
from neuprim.core.data.views import ImageFrame
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.images import image_info
from neuprim.core.io.records import read_json
from neuprim.core.task import SceneContext

__all__ = ["BlenderSettings", "load"]


@dataclass(frozen=True)
class BlenderSettings(FolderSettings):
    """What the user may set.

    Attributes:
        train_split, test_split: names in transforms_NAME.json.
        hold_out: n: evaluate on every n-th training view instead of the test split; 0 for that split.
    """

    train_split: SplitName = "train"
    test_split: SplitName = "test"
    hold_out: HoldOut = 0


def load(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """The scene in the folder ``settings["path"]``; straight-alpha PNG is premultiplied in its stored sRGB values.

    Raises:
        ConfigError: unknown or impossible settings.
        DataError: missing or damaged files, wrong or missing fields, mixed image sizes, impossible cameras.
    """
    asked = checked(BlenderSettings, settings, "scene")
    folder = data_folder(asked.path)
    train = _read_split(folder, asked.train_split)
    if asked.hold_out:
        if len(train) < 2:
            raise ConfigError(f"scene.hold_out is {asked.hold_out}, but {folder} has only {len(train)} training view; expected at least 2")
        train, test = every_nth(train, asked.hold_out)
    else:
        test = _read_split(folder, asked.test_split)
    return posed_images(str(folder), folder.resolve().name, train, test, asked, context, up=torch.tensor([0.0, 0.0, 1.0]))


def _read_split(folder: Path, split: str) -> list[ImageFrame]:
    path = folder / f"transforms_{split}.json"
    document = read_json(path)
    records = list(document.objects("frames"))
    texts = [r.text("file_path") for r in records]
    files = [find_image(folder, t) for t in texts]
    absent = [t for t, f in zip(texts, files, strict=True) if f is None]
    if absent:
        raise missing_files(str(path), absent)
    frames: list[ImageFrame] = []
    for record, file, name in zip(records, files, unique_names(texts, str(path)), strict=True):
        assert file is not None  # listed above otherwise
        info = image_info(file)
        if frames and (info.width, info.height) != (frames[0].info.width, frames[0].info.height):
            first = frames[0]
            raise DataError(f"{file}: image is {info.width}x{info.height}; expected {first.info.width}x{first.info.height} as {first.path}")
        source = record if record.has("camera_angle_x") else document
        angle = source.number("camera_angle_x", "the horizontal field of view in radians, between 0 and pi", 0.0, math.pi)
        focal = 0.5 * info.width / math.tan(0.5 * angle)
        viewmat = opengl_to_viewmat(record.matrix("transform_matrix"))
        camera = Camera(viewmat, focal, focal, 0.5 * info.width, 0.5 * info.height, info.width, info.height)
        frames.append(ImageFrame(name, file, camera.validate(f"{record.where}.transform_matrix"), info))
    return frames

"""NeRF-synthetic ("Blender") scenes: ``transforms_SPLIT.json`` with a field of view, OpenGL poses and RGBA images.

Frames are read by :mod:`neuprim.core.data.transforms_json`, so that focal lengths, principal points, lenses and masks count,
too (BlenderNeRF).

Settings beside the common ones: ``train_split`` and ``test_split`` (names in the files' names, default train and test);
``hold_out`` (default 0; n > 1 makes every n-th training view the test split and leaves the real one unread, for
tuning).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from neuprim.core.data import Dataset
from neuprim.core.data.image_views import ImageFrame
from neuprim.core.data.posed_images import FolderSettings, HoldOut, SplitName, data_folder, posed_images, turned
from neuprim.core.data.transforms_json import Layout, read_frames, read_splits
from neuprim.core.errors import DataError
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.task import SceneContext
from neuprim.core.validation import validate

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
    asked = validate(BlenderSettings, settings, "scene")
    folder = data_folder(asked.path)

    def read(split: str) -> list[ImageFrame]:
        document = JsonReader.open(folder / f"transforms_{split}.json")
        _, frames = read_frames(folder, document, list(document.objects("frames")), asked, Layout())
        for frame in frames:
            info, first = frame.info, frames[0].info
            if (info.width, info.height) != (first.width, first.height):
                found = (
                    f"image is {info.width}x{info.height}; expected {first.width}x{first.height} as {frames[0].path}"
                )
                raise DataError(f"{frame.path}: {found}{turned(info)}")
        return frames

    train, test = read_splits(folder, asked.train_split, asked.test_split, asked.hold_out, read)
    return posed_images(
        str(folder), folder.resolve().name, train, test, asked, context, up=torch.tensor([0.0, 0.0, 1.0])
    )

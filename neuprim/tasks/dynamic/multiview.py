"""Posed images of a moving scene: ``transforms`` files in the layout of D-NeRF, with a ``time`` in every frame.

Either ``transforms_SPLIT.json`` per split, whose scenes have z upwards, or one ``transforms.json``, of which every n-th
frame by name is a test view unless it lists ``train_filenames``, ``val_filenames`` or ``test_filenames``; where both
are there the splits count. Cameras, lenses and masks are those of :mod:`neuprim.core.data.transforms_json`; images are PNG,
JPEG or OpenEXR.

Each view has the condition "time", a float32 tensor without dimensions, 0..1.

Settings beside the common ones: ``train_split``, ``test_split`` (names in the files' names, default train and test),
``test_every`` (default 8) and ``time_range``: the "LOW:HIGH" of the files' times that becomes 0..1 (default "0:1"), or
"auto" for the lowest and highest time of all frames, those of a train, val or test split that is not used included, so
that a scene has one clock whatever is evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch

from neuprim.core.data import Dataset
from neuprim.core.data.image_views import ImageFrame
from neuprim.core.data.posed_images import (
    EveryNth,
    FolderSettings,
    SceneDetails,
    SplitName,
    assemble_dataset,
    find_data_folder,
)
from neuprim.core.data.transforms_json import TransformsLayout, read_transforms_frames, split_named_frames
from neuprim.core.errors import DataError
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.task import SceneContext
from neuprim.core.validation import Accepts, validate
from neuprim.tasks.dynamic.moving import moving_points

__all__ = ["MultiviewSettings", "load"]

_AUTO = "auto"
_NAMES = ("train", "val", "test")

_Range = tuple[float, float]


def load(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """The scene in the folder ``settings["path"]``; sRGB from PNG and JPEG, linear light from OpenEXR.

    Raises:
        ConfigError: unknown or impossible settings.
        DataError: missing or damaged files, wrong or missing fields, times that are missing or out of range, impossible
            cameras, empty splits.
    """
    asked = validate(MultiviewSettings, settings, "scene")
    folder = find_data_folder(asked.path)
    name, single = folder.resolve().name, folder / "transforms.json"
    files = {split: folder / f"transforms_{split}.json" for split in (asked.train_split, asked.test_split)}
    if not files[asked.train_split].is_file() and single.is_file():
        document = JsonReader.open(single)
        records = sorted(document.objects("frames"), key=lambda r: r.text("file_path"))
        clock = _clock(records, [], asked.time_range)
        records, frames = _frames(asked, document, records, clock)
        train, test = split_named_frames(document, records, frames, asked.test_every)
        return assemble_dataset(str(single), name, train, test, asked, context, SceneDetails(start=moving_points))
    if not any(path.is_file() for path in files.values()):
        raise DataError(
            f"{folder}: has neither {files[asked.train_split].name} nor transforms.json; expected one of them"
        )
    held_out = files[asked.test_split]
    if not held_out.is_file():
        hint = f"rename {files[asked.train_split].name} to transforms.json, of which every 8th frame is a test view (scene.test_every)"
        raise DataError(f"{held_out}: file not found, so there are no views to judge by; {hint}")
    documents = {split: JsonReader.open(path) for split, path in files.items()}
    splits = {split: list(document.objects("frames")) for split, document in documents.items()}
    clock = _clock([r for s in splits.values() for r in s], _others(folder, splits), asked.time_range)
    read = {split: _frames(asked, documents[split], splits[split], clock)[1] for split in splits}
    return assemble_dataset(
        str(folder),
        name,
        read[asked.train_split],
        read[asked.test_split],
        asked,
        context,
        SceneDetails(up=torch.tensor([0.0, 0.0, 1.0]), start=moving_points),
    )


def _frames(
    asked: MultiviewSettings, document: JsonReader, records: list[JsonReader], clock: _Range
) -> tuple[list[JsonReader], list[ImageFrame]]:
    """The frames with their times 0..1, and their records."""
    layout = TransformsLayout(
        keys=("time", "train_filenames", "val_filenames", "test_filenames", "ply_file_path"), masks=True
    )
    records, frames = read_transforms_frames(find_data_folder(asked.path), document, records, asked, layout)
    low, high = clock
    times = [(r.number("time") - low) / (high - low) for r in records]
    return records, [
        replace(f, conditions={"time": torch.tensor(t, dtype=torch.float32)})
        for f, t in zip(frames, times, strict=True)
    ]


# ---------------------------------------------------------------- time


def _clock(records: Sequence[JsonReader], others: Sequence[Path], setting: str) -> _Range:
    """The times that become 0 and 1, after a look at the time of every frame.

    Args:
        records: of all frames in use.
        others: files of further splits, which count for "auto" only.

    Raises:
        DataError: a frame without a time, times that are no finite numbers or out of range, "auto" with a single time.
    """
    if not any("time" in r.values for r in records):
        where = records[0].where.rsplit(": ", 1)[0]
        raise DataError(
            f"{where}: no frame has a time, so this is a static scene; expected a time in every frame, or task=static"
        )
    if setting != _AUTO:
        low, high = _parse_range(setting)
        for record in records:
            time = _time(record)
            if not low <= time <= high:
                expected = (
                    f"a number from {low:g} to {high:g} for {record.text('file_path')} (scene.time_range is {setting!r}"
                )
                raise record.fail("time", f"{expected}; LOW:HIGH or auto maps other times to 0..1)")
        return low, high
    times = [_time(r) for r in records]
    for path in others:
        times += [_time(r) for r in JsonReader.open(path).objects("frames")]
    low, high = min(times), max(times)
    if low == high:
        where = records[0].where.rsplit(": ", 1)[0]
        raise DataError(
            f"{where}: every frame has the time {low:g}; expected at least two different times for scene.time_range=auto"
        )
    return low, high


def _time(record: JsonReader) -> float:
    name = record.text("file_path")
    if "time" not in record.values:
        raise record.fail("time", f"a number for {name}, as other frames have one")
    return record.number("time", f"a finite number for {name}")


def _others(folder: Path, used: Mapping[str, Any]) -> list[Path]:
    """Files of the usual splits that are there and not in use."""
    return [path for name in _NAMES if name not in used and (path := folder / f"transforms_{name}.json").is_file()]


def _parse_range(value: str) -> _Range:
    """The two numbers of "LOW:HIGH"; ValueError where it is something else."""
    low, high = (float(part) for part in value.split(":"))
    if not (math.isfinite(low) and math.isfinite(high) and low < high and math.isfinite(high - low)):
        raise ValueError(value)
    return low, high


def _is_range(value: str) -> bool:
    try:
        return value == _AUTO or bool(_parse_range(value))
    except ValueError:
        return False


@dataclass(frozen=True)
class MultiviewSettings(FolderSettings):
    """What the user may set.

    Attributes:
        train_split, test_split: names in transforms_NAME.json.
        test_every: every n-th frame by name is held out where there is one transforms.json.
        time_range: "LOW:HIGH" of the files' times, mapped to 0..1, or "auto": the lowest and highest time there are.
    """

    train_split: SplitName = "train"
    test_split: SplitName = "test"
    test_every: EveryNth = 8
    time_range: Annotated[str, Accepts(_is_range, 'auto, or "LOW:HIGH" in quotes with LOW below HIGH, e.g. "0:1"')] = (
        "0:1"
    )

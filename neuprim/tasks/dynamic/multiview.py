"""Load images of a moving scene with known cameras: ``transforms`` files as in D-NeRF, with a ``time`` per image.

There is either one ``transforms_SPLIT.json`` per split (z is up), or one ``transforms.json``. If both kinds of files
exist, ``transforms.json`` is ignored. In a ``transforms.json``, every n-th image by name is a test view, unless the
file lists ``train_filenames``, ``val_filenames`` or ``test_filenames``. Each view has the condition "time" (an input of
the model), a 0-dim float32 tensor, 0..1.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.data import Dataset, PointCloud, ViewSet
from neuprim.core.data.dataset import ViewSubset, dataset_axes_meet
from neuprim.core.data.image_views import ImageFrame
from neuprim.core.data.initial import (
    box_starting_points,
    check_point_count,
    drop_repeated_points,
    farthest_points,
    median_colors,
    views_have_alpha,
)
from neuprim.core.data.posed_images import (
    EveryNth,
    FolderSettings,
    SceneDetails,
    SplitName,
    assemble_dataset,
    find_data_folder,
)
from neuprim.core.data.starting_points import EmptyHull, hull_surface, ray_starting_points
from neuprim.core.data.transforms_json import TransformsLayout, read_image_frames, split_named_images
from neuprim.core.errors import DataError
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.task import SceneContext
from neuprim.core.validation import Accepts, validate_settings

_AUTO = "auto"
_TimeRange = tuple[float, float]


def load_moving_multiview(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load a moving scene from the folder ``settings["path"]``: sRGB from PNG and JPEG, linear light from OpenEXR.

    Raises:
        ConfigError: unknown or impossible settings.
        DataError: missing or damaged files, wrong or missing fields, times that are missing or out of range, impossible
            cameras, empty splits.
    """
    options = validate_settings(MultiviewSettings, settings, "scene")
    folder = find_data_folder(options.path)
    name, single = folder.resolve().name, folder / "transforms.json"
    files = {split: folder / f"transforms_{split}.json" for split in (options.train_split, options.test_split)}
    if not files[options.train_split].is_file() and single.is_file():
        document = JsonReader.open(single)
        records = sorted(document.objects("frames"), key=lambda r: r.text("file_path"))
        time_range = _time_range(records, [], options.time_range)
        records, frames = _read_timed_frames(options, document, records, time_range)
        train, test = split_named_images(document, records, frames, options.test_every)
        details = SceneDetails(start=sample_moving_points)
        return assemble_dataset(str(single), name, train, test, options, context, details)
    if not any(path.is_file() for path in files.values()):
        raise DataError(
            f"{folder}: has neither {files[options.train_split].name} nor transforms.json; expected one of them"
        )
    test_file = files[options.test_split]
    if not test_file.is_file():
        raise DataError(
            f"{test_file}: file not found, so there are no test views; rename {files[options.train_split].name} "
            "to transforms.json, of which every 8th frame is a test view (scene.test_every)"
        )
    documents = {split: JsonReader.open(path) for split, path in files.items()}
    splits = {split: list(document.objects("frames")) for split, document in documents.items()}
    names = (name for name in ("train", "val", "test") if name not in splits)
    others = [path for name in names if (path := folder / f"transforms_{name}.json").is_file()]
    time_range = _time_range([r for s in splits.values() for r in s], others, options.time_range)
    frames_of = {split: _read_timed_frames(options, documents[split], splits[split], time_range)[1] for split in splits}
    details = SceneDetails(up=torch.tensor([0.0, 0.0, 1.0]), start=sample_moving_points)
    train, test = frames_of[options.train_split], frames_of[options.test_split]
    return assemble_dataset(str(folder), name, train, test, options, context, details)


def _read_timed_frames(
    options: MultiviewSettings, document: JsonReader, records: list[JsonReader], time_range: _TimeRange
) -> tuple[list[JsonReader], list[ImageFrame]]:
    """Return the JSON records of frames that are used, and the parsed frames with the condition "time", 0..1.

    ``time_range`` has the times in the file that become 0 and 1.
    """
    layout = TransformsLayout(
        keys=("time", "train_filenames", "val_filenames", "test_filenames", "ply_file_path"), masks=True
    )
    records, frames = read_image_frames(find_data_folder(options.path), document, records, options, layout)
    low, high = time_range
    times = [(r.number("time") - low) / (high - low) for r in records]
    return records, [
        replace(f, conditions={"time": torch.tensor(t, dtype=torch.float32)})
        for f, t in zip(frames, times, strict=True)
    ]


# ---------------------------------------------------------------- time


def _time_range(records: Sequence[JsonReader], others: Sequence[Path], setting: str) -> _TimeRange:
    """Return (low, high): the times in the files that become 0 and 1.

    ``setting`` is "LOW:HIGH", or "auto" for the lowest and highest time in ``records`` and in the files ``others`` of
    further splits.

    Raises:
        DataError: a frame has no time, a time is not finite or out of range, or "auto" finds a single time.
    """
    if not any("time" in r.values for r in records):
        where = records[0].where.rsplit(": ", 1)[0]
        raise DataError(
            f"{where}: no frame has a time, so this is a static scene; expected a time in every frame, or task=static"
        )
    if setting != _AUTO:
        low, high = _parse_multiview_time_range(setting)
        for record in records:
            time = _read_time(record)
            if not low <= time <= high:
                expected = f"a number from {low:g} to {high:g} for {record.text('file_path')}"
                why = f"scene.time_range is {setting!r}; LOW:HIGH or auto maps other times to 0..1"
                raise record.fail("time", f"{expected} ({why})")
        return low, high
    times = [_read_time(r) for r in records]
    for path in others:
        times += [_read_time(r) for r in JsonReader.open(path).objects("frames")]
    low, high = min(times), max(times)
    if low == high:
        where = records[0].where.rsplit(": ", 1)[0]
        raise DataError(
            f"{where}: every frame has the time {low:g}; "
            "expected at least two different times for scene.time_range=auto"
        )
    return low, high


def _read_time(record: JsonReader) -> float:
    name = record.text("file_path")
    if "time" not in record.values:
        raise record.fail("time", f"a number for {name}, because other frames have a time")
    return record.number("time", f"a finite number for {name}")


def _parse_multiview_time_range(value: str) -> _TimeRange:
    """Parse "LOW:HIGH" to two numbers; raises ValueError for other text."""
    low, high = (float(part) for part in value.split(":"))
    if not (math.isfinite(low) and math.isfinite(high) and low < high and math.isfinite(high - low)):
        raise ValueError(value)
    return low, high


def _is_time_range(value: str) -> bool:
    try:
        return value == _AUTO or bool(_parse_multiview_time_range(value))
    except ValueError:
        return False


@dataclass(frozen=True)
class MultiviewSettings(FolderSettings):
    """Settings of ``scene=multiview``.

    Attributes:
        train_split, test_split: NAME of the split's file transforms_NAME.json.
        test_every: n; if there is a single transforms.json, every n-th image in the order of names is held out.
        time_range: "LOW:HIGH", the times in the files that become 0 and 1; "auto" for the lowest and highest time.
    """

    train_split: SplitName = "train"
    test_split: SplitName = "test"
    test_every: EveryNth = 8
    time_range: Annotated[
        str, Accepts(_is_time_range, 'auto, or "LOW:HIGH" in quotes with LOW below HIGH, e.g. "0:1"')
    ] = "0:1"


# ---------------------------------------------------------------- starting points

_MIN_SHARED = 2  # least cameras per time for a hull of a single time; with fewer, neighbours in time are added
_RUN_LENGTH = 4  # neighbours in time
_MAX_MOMENTS = 64
_RESOLUTION = 64
_MIN_SEEN_SHARE = 0.75  # share of the cameras that must see a place; half of them often take empty space for matter
_MIN_OPACITY = 0.1  # least opacity of matter; the edges of smoke are seldom more opaque


def sample_moving_points(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
    """Return at most ``count`` distinct starting points of a moving scene.

    Positions are in scene units, colours in the images' colour space. Points lie on visual hulls (the volumes that
    several masks allow). Each hull is computed for one moment, since a hull of all masks would carve away whatever
    moves. Each point has the "time" and the colour of its hull's moment. If several cameras share each time, a moment
    is one time. If every image has its own time, as in D-NeRF, a moment is a run of four successive images. If an
    object moves by less than its size during a run, the hull contains the middle of the object. Runs overlap, so that
    other runs supply the rest.

    If the cameras do not look at a common target, points lie along rays. Without alpha, or if every image has its own
    time and all hulls are empty, points fill a box in front of the cameras at random times.

    Raises:
        ConfigError: ``count`` is not positive.
        DataError: cameras share times, but their masks have no common volume; or an image is damaged.
    """
    check_point_count(count)
    times = torch.stack([views.view(i).conditions["time"] for i in range(len(views))]).float()
    if not dataset_axes_meet([views.view(i).camera for i in range(len(views))]):
        rays, owner = ray_starting_points(views, count, generator, _MIN_OPACITY)
        return drop_repeated_points(PointCloud(rays.means, rays.colors, {"time": times[owner]}))
    if views_have_alpha(views):
        points = _moving_hull_points(views, times, count, generator)
        if points is not None:
            return points
    points = box_starting_points(views, count, generator)
    drawn = torch.randint(len(times), (len(points.means),), generator=generator)
    return PointCloud(points.means, points.colors, {"time": times[drawn]})


def _moving_hull_points(views: ViewSet, times: Tensor, count: int, generator: torch.Generator) -> PointCloud | None:
    """Return starting points on the visual hulls of all moments (times, or runs of successive images).

    The result is None if every image has its own time and all hulls are empty.
    """
    moments, shared = _choose_moments(times)
    surfaces, owners, sides = [], [], []
    empty: EmptyHull | None = None
    for number, (indices, _) in enumerate(moments):
        try:
            surface, side = hull_surface(
                ViewSubset(views, indices), _RESOLUTION, seen_views=_MIN_SEEN_SHARE, matter=_MIN_OPACITY
            )
        except EmptyHull as error:
            empty = error
            continue
        surfaces.append(surface)
        owners.append(torch.full((len(surface),), number))
        sides.append(side)
    if not surfaces:
        if shared and empty is not None:
            raise empty
        return None
    centers, owner = torch.cat(surfaces), torch.cat(owners)
    voxel = torch.cat([torch.full((len(s),), side) for s, side in zip(surfaces, sides, strict=True)])
    rows = _draw_moving_point_per_cell(centers, float(np.median(sides)), generator)
    if count <= len(rows):
        rows = rows[farthest_points(centers[rows], count, generator)]
    else:
        rows = rows[torch.arange(count) % len(rows)]
    jitter = torch.rand((len(rows), 3), generator=generator) - 0.5
    means, owner = centers[rows] + jitter * voxel[rows, None], owner[rows]
    colors = torch.empty_like(means)
    for number in owner.unique().tolist():
        mine = owner == number
        colors[mine] = median_colors(ViewSubset(views, moments[number][0]), means[mine], _MIN_OPACITY)
    when = torch.tensor([time for _, time in moments], dtype=torch.float32)
    return drop_repeated_points(PointCloud(means, colors, {"time": when[owner]}))


def _choose_moments(times: Tensor) -> tuple[list[tuple[list[int], float]], bool]:
    """Return at most 64 moments, (indices of views, time), sorted by time, and whether each moment is a single time.

    ``times`` (V,) are the views' times. If cameras do not share times, a moment is a run of four successive views.
    """
    values = times.tolist()
    sharing = Counter(values)
    shared = float(np.median(list(sharing.values()))) >= _MIN_SHARED
    order = sorted(range(len(values)), key=values.__getitem__)  # stable: equal times stay in order of their views
    if shared:
        moments = [([i for i in order if values[i] == t], t) for t in sorted(sharing) if sharing[t] >= _MIN_SHARED]
    else:
        last = max(0, len(order) - _RUN_LENGTH)
        runs = [order[start : start + _RUN_LENGTH] for start in sorted({*range(0, last + 1, _RUN_LENGTH // 2), last})]
        moments = [(run, values[run[len(run) // 2]]) for run in runs]
    kept = sorted({round(i) for i in np.linspace(0, len(moments) - 1, min(len(moments), _MAX_MOMENTS))})
    return [moments[i] for i in kept], shared


def _draw_moving_point_per_cell(points: Tensor, side: float, generator: torch.Generator) -> Tensor:
    """Return the indices of one random point per cubic cell of edge ``side``.

    Static surfaces occur in the hulls of all moments. Selecting one point per cell removes these repetitions.
    """
    shuffled = torch.randperm(len(points), generator=generator)
    cells = ((points[shuffled] - points.min(0).values) / side).floor().long().numpy()
    _, first = np.unique(cells, axis=0, return_index=True)
    return shuffled[torch.from_numpy(np.sort(first))]

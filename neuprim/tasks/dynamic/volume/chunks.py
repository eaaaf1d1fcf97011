"""Split a long sequence into chunks of time that are trained separately, and join their models.

Chunks divide the training frames evenly, in order. Each also sees a few frames beyond its ends, over which
neighbouring chunks are blended (:mod:`neuprim.tasks.dynamic.density`). Times, box, cameras and exposure are those of
the whole sequence, so that nothing has to be converted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from neuprim.core.errors import ConfigError
from neuprim.core.io.vdb import VdbFrame
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import Chunk, Chunks
from neuprim.tasks.dynamic.density import ChunkOverlaps, TimeDensity
from neuprim.tasks.dynamic.volume.capture import Capture

MAX_FRAMES, MIN_FRAMES = 100, 25
"""Frames of an automatic chunk: primitives are active for much of a sequence, and short chunks cut that short."""

_TIME_POWERS = {"window_center": 1, "velocity": -1, "acceleration": -2, "W_t": -1}
"""Parameters in units of the sequence's time -> power of time in them."""

_FRAMES_PER_OVERLAP, _MAX_OVERLAP = 8, 3
"""A chunk sees one frame beyond each end per eight of its own, from one to three. An abrupt change of models is visible
where little moves; frames in two chunks cost both of them."""


def count_chunks(requested: int | str | None, frames: int, image_bytes: int, memory: float) -> int:
    """Number of chunks: the requested one, or for "auto" enough that none has more than :data:`MAX_FRAMES` frames and
    the images of each fit in memory, but not so many that one has fewer than :data:`MIN_FRAMES`.

    Args:
        frames: for training.
        image_bytes, memory: bytes of all decoded training images, and of those that a run keeps in memory.

    Raises:
        ConfigError: fewer than two frames per chunk.
    """
    if requested == "auto":
        wanted = max(math.ceil(frames / MAX_FRAMES), math.ceil(image_bytes / memory))
        return max(min(wanted, frames // MIN_FRAMES), 1)
    count = int(requested or 1)
    if count > 1 and 2 * count > frames:
        reason = "a chunk has at least two of its own"
        expected = f"at most {frames // 2}, as {reason}" if frames >= 4 else f"null: {reason}"
        available = "is 1 frame" if frames == 1 else f"are {frames} frames"
        raise ConfigError(f"scene.chunks={count}: there {available} to learn from; expected {expected}")
    return count


def plan_chunks(
    capture: Capture, every: int, count: int, weight: Callable[[VdbFrame], float], config: Mapping[str, Any]
) -> Chunks | None:
    """Plan the chunks of a sequence; None if no frame holds anything.

    Args:
        every: every n-th frame is used for training.
        count: two or more chunks of at least two frames each.
        weight: total extinction of a frame; primitives are divided by it, like the starting points of one run.
        config: of the run, nested by the keys of the command line.
    """
    frames = capture.frames[::every]
    begins = [number * len(frames) // count for number in range(count + 1)]
    times = [float(torch.tensor(capture.time(frame))) for frame in frames]  # float32 as in views
    extra = min(max(len(frames) // count // _FRAMES_PER_OVERLAP, 1), _MAX_OVERLAP)
    overlaps = tuple((times[begin - extra], times[begin + extra - 1]) for begin in begins[1:-1])
    chunk_frames = [frames[max(begin - extra, 0) : end + extra] for begin, end in itertools.pairwise(begins)]
    weights = [sum(map(weight, part)) for part in chunk_frames]
    used = [number for number in range(count) if weights[number] > 0]  # a chunk without matter cannot be trained
    if not used:
        return None
    total_frames = sum(len(chunk_frames[number]) for number in used)
    width = max(len(str(frame.number)) for frame in frames)
    chunks = []
    for number in used:
        part = chunk_frames[number]
        first, last = part[0].number, part[-1].number
        changes = {"scene.chunks": None, "scene.span": f"{first}:{last}", **_rescale_time(capture, part, config)}
        name = f"frames_{first:0{width}}-{last:0{width}}"
        chunks.append(Chunk(name, changes, weights[number] / sum(weights), len(part) / total_frames))
    return Chunks(tuple(chunks), lambda models: join_chunks(models, used, overlaps))


def _rescale_time(capture: Capture, frames: Sequence[VdbFrame], config: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a chunk's training: learning rates as for a sequence of the chunk's length, windows at most that."""
    length = capture.time(frames[-1]) - capture.time(frames[0])
    density = TimeDensity(config["model"]["neurons"], **config["model"]["density"])
    rates = {spec.name: config["train"]["rates"].get(spec.name, spec.lr) for spec in density.parameters()}
    settings: dict[str, Any] = {
        f"train.rates.{name}": rates[name] * length**power for name, power in _TIME_POWERS.items() if name in rates
    }
    window = config["model"]["init"].get("window")
    if isinstance(window, int | float) and window > length:
        settings["model.init.window"] = length
    return settings


def join_chunks(models: Sequence[Primitives], numbers: Sequence[int], overlaps: ChunkOverlaps) -> Primitives:
    """Join the models of chunks: at every time their extinctions and sources, weighted by their chunks' weights.

    Args:
        models: all of one form, in the whole sequence's time.
        numbers: of their chunks, 0 to len(overlaps); missing chunks are empty.
        overlaps: of neighbouring chunks.

    Raises:
        ConfigError: forms differ, or are joined models already.
    """
    first = models[0]
    for model in models:
        if not isinstance(model.density, TimeDensity) or model.density.seams:
            raise ConfigError(
                f"a chunk's density is {type(model.density).__name__} {model.density.settings()}; "
                "expected a TimeDensity without seams"
            )
        if any(getattr(model, kind).settings() != getattr(first, kind).settings() for kind in ("density", "colour")):
            raise ConfigError(
                f"chunks have models of different forms: {first.density.settings()} and {model.density.settings()}"
            )
    density = TimeDensity(**{**first.density.settings(), "seams": overlaps})
    params = {name: torch.cat([model.params[name].detach().cpu() for model in models]) for name in first.params}
    params["chunk"] = torch.cat(
        [torch.full((model.count, 1), float(number)) for number, model in zip(numbers, models, strict=True)]
    )
    specs = Primitives(density, first.colour, params).specs
    return Primitives(density, first.colour, {spec.name: params[spec.name] for spec in specs})

"""A long sequence in chunks of time: which frames each sees, what share of the work it gets, and how their models
become one.

Chunks share out the frames that are learned from, in order and evenly. Each also sees a few frames beyond its ends, so
that across a seam two chunks know the same frames, and over these one hands over to the other
(:mod:`neuprim.tasks.dynamic.seams`). Times, box, cameras and exposure are those of the whole sequence, so that nothing
has to be converted.
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
from neuprim.tasks.dynamic.density import TimeDensity
from neuprim.tasks.dynamic.seams import Seams
from neuprim.tasks.dynamic.volume.capture import Capture

__all__ = ["FRAMES", "FEWEST", "joined", "number_of_chunks", "planned"]

FRAMES = 100
"""Frames of a chunk, at most, where their number is left to us."""

FEWEST = 25
"""Frames of a chunk, at least, where their number is left to us: primitives live for a good part of a sequence, and a
seam ends their lives."""

_IN_TIME = {"window_center": 1, "velocity": -1, "acceleration": -2, "W_t": -1}
"""Parameters that are measured in the sequence's time, and the power of time in them."""

_BEYOND, _MOST_BEYOND = 8, 3
"""A chunk sees beyond its ends one frame for so many of its own, one at least and so many at most: a hand-over of one
step in time is sudden where little moves, and frames that two chunks learn cost both."""


def number_of_chunks(asked: int | str | None, frames: int, images: int, memory: float) -> int:
    """How many: what was asked for; ``auto``: so many that none has more than :data:`FRAMES` frames and the images of
    each stay in memory, but not so many that one has fewer than :data:`FEWEST`.

    Args:
        frames: that are learned from.
        images, memory: bytes of all decoded training images, and of those that a run keeps.

    Raises:
        ConfigError: fewer than two frames for each.
    """
    if asked == "auto":
        wanted = max(math.ceil(frames / FRAMES), math.ceil(images / memory))
        return max(min(wanted, frames // FEWEST), 1)
    count = int(asked or 1)
    if count > 1 and 2 * count > frames:
        most = (
            f"at most {frames // 2}, as a chunk has at least two of its own"
            if frames >= 4
            else "null: a chunk has at least two of its own"
        )
        raise ConfigError(
            f"scene.chunks={count}: there {'is 1 frame' if frames == 1 else f'are {frames} frames'} to learn from; expected {most}"
        )
    return count


def planned(
    capture: Capture, every: int, count: int, weight: Callable[[VdbFrame], float], config: Mapping[str, Any]
) -> Chunks | None:
    """The chunks of a sequence; None where no frame holds anything.

    Args:
        capture: of the whole sequence.
        every: every n-th frame is learned from.
        count: of chunks, two or more; each has at least two of the frames.
        weight: of a frame, its total extinction: chunks share out the primitives by it, as the starting points of one
        run are. config: of the run, in the layout of the command line's keys.
    """
    frames = capture.frames[::every]
    begins = [number * len(frames) // count for number in range(count + 1)]
    times = [
        float(torch.tensor(capture.time(frame))) for frame in frames
    ]  # as views have them, so that no share is nearly 0 or 1
    beyond = min(max(len(frames) // count // _BEYOND, 1), _MOST_BEYOND)
    seams = tuple((times[begin - beyond], times[begin + beyond - 1]) for begin in begins[1:-1])
    seen = [frames[max(begin - beyond, 0) : end + beyond] for begin, end in itertools.pairwise(begins)]
    weights = [sum(map(weight, own)) for own in seen]
    lit = [
        number for number in range(count) if weights[number] > 0
    ]  # in a chunk without any matter there is nothing to fit
    if not lit:
        return None
    steps = sum(len(seen[number]) for number in lit)
    width = max(len(str(frame.number)) for frame in frames)
    parts = tuple(
        Chunk(
            f"frames_{own[0].number:0{width}}-{own[-1].number:0{width}}",
            {"scene.chunks": None, "scene.span": f"{own[0].number}:{own[-1].number}", **_in_time(capture, own, config)},
            weights[number] / sum(weights),
            len(own) / steps,
        )
        for number, own in ((number, seen[number]) for number in lit)
    )
    return Chunks(parts, lambda models: joined(models, lit, seams))


def _in_time(capture: Capture, own: Sequence[VdbFrame], config: Mapping[str, Any]) -> dict[str, Any]:
    """What a chunk's training has other than that of one run, as time goes faster in it: rates of what is measured in
    the sequence's time are those of a sequence that is as long as the chunk, and windows start no longer than the
    chunk."""
    length = capture.time(own[-1]) - capture.time(own[0])
    density = TimeDensity(config["model"]["neurons"], **config["model"]["density"])
    rates = {spec.name: config["train"]["rates"].get(spec.name, spec.lr) for spec in density.parameters()}
    found: dict[str, Any] = {
        f"train.rates.{name}": rates[name] * length**power for name, power in _IN_TIME.items() if name in rates
    }
    window = config["model"]["init"].get("window")
    if isinstance(window, int | float) and window > length:
        found["model.init.window"] = length
    return found


def joined(models: Sequence[Primitives], numbers: Sequence[int], seams: Seams) -> Primitives:
    """One model of the models of a sequence's chunks: at every time their extinctions and sources, weighted by their
    shares.

    Args:
        models: all of one form, in the whole sequence's time.
        numbers: of their chunks, 0 to len(seams); a chunk that is not among them has nothing.
        seams: between the chunks.

    Raises:
        ConfigError: forms differ, or have seams already.
    """
    first = models[0]
    for model in models:
        if not isinstance(model.density, TimeDensity) or model.density.seams:
            raise ConfigError(
                f"a chunk's density is {type(model.density).__name__} {model.density.settings()}; expected a TimeDensity without seams"
            )
        if any(getattr(model, kind).settings() != getattr(first, kind).settings() for kind in ("density", "colour")):
            raise ConfigError(
                f"chunks have models of different forms: {first.density.settings()} and {model.density.settings()}"
            )
    density = TimeDensity(**{**first.density.settings(), "seams": seams})
    params = {name: torch.cat([model.params[name].detach().cpu() for model in models]) for name in first.params}
    params["chunk"] = torch.cat(
        [torch.full((model.count, 1), float(number)) for number, model in zip(numbers, models, strict=True)]
    )
    made = Primitives(density, first.colour, params)
    return Primitives(density, first.colour, {spec.name: params[spec.name] for spec in made.specs})

"""What the user may set for a scene made of OpenVDB files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from neuprim.core.errors import ConfigError, DataError
from neuprim.core.validation import Accepts, Range, coerce, nonempty_text, validate_fields
from neuprim.scenes.smoke.generate import TIMESTEPS, Resolution

__all__ = ["GRIDS", "Axis", "Meaning", "VolumeSettings", "choose_frames"]

Axis = Literal["y", "z"]
"""The upward one of a sequence's files."""

Meaning = Literal["density", "temperature", "flames", "color"]

GRIDS: tuple[str, ...] = get_args(Meaning)
"""What a grid may mean; ``scene.grids.MEANING=NAME`` says which grid of the files has it."""


def _span(frames: str) -> range | None:
    """The numbers that "FIRST:LAST" or "FIRST:LAST:STEP" names, LAST included; None for text of another form."""
    match = re.fullmatch(r"(\d{1,9}):(\d{1,9})(?::(\d{1,9}))?", frames)
    if match is None or (step := int(match[3] or 1)) < 1 or int(match[1]) > int(match[2]):
        return None
    return range(int(match[1]), int(match[2]) + 1, step)


Span = Annotated[str, Accepts(lambda v: v.count(":") == 1 and _span(v) is not None, "FIRST:LAST, as 0:19")]
Frames = Annotated[
    str, Accepts(lambda v: v == "all" or _span(v) is not None, "all, FIRST:LAST or FIRST:LAST:STEP, as 0:100:2")
]


@dataclass(frozen=True)
class VolumeSettings:
    """Settings of a volume scene.

    Attributes:
        vdb: folder of .vdb files, or None to simulate.
        simulation: name of the built-in simulation.
        resolution: voxels across the simulation's box.
        timesteps: of the simulation; None: as many as the scene has.
        frames: "all", "FIRST:LAST" or "FIRST:LAST:STEP" by number, LAST included.
        span: "FIRST:LAST" by number, the frames to learn from and to be judged by; times, box, exposure and images stay
        those of all ``frames``.
            None: all.
        chunks: in how many chunks of time the sequence is fitted, each a run of its own; "auto": see
            :func:`~neuprim.tasks.dynamic.volume.chunks.number_of_chunks`; None or 1: in one.
        grids: meaning -> name in the files.
        look: name of a preset of the optics, or "auto"; optics: changes to its settings.
        size: width and height of the images in pixels.
        cameras: on the upper hemisphere; two are held out.
        field_of_view: of the cameras, degrees.
        samples: rays per pixel side.
        train_every: learn from every n-th frame only; the test views keep all.
        up: "y" or "z", the upward axis of the files.
        cache: folder or URL where the ground truth is kept; None: the cache of this machine's user.
        memory: MiB of decoded images and voxels that stay in memory, however long the sequence is; beyond them they are
        read again when needed.
    """

    vdb: Annotated[Path, nonempty_text("a folder of .vdb files")] | None = None
    simulation: str | None = None
    resolution: Resolution = 64
    timesteps: Annotated[int, Range(2, TIMESTEPS[1])] | None = None
    frames: Frames = "all"
    span: Span | None = None
    chunks: Annotated[int, Range(1, 1000)] | Literal["auto"] | None = None
    grids: Mapping[Meaning, Annotated[str, nonempty_text("the name of a grid")]] = field(default_factory=dict)
    look: str = "auto"
    optics: Mapping[str, Any] = field(default_factory=dict)
    size: Annotated[int, Range(8, 4096)] = 160
    cameras: Annotated[int, Range(4, 1000)] = 40
    field_of_view: Annotated[float, Range(1, 120, says="degrees from 1 to 120")] = 27.0
    samples: Annotated[int, Range(1, 16)] = 2
    train_every: Annotated[int, Range(1, 1000)] = 1
    up: Axis = "z"
    cache: Annotated[str, nonempty_text("a folder, or a URL as s3://BUCKET/FOLDER")] | None = None
    memory: Annotated[int, Range(1, 2**20)] = 1408

    def __post_init__(self) -> None:
        validate_fields(self, "scene")
        if self.vdb is None and self.simulation is None:
            raise ConfigError("scene.vdb: required and not given; expected a folder of .vdb files")
        if self.span is not None and self.chunks is not None:
            raise ConfigError(
                f"scene.chunks={self.chunks}: chunks are spans of all chosen frames; expected no scene.span beside it, but scene.frames"
            )

    @property
    def span_numbers(self) -> tuple[int, int]:
        """First and last number of ``span``, which is given."""
        assert self.span is not None
        first, _, last = self.span.partition(":")
        return int(first), int(last)


def choose_frames(frames: str, numbers: Sequence[int], where: str = "the sequence") -> list[int]:
    """Those of the ascending ``numbers`` of a sequence that ``scene.frames`` names.

    Raises:
        ConfigError: another form than "all", "FIRST:LAST" or "FIRST:LAST:STEP".
        DataError: none of the frames exists.
    """
    span = _span(coerce(frames, Frames, "scene.frames"))
    if span is None:
        return list(numbers)
    chosen = [n for n in numbers if n in span]
    if numbers and not chosen:
        raise DataError(f"scene.frames={frames}: {where} has frames {numbers[0]} to {numbers[-1]}, and none of these")
    return chosen

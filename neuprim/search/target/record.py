"""What a search asked, tried, predicted and achieved, as ``target.json`` holds it; a search that was interrupted goes
on from there."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.files import read_json, write_json
from neuprim.core.validation import validate

__all__ = ["FILE", "Attempt", "Purpose", "Record", "Setting", "Turn", "read_record"]

FILE = "target.json"
"""Of the run's directory."""

FORMAT = 1

Purpose = Literal["pace", "size", "knob", "longer", "full"]

Setting = int | float | str
"""A value of a setting that a search turns."""


@dataclass
class Attempt:
    """One training of the search.

    Attributes:
        purpose: what it was to tell; "full" is a candidate for the result.
        words: settings turned beside the number of primitives, e.g. {"model.sh_degree": 1}.
        primitives, steps: as asked.
        max_seconds: of a full run, which ends with it; None for trials, whose steps alone end them.
        predicted: measure -> [value, doubt], as it was predicted before; empty for trials.
        outcome: what came out, on the training views held out; see :class:`neuprim.search.trials.Outcome`.
        packed: bytes of the model when compressed at the usual level.
        pace: seconds of a step, and seconds: of all of it, by the search's clock.
    """

    purpose: Purpose
    words: dict[str, Setting]
    primitives: int
    steps: int
    max_seconds: float | None = None
    predicted: dict[str, list[float]] = field(default_factory=dict)
    outcome: dict[str, Any] | None = None
    packed: int = 0
    pace: float | None = None
    seconds: float = 0.0

    @property
    def folder(self) -> str:
        """Its name in the search's folder."""
        turned = [f"{key.rpartition('.')[2]}-{value}" for key, value in sorted(self.words.items())]
        limit = [] if self.max_seconds is None else [f"{self.max_seconds:g}s"]
        return "_".join(
            [f"{'full-' if self.purpose == 'full' else ''}{self.primitives}", *turned, f"{self.steps}-steps", *limit]
        )

    def quality(self, name: str) -> float:
        """A measure of what came out."""
        assert self.outcome is not None
        return float(self.outcome[name])

    @property
    def count(self) -> int:
        """Primitives that it had in the end."""
        assert self.outcome is not None
        return int(self.outcome["primitives"])


@dataclass
class Turn:
    """A setting that was turned to save bytes.

    Attributes:
        loss: measure -> what it costs, dB (:func:`~neuprim.search.target.prediction.decibels`), at equal primitives.
        size: bytes of a primitive over those before.
        adopted: whether the model is smaller with it, primitives that make up for the loss included.
    """

    key: str
    before: Setting
    after: Setting
    loss: dict[str, float]
    size: float
    adopted: bool


@dataclass
class Record:
    """All of it.

    Attributes:
        asked: the target and its budget, seconds.
        same: what must be the same for trainings to be kept.
        hold_out: every n-th training view is held out of the trainings and judges them.
        stage: how many of the search's stages are over.
        length: steps of a trial; 0 until it is known how fast the machine is.
        spent: seconds of the budget that are used.
        before: full runs that were there when this was asked, made for another target.
        chosen: folder of the full run that was chosen.
        achieved: what the result has: measures on the test views and on the views held out, bytes, frames per second.
        out_of_reach: the line that says so, where the trials alone do.
        why: why the search ended as it did, a line each; warning: the line that says that the target was missed.
    """

    asked: dict[str, float]
    same: dict[str, Any]
    hold_out: int = 0
    stage: int = 0
    length: int = 0
    spent: float = 0.0
    before: int = 0
    attempts: list[Attempt] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    chosen: str | None = None
    achieved: dict[str, Any] = field(default_factory=dict)
    out_of_reach: str | None = None
    why: list[str] = field(default_factory=list)
    warning: str | None = None

    @property
    def words(self) -> dict[str, Setting]:
        """The settings that were turned and stay so."""
        return {turn.key: turn.after for turn in self.turns if turn.adopted}

    def way(self, key: str) -> list[Setting]:
        """The values of a setting from the first to that of now; empty where it was not turned, or never to stay."""
        own = [turn for turn in self.turns if turn.adopted and turn.key == key]
        return [own[0].before, *(turn.after for turn in own)] if own else []

    def done(self, *purposes: Purpose) -> list[Attempt]:
        """Finished trainings of these purposes, in their order."""
        return [a for a in self.attempts if a.purpose in purposes and a.outcome is not None]

    def write(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / FILE, {"format": FORMAT, **dataclasses.asdict(self)})


def read_record(folder: Path) -> Record | None:
    """The record of a run's directory; None where there is none.

    Raises:
        DataError: the file is not one.
    """
    file = folder / FILE
    data = read_json(file, "the record of a target run", "delete it to search anew")
    if data is None:
        return None
    try:
        if data["format"] != FORMAT:
            raise DataError(f"{file}: format {data['format']!r}; this neuprim reads {FORMAT}; delete it to search anew")
        return _record(data)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError, ConfigError) as error:
        what = f"{type(error).__name__}: {error}"
        raise DataError(f"{file}: not the record of a target run ({what}); delete it to search anew") from error


def _record(data: Mapping[str, Any]) -> Record:
    data = {"before": 0, **data}  # records of the first versions did not say
    own = {f.name: data[f.name] for f in dataclasses.fields(Record)}
    made = validate(Record, own)
    for attempt in made.attempts:
        if not (attempt.primitives > 0 and attempt.steps > 0 and Path(attempt.folder).name == attempt.folder):
            raise ValueError(
                "attempts: expected positive numbers of primitives and steps, and settings that name a folder"
            )
        if attempt.outcome is not None:
            [float(attempt.outcome[name]) for name in ("psnr", "ssim", "primitives", "bytes", "ms_per_frame")]
    return made

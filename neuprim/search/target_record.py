"""Record of a target search, ``target.json``: request, trainings, decisions and result; a search resumes from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from neuprim.core.io.files import read_json_record, write_json
from neuprim.core.validation import validate_settings

TARGET_FILE, _FORMAT = "target.json", 1

Purpose = Literal["pace", "size", "knob", "full"]

SettingValue = int | float | str


@dataclass
class Attempt:
    """One training of the search.

    Attributes:
        purpose: what it measures; "full" is a candidate for the result.
        words: changed settings beside the number of primitives, e.g. {"model.sh_degree": 1}.
        primitives, steps: as requested.
        max_seconds: limit of a full run; None for trials.
        predicted: measure -> [value, doubt], predicted before a full run.
        outcome: fields of :class:`neuprim.search.trials.Outcome`, on held-out training views.
        packed: bytes of the model compressed at the default level.
        seconds: of all of it, by the search's clock.
    """

    purpose: Purpose
    words: dict[str, SettingValue]
    primitives: int
    steps: int
    max_seconds: float | None = None
    predicted: dict[str, list[float]] = field(default_factory=dict)
    outcome: dict[str, Any] | None = None
    packed: int = 0
    seconds: float = 0.0

    @property
    def folder(self) -> str:
        changes = [f"{key.rpartition('.')[2]}-{value}" for key, value in sorted(self.words.items())]
        limit = [] if self.max_seconds is None else [f"{self.max_seconds:g}s"]
        first = f"{'full-' if self.purpose == 'full' else ''}{self.primitives}"
        return "_".join([first, *changes, f"{self.steps}-steps", *limit])

    def measured(self, name: str) -> float:
        """Return a number of the outcome."""
        assert self.outcome is not None
        return float(self.outcome[name])

    @property
    def count(self) -> int:
        """Primitives at the end."""
        return int(self.measured("primitives"))

    def repeats(self, other: Attempt) -> bool:
        """Return whether both are the same training."""
        mine, its = ((a.purpose == "full", a.words, a.primitives, a.steps, a.max_seconds) for a in (self, other))
        return mine == its


@dataclass
class SettingChange:
    """A setting that was changed to save bytes.

    Attributes:
        loss: measure -> dB that it costs at equal primitives.
        size: bytes of a primitive over those before.
        adopted: whether the model is smaller with it, with the primitives that make up for the loss.
    """

    key: str
    before: SettingValue
    after: SettingValue
    loss: dict[str, float]
    size: float
    adopted: bool


@dataclass
class TargetRecord:
    """Content of ``target.json``.

    Attributes:
        asked: the target and its budget, seconds.
        same: what must be equal to keep trainings.
        hold_out: every n-th training view is held out and evaluates trainings.
        stage: number of finished stages of the search.
        length: steps of a trial; 0 until the step time is known.
        spent: seconds of the budget.
        before: full runs made for an earlier target.
        turns: changed settings.
        chosen: folder of the chosen full run.
        achieved: result: quality of test and held-out views, bytes, frames per second.
        out_of_reach: the message that the target is out of reach, if trials show it.
        why: reasons why the search ended; warning: message that the target was missed.
    """

    asked: dict[str, float]
    same: dict[str, Any]
    hold_out: int = 0
    stage: int = 0
    length: int = 0
    spent: float = 0.0
    before: int = 0
    attempts: list[Attempt] = field(default_factory=list)
    turns: list[SettingChange] = field(default_factory=list)
    chosen: str | None = None
    achieved: dict[str, Any] = field(default_factory=dict)
    out_of_reach: str | None = None
    why: list[str] = field(default_factory=list)
    warning: str | None = None

    @property
    def words(self) -> dict[str, SettingValue]:
        """Settings changed so far."""
        return {turn.key: turn.after for turn in self.turns if turn.adopted}

    def history(self, key: str) -> list[SettingValue]:
        """Return the values of a changed setting from the first to the current one."""
        own = [turn for turn in self.turns if turn.adopted and turn.key == key]
        return [own[0].before, *(turn.after for turn in own)] if own else []

    def finished(self, *purposes: Purpose) -> list[Attempt]:
        """Return the finished trainings of these purposes, in their order."""
        return [a for a in self.attempts if a.purpose in purposes and a.outcome is not None]

    def add_reason(self, text: str) -> None:
        if text not in self.why:
            self.why.append(text)

    def write(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / TARGET_FILE, {"format": _FORMAT, **asdict(self)})


def read_target_record(folder: Path) -> TargetRecord | None:
    """Read the record of a run directory; None where there is none.

    Raises:
        DataError: the file is damaged.
    """
    what, instead = "the record of a target run", "delete it to search anew"
    return read_json_record(folder / TARGET_FILE, what, instead, _FORMAT, _parse_target_record)


def _parse_target_record(data: Mapping[str, Any]) -> TargetRecord:
    record = validate_settings(TargetRecord, {f.name: data[f.name] for f in fields(TargetRecord)})
    for attempt in record.attempts:
        if not (attempt.primitives > 0 and attempt.steps > 0 and Path(attempt.folder).name == attempt.folder):
            raise ValueError("attempts: expected positive primitives and steps, and settings that name a folder")
        if attempt.outcome is not None:
            [attempt.measured(name) for name in ("psnr", "ssim", "primitives", "bytes", "pace", "ms_per_frame")]
    return record

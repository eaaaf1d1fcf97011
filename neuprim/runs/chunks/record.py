"""What became of each chunk of a run: ``chunks.json`` in its directory, kept while they work, so that nothing that is
done is done again."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.files import read_json, write_json
from neuprim.core.validation import coerce, validate
from neuprim.runs.chunks.plan import Plan
from neuprim.runs.launch.jobs import Result

__all__ = ["FILE", "ChunkRecord", "Row", "read_record", "recorded"]

FILE = "chunks.json"
"""Of a run directory."""

FORMAT = 1
_WHAT, _INSTEAD = "the record of a run in chunks", "another output_dir=DIR begins anew"


@dataclass(frozen=True)
class Row:
    """One chunk.

    Attributes:
        name: of its folder.
        primitives, iterations, max_seconds: its shares.
        state: waiting, done, failed or interrupted.
        line: why it failed.
        seconds: from its start to its end, measuring included.
    """

    name: str
    primitives: int
    iterations: int | None
    max_seconds: float | None
    state: str = "waiting"
    line: str = ""
    seconds: float = 0.0

    @property
    def facts(self) -> tuple[Any, ...]:
        """What must not change while the run goes on."""
        return self.name, self.primitives, self.iterations, self.max_seconds


@dataclass(frozen=True)
class ChunkRecord:
    """All chunks of a run, and how many steps the joined model is trained for, once it is known."""

    rows: tuple[Row, ...]
    joined_steps: int | None = None

    def write(self, folder: Path) -> None:
        """Raises OSError where it cannot be written; what was there is intact."""
        write_json(
            folder / FILE,
            {"format": FORMAT, "chunks": [asdict(row) for row in self.rows], "joined_steps": self.joined_steps},
        )

    def ended(self, number: int, result: Result) -> ChunkRecord:
        """With how a chunk ended."""
        row = replace(self.rows[number], state=result.state, line=result.line, seconds=round(result.seconds, 3))
        return replace(self, rows=(*self.rows[:number], row, *self.rows[number + 1 :]))


def recorded(plan: Plan, folder: Path, resume: bool) -> ChunkRecord:
    """The record of a run that begins, or goes on.

    Raises:
        ConfigError: the run was begun with other chunks.
        DataError: its record is damaged.
    """
    fresh = ChunkRecord(tuple(Row(**facts) for facts in plan.facts()), plan.steps if plan.seconds is None else None)
    before = read_record(folder) if resume else None
    if before is None:
        return fresh
    was, now = ([row.facts for row in record.rows] for record in (before, fresh))
    if was != now:
        raise ConfigError(
            f"{folder / FILE}: begun with {_said(was)}; the words now ask for {_said(now)}; expected the same words, or another output_dir"
        )
    return before


def read_record(folder: Path) -> ChunkRecord | None:
    """What a run directory says of its chunks; None where it has none.

    Raises:
        DataError: the file is damaged, or of another version.
    """
    file = folder / FILE
    data: Any = read_json(file, _WHAT, _INSTEAD)
    if data is None:
        return None
    try:
        if data["format"] != FORMAT:
            raise DataError(f"{file}: format {data['format']!r}; this neuprim reads {FORMAT}; {_INSTEAD}")
        steps = data["joined_steps"]
        return ChunkRecord(
            tuple(validate(Row, row, "chunks") for row in data["chunks"]), coerce(steps, int | None, "joined_steps")
        )
    except (KeyError, TypeError, ValueError, AttributeError, ConfigError) as error:
        raise DataError(f"{file}: not {_WHAT} ({type(error).__name__}: {error}); {_INSTEAD}") from error


def _said(rows: list[tuple[Any, ...]]) -> str:
    budget = [f"{iterations} steps" if seconds is None else f"{seconds:g} s" for _, _, iterations, seconds in rows]
    return ", ".join(
        f"{name} ({primitives} primitives, {said})" for (name, primitives, _, _), said in zip(rows, budget, strict=True)
    )

"""What a sweep was asked for and what became of each run: ``sweep.json`` in its directory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from neuprim.config.overrides import parse
from neuprim.core.errors import ConfigError, DataError, cut
from neuprim.core.io.files import read_json, write_json
from neuprim.core.validation import coerce, validate

__all__ = ["FILE", "Row", "SweepRecord", "begun_words", "read_sweep"]

FILE = "sweep.json"
"""Of a sweep's directory."""

FORMAT = 1
_WHAT, _INSTEAD = "the record of a sweep", "another output_dir=DIR begins anew"


@dataclass(frozen=True)
class Row:
    """One run.

    Attributes:
        name: of its folder in the sweep's.
        words: after ``neuprim run``, without those of its place.
        swept: key -> value, as typed, of those that differ between the runs.
        state: waiting, done, failed or interrupted.
        line: why it failed.
        seconds: from its start to its end, measuring included.
        attempts: how often it was started, as its worker died.
    """

    name: str
    words: tuple[str, ...]
    swept: Mapping[str, str] = field(default_factory=dict)
    state: str = "waiting"
    line: str = ""
    seconds: float = 0.0
    attempts: int = 0


@dataclass(frozen=True)
class SweepRecord:
    """A sweep.

    Attributes:
        words: after ``neuprim run -m``, without those of its place.
    """

    words: tuple[str, ...]
    rows: tuple[Row, ...]

    def write(self, folder: Path) -> None:
        """Raises OSError where it cannot be written; what was there is intact."""
        rows = [{**asdict(row), "words": list(row.words), "seconds": round(row.seconds, 3)} for row in self.rows]
        write_json(folder / FILE, {"format": FORMAT, "words": list(self.words), "runs": rows})

    def put(self, row: Row) -> SweepRecord:
        """With another row in place of that of the same name."""
        return replace(self, rows=tuple(row if old.name == row.name else old for old in self.rows))

    def beside(self, before: SweepRecord | None, file: Path) -> SweepRecord:
        """As it goes on: with the states of before, and after its own the runs that only the earlier one had.

        Raises:
            ConfigError: a run of the same name had other words.
        """
        if before is None:
            return self
        old = {row.name: row for row in before.rows}
        for row in self.rows:
            if row.name in old and old[row.name].words != row.words:
                was = " ".join(old[row.name].words)
                raise ConfigError(
                    f"{file}: {row.name} was begun with {was}; expected the same words, or another output_dir"
                )
        own = tuple(old.get(row.name, row) for row in self.rows)
        names = {row.name for row in own}
        return replace(self, rows=(*own, *(row for row in before.rows if row.name not in names)))


def read_sweep(folder: Path) -> SweepRecord | None:
    """What a sweep's directory says; None where there is none.

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
        return SweepRecord(coerce(data["words"], tuple[str, ...], "words"), tuple(_row(run) for run in data["runs"]))
    except (KeyError, TypeError, ValueError, AttributeError, ConfigError) as error:
        raise DataError(f"{file}: not {_WHAT} ({type(error).__name__}: {error}); {_INSTEAD}") from error


def begun_words(words: Sequence[str]) -> list[str]:
    """The words that a sweep was begun with, and these, which say no more than its directory and that it goes on.

    Raises:
        ConfigError: there is no sweep.
    """
    given = {a.key: a.value for a in parse(words)}
    where = given.get("output_dir")
    before = None if where is None or given.get("resume") is not True else read_sweep(Path(str(where)).expanduser())
    if before is None:
        said = " ".join(words) or "nothing"
        raise ConfigError(
            f"{said}: no values to sweep; expected KEY=A,B,C, or output_dir=DIR resume=true of a sweep ({FILE} in it)"
        )
    for word in before.words:
        if "${" in word:  # what a file says is data; see neuprim.config.compose
            raise ConfigError(
                f"{Path(str(where)) / FILE}: {cut(word)} refers to something outside of the file; type the sweep's words again, with resume=true"
            )
    return [*before.words, *words]


def _row(run: Mapping[str, Any]) -> Row:
    row = validate(Row, run, "runs")
    if Path(row.name).name != row.name or row.name in ("", ".", ".."):
        raise ValueError(f"name {row.name!r} is no folder's")
    return row

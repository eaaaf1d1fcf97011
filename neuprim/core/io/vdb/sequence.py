"""A folder of OpenVDB files as frames in time."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path

from neuprim.core.errors import DataError


@dataclass(frozen=True)
class VdbFrame:
    """One file and the number in its name."""

    number: int
    path: Path


@dataclass(frozen=True)
class Sequence:
    """One or more frames in the order of their numbers."""

    folder: Path
    frames: tuple[VdbFrame, ...]
    gaps: tuple[tuple[int, int], ...]  # (first, last) number of every run of missing ones

    def __len__(self) -> int:
        return len(self.frames)


def sequence(folder: Path, prefix: str | None = None) -> Sequence:
    """The .vdb files of a folder by the last number in each name, after ``prefix`` where it holds several sequences.

    Raises DataError for no file, a name without a number, several prefixes, or one number twice.
    """
    folder = Path(folder)
    expected = "expected a folder with .vdb files"
    try:
        if not folder.is_dir():
            raise DataError(f"{folder}: {'is a file' if folder.exists() else 'no such folder'}; {expected}")
        paths = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".vdb" and p.is_file())
    except OSError as error:  # no permission, a name that is too long
        raise DataError(f"{folder}: cannot be read ({error.strerror or error}); {expected}") from error
    found: dict[str, list[VdbFrame]] = {}
    odd: list[str] = []
    for path in paths:
        match = re.fullmatch(r"(.*?)([0-9]+)([^0-9]*)", path.stem, re.DOTALL)
        if match is None or len(match[2]) > 18:
            odd.append(path.name)
        else:
            found.setdefault(match[1] + "*" * bool(match[3]) + match[3], []).append(VdbFrame(int(match[2]), path))
    if prefix is not None:
        found, odd = {k: v for k, v in found.items() if k == prefix}, []
    if not found and not odd:
        raise DataError(f"{folder}: no .vdb file{'' if prefix is None else f' named {prefix}NUMBER.vdb'}")
    if odd:
        raise DataError(f"{folder / odd[0]}: no frame number in the name; expected names like fire_12.vdb")
    if len(found) > 1:
        names = ", ".join(repr(name) for name in sorted(found))
        raise DataError(f"{folder}: files of several sequences: {names}; expected one prefix per folder")
    frames = sorted(next(iter(found.values())), key=lambda frame: frame.number)
    gaps: list[tuple[int, int]] = []
    for before, after in itertools.pairwise(frames):
        if before.number == after.number:
            raise DataError(f"{after.path}: frame {after.number} is also {before.path.name}; expected each number once")
        if after.number > before.number + 1:
            gaps.append((before.number + 1, after.number - 1))
    return Sequence(folder, tuple(frames), tuple(gaps))

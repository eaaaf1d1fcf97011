"""Which grid of a file means what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from neuprim.core.errors import DataError, nearest
from neuprim.core.io.vdb import Grid, VdbFrame, read_grids, read_header

__all__ = ["GridReader", "find_grids"]

USUAL = {
    "density": ("density", "smoke", "soot"),
    "temperature": ("temperature", "heat", "temp"),
    "flames": ("flames", "flame", "fire"),
    "color": ("color", "colour", "Cd", "albedo"),
}
"""Names that exporters give them (EmberGen, Mantaflow, Houdini)."""


@dataclass(frozen=True)
class GridReader:
    """Meaning ("density", "temperature", "flames", "color") -> name in the files, and the meaning of the grid that
    absorbs."""

    names: Mapping[str, str]
    extinction: str = "density"

    def absorbing(self, wanted: Sequence[str], folder: Path) -> GridReader:
        """The same with the first of a look's ``extinction_grids`` that the sequence has as the one that absorbs.

        Raises:
            DataError: it has none of them.
        """
        found = [meaning for meaning in wanted if meaning in self.names]
        if not found:
            there = ", ".join(f"{meaning} ({name!r})" for meaning, name in self.names.items())
            raise DataError(
                f"{folder}: this look absorbs by {' or '.join(wanted)}, and the files have {there}; "
                f"choose another scene.look, or name the grid: scene.grids.{wanted[0]}=NAME"
            )
        return replace(self, extinction=found[0])

    def read(self, path: Path) -> dict[str, Grid]:
        """The grids of one file by meaning; those that the file lacks are left out (an exporter drops empty ones)."""
        there = {grid.name for grid in read_header(path).grids}
        wanted = {meaning: name for meaning, name in self.names.items() if name in there}
        return dict(zip(wanted, read_grids(path, list(wanted.values())), strict=True))


def find_grids(frames: Sequence[VdbFrame], given: Mapping[str, str]) -> GridReader:
    """The grids that some frame has: those the user named, then those with a usual name.

    Raises:
        DataError: a named grid is in no file or cannot be read (level sets, points), or no file has anything that
        absorbs.
    """
    kinds: dict[str, str | None] = {}  # name -> why it cannot be used
    for frame in frames:
        for grid in read_header(frame.path).grids:
            refusal = grid.refusal()
            if grid.name not in kinds or refusal is None:
                kinds[grid.name] = refusal
    folder = frames[0].path.parent
    names: dict[str, str] = {}
    for meaning, usual in USUAL.items():
        if meaning in given:
            name = given[meaning]
            if name not in kinds:
                raise DataError(
                    f"{folder}: scene.grids.{meaning}={name}: no frame has such a grid{nearest(name, kinds)}"
                )
            if kinds[name]:
                raise DataError(f"{folder}: scene.grids.{meaning}={name}: the grid {kinds[name]}")
            names[meaning] = name
        else:
            found = [name for name in usual if name in kinds and kinds[name] is None]
            names |= {meaning: found[0]} if found else {}
    if not {"density", "temperature"} & names.keys():
        listed = ", ".join(f"{name} ({why or 'readable'})" for name, why in sorted(kinds.items())) or "none"
        raise DataError(
            f"{folder}: no grid of density or temperature; found: {listed}. Name one: scene.grids.density=NAME"
        )
    return GridReader(names)

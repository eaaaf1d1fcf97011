"""``neuprim vdb info``: what is in OpenVDB files, as tables or JSON."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import Command, plain_console
from neuprim.core.errors import DataError

if TYPE_CHECKING:
    from rich.console import Console

    from neuprim.core.io.vdb import Grid, GridHeader

COLUMNS = ("grid", "type", "compression", "voxel size", "bounds", "active", "range", "dense")


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("info",), metavar="info", help="what to do")
    parser.add_argument("path", type=Path, metavar="FILE|DIR", help="a .vdb file, or a folder of frames")
    parser.add_argument("--json", action="store_true", help="print JSON")


def _print_info(arguments: argparse.Namespace) -> int:
    """Print a report on a file, or on every file of a folder.

    Raises:
        DataError: nothing there, or a damaged file.
    """
    files, notes = _find_files(arguments.path)
    if arguments.json:
        record = {"files": [_describe_file(file) for file in files], "notes": notes}
        print(json.dumps(record, indent=1, allow_nan=False))
        return 0
    console = plain_console()
    for file in files:
        _print_file(console, _describe_file(file))
    for note in notes:
        console.print(note)
    return 0


def _find_files(path: Path) -> tuple[list[Path], list[str]]:
    """Return the files to show, frames in their order, and notes on the whole folder."""
    if not path.is_dir():
        return [path], []
    from neuprim.core.io.vdb import sequence

    try:
        frames = sequence(path)
    except DataError as error:
        files = sorted(p for p in path.iterdir() if p.suffix.lower() == ".vdb" and p.is_file())
        if not files:
            raise
        return files, [f"not one sequence: {error}"]
    missing = ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in frames.gaps)
    numbers = f"{frames.frames[0].number} to {frames.frames[-1].number}"
    note = f"{len(frames)} frames, {numbers}; missing: {missing or 'none'}"
    return [frame.path for frame in frames.frames], [note]


def _describe_file(path: Path) -> dict[str, Any]:
    """Return JSON-ready values: lengths in world units, bounds in voxel indices (upper ones excluded)."""
    from neuprim.core.io.vdb import read_grids, read_header

    header = read_header(path)
    grids = read_grids(path, level_sets=True)  # in the same order, one in memory at a time
    return {
        "path": str(path),
        "version": header.version,
        "library": list(header.library),
        "metadata": _to_json(header.metadata),
        "grids": [_describe_grid(entry, None if entry.undecodable() else next(grids)) for entry in header.grids],
    }


def _describe_grid(header: GridHeader, grid: Grid | None) -> dict[str, Any]:
    """One grid; grids that cannot be decoded have a ``reason`` and no numbers from voxels."""
    entry: dict[str, Any] = {
        "name": header.name,
        "class": header.kind,
        "type": header.type,
        "half": header.half,
        "compression": header.compression,
        "map": header.map,
        "transform": None if header.transform is None else header.transform.tolist(),
        "voxel_size": header.voxel_size,
        "metadata": _to_json(header.metadata),
        "reason": header.refusal(),
    }
    if grid is None:
        return entry
    box = grid.world_bounds()
    return entry | {
        "background": _to_json(grid.background.ravel().tolist()),
        "bounds": grid.bounds,
        "world_bounds": None if box is None else box.tolist(),
        "leaves": len(grid.values),
        "tiles": len(grid.tiles),
        "active_voxels": grid.active_voxels,
        "range": grid.range,
        "non_finite": grid.non_finite,
        "sparse_bytes": grid.sparse_bytes,
        "dense_bytes": grid.dense_bytes,
    }


def _to_json(value: Any) -> Any:
    """Plain values: JSON knows no bytes, tuples or NaN."""
    if isinstance(value, Mapping):
        return {name: _to_json(item) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [_to_json(item) for item in value]
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _print_file(console: Console, file: dict[str, Any]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    grids = file["grids"]
    title = f"{file['path']}  (version {file['version']}, {len(grids)} {'grid' if len(grids) == 1 else 'grids'})"
    table = Table(title=Text(_clean(title)), title_justify="left", box=SIMPLE_HEAD)
    for name in COLUMNS:
        table.add_column(name, overflow="fold", no_wrap=name in ("bounds", "active", "range", "dense"))
    for grid in grids:
        table.add_row(*(Text(_clean(cell)) for cell in _format_cells(grid)))
    console.print(table)
    for grid in grids:
        if grid["reason"]:
            console.print(_clean(f"  {grid['name']}: {grid['reason']}"))
        if grid.get("non_finite"):
            console.print(_clean(f"  {grid['name']}: {grid['non_finite']} active values are NaN or infinite"))


def _format_cells(grid: dict[str, Any]) -> Iterator[str]:
    size = grid["voxel_size"]
    kind = grid["type"].removeprefix("Tree_").removesuffix("_5_4_3") + " as half" * grid["half"]
    yield from (grid["name"], f"{kind}\n{grid['class']}", grid["compression"].replace(" + ", "\n"))
    yield grid["map"] if size is None else "\n".join(f"{v:.4g}" for v in (size[:1] if len(set(size)) == 1 else size))
    if "bounds" not in grid:
        yield from ("not read", "", "", "")
        return
    box, span = grid["bounds"], grid["range"]
    yield "empty" if box is None else "\n".join(f"{a}:{b}" for a, b in zip(*box, strict=True))
    yield f"{grid['active_voxels']:,}"
    yield "–" if span is None else f"{span[0]:.4g}\n{span[1]:.4g}"
    yield _format_bytes(grid["dense_bytes"])


def _format_bytes(count: int) -> str:
    size = float(count)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if size < 1024:
            return f"{size:.3g} {unit}" if unit != "B" else f"{count} B"
        size /= 1024
    return f"{size:,.3g} TiB"


def _clean(text: str) -> str:
    """Replace control characters in names of files; a terminal must not act on them."""
    return "".join(c if c.isprintable() or c == "\n" else "�" for c in text)


COMMAND = Command(
    "vdb",
    "look into OpenVDB files",
    _print_info,
    _add_arguments,
    "`info` lists grids: type, transform, bounds, active voxels, values, memory.",
)

"""Reading grids, one at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from neuprim.core.io.vdb.grid import Grid
from neuprim.core.io.vdb.header import FileHeader, GridHeader, parse_header
from neuprim.core.io.vdb.stream import Cursor, opened
from neuprim.core.io.vdb.tree import TreeReader

__all__ = ["LEAF_LIMIT", "read_grid", "read_grids"]

LEAF_LIMIT = 4 * 2**30
"""Most bytes of decoded leaves and tiles that :func:`read_grid` takes unless told otherwise: 4 GiB."""


def read_grid(path: Path, name: str, *, max_bytes: int = LEAF_LIMIT, level_sets: bool = False) -> Grid:
    """Reads one grid of a file; the others stay undecoded.

    Args:
        path: an OpenVDB file of version 222 to 224.
        name: the grid, as :func:`~neuprim.core.io.vdb.header.read_header` lists it.
        max_bytes: most memory for its leaves and tiles; more is refused before it is taken.
        level_sets: read signed distances too, for inspection.

    Raises:
        DataError: no such file or grid; points, a level set or another type that is not read; truncated or damaged.
        BackendUnavailable: the grid is Blosc-compressed, and the package ``blosc`` is missing.
    """
    with opened(Path(path)) as cursor:
        file = parse_header(cursor)
        return _read(cursor, file, file.grid(name), max_bytes, level_sets)


def read_grids(
    path: Path, names: Sequence[str] | None = None, *, max_bytes: int = LEAF_LIMIT, level_sets: bool = False
) -> Iterator[Grid]:
    """Several grids of a file, one at a time; the file's header is read once.

    Args:
        names: which, in this order; None for all that can be decoded (of level sets: if ``level_sets``), in file order.
        path, max_bytes, level_sets: as in :func:`read_grid`; the limit is for each grid.

    Raises:
        DataError, BackendUnavailable: as :func:`read_grid`, when that grid's turn comes.
    """
    with opened(Path(path)) as cursor:
        file = parse_header(cursor)
        if names is None:
            names = [g.name for g in file.grids if not (g.undecodable() if level_sets else g.refusal())]
        for name in names:
            yield _read(cursor, file, file.grid(name), max_bytes, level_sets)


def _read(cursor: Cursor, file: FileHeader, header: GridHeader, max_bytes: int, level_sets: bool) -> Grid:
    what = f"grid {header.name!r}"
    refusal = header.undecodable() if level_sets else header.refusal()
    if refusal or header.transform is None:
        raise cursor.fail(f"{what} {refusal}")
    source = header
    if header.parent:  # an instance: own transform and metadata, another grid's tree
        source = file.grid(header.parent)
        if source.parent or source.type != header.type:
            raise cursor.fail(
                f"{what} shares the tree of {header.parent!r}, which has none of its own or one of another type"
            )
    inner = Cursor(cursor.path, cursor.data, source.tree_at, source.end)
    tree = TreeReader(inner, source.block, source.flags, source.half, source.channels, what, max_bytes)
    return Grid(
        header.name,
        header.transform,
        tree.background,
        tree.origins,
        tree.values,
        tree.masks,
        tree.tiles,
        header.kind,
        header.half,
        dict(header.metadata),
    )

"""``neuprim render``, ``inspect``, ``view`` and ``vdb info``: render and show runs, and describe OpenVDB files."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import (
    RENDER_SETTINGS_HELP,
    Command,
    add_frame_argument,
    parse_count,
    parse_number,
    parse_numbers,
    parse_rate,
    parse_size_argument,
    parse_whole,
    plain_console,
    take_condition_arguments,
)
from neuprim.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from rich.console import Console

    from neuprim.core.environment import EnvironmentFile
    from neuprim.core.io.vdb import GridHeader, VdbGrid


# ---------------------------------------------------------------- render


_RENDER_CONDITIONS = """\
Each condition of the run's task (time, light, ...) is a flag, given after RUN_DIR: --time 0.5; a number may also be a
list or a range, --time 0.2,0.8 or --time 0:1:20, one frame each."""


def _add_render_arguments(parser: argparse.ArgumentParser) -> None:
    cameras = (
        "FILE is JSON (frames, or a path of nerfstudio's viewer), USD (FILE#/PRIM) or the folder of a COLMAP model"
    )
    parser.add_argument("--camera", required=True, metavar="orbit|test|FILE", help=cameras)
    space = "coordinates of cameras, lights and .exr files: of the run's data (default), or of the model"
    parser.add_argument("--space", choices=("world", "scene"), help=space)
    parser.add_argument(
        "--size", type=parse_size_argument, metavar="WxH", help="image size in pixels (default: that of the data)"
    )
    formats = ("png", "exr", "npy", "webp", "gif", "mp4")
    parser.add_argument("--format", choices=formats, help="default: png, or webp for an animation")
    layers = "layers of an .exr: beauty, alpha, depth, density, and those of the task (default: all)"
    parser.add_argument("--layers", metavar="NAME,...", help=layers)
    datatype = "precision of colour and alpha in an .exr (default: float); other layers are always float"
    parser.add_argument("--datatype", choices=("half", "float"), help=datatype)
    colors = "OpenColorIO colour space of layers of light in an .exr, e.g. ACEScg (default: linear Rec. 709)"
    parser.add_argument("--colorspace", metavar="NAME", help=colors)
    compression = "compression of an .exr (default: zip); dwaa is lossy"
    parser.add_argument("--compression", choices=("zip", "piz", "dwaa"), help=compression)
    crop = "store only the pixels of an .exr around the visible part of the model, as its data window"
    parser.add_argument("--crop", action="store_true", help=crop)
    deep = "write deep .exr files of at most N samples in a pixel, with depths Z to ZBack (default of N: 8)"
    parser.add_argument("--deep", type=parse_count, nargs="?", const=8, metavar="N", help=deep)
    rate = "frames per second of an animation (default: it lasts about four seconds), and in headers of .exr files"
    parser.add_argument("--fps", type=parse_rate, metavar="F", help=rate)
    parser.add_argument("--out", type=Path, metavar="PATH", help="where to write (default: in RUN_DIR)")
    numbers = "frames of the .vdb files by number, instead of --time: 1001-1048x2,1060; images are named NAME.1001.exr"
    parser.add_argument("--frame", metavar="NUMBERS", help=numbers)
    parser.add_argument("--frames", type=parse_count, default=60, metavar="N", help="frames of an orbit (default: 60)")
    shutter = (
        "motion blur: part of the interval between two frames, above 0 and at most 1, in which the shutter is open; "
        "the interval is centred on the frame and ends with the sequence (default: no motion blur)"
    )
    parser.add_argument("--shutter", type=_parse_shutter, metavar="S", help=shutter)
    samples = "images that are averaged for each image with motion blur (default: 8)"
    parser.add_argument("--shutter-samples", type=parse_count, metavar="N", help=samples)
    parser.add_argument("--force", action="store_true", help="replace existing pictures of the run's report")
    group = parser.add_argument_group("environment light, for tasks with a light")
    image = "equirectangular radiance, twice as wide as high"
    group.add_argument("--environment", type=Path, metavar="FILE.exr", help=image)
    lights = "number of lights that approximate it (default: 64)"
    group.add_argument("--environment-samples", type=_parse_light_count_argument, metavar="N", help=lights)
    rotation = "counter-clockwise about the up axis, seen from above (default: 0)"
    group.add_argument("--environment-rotation", type=_parse_degrees, metavar="DEG", help=rotation)
    scale = "multiplies its radiance (default: 1)"
    group.add_argument("--environment-scale", type=_parse_factor, metavar="X", help=scale)
    unseen = "light from directions that the training data lack: keep the model's guess, or drop it (default: keep)"
    group.add_argument("--environment-unseen", choices=("keep", "drop"), help=unseen)


def _render_command(arguments: argparse.Namespace) -> int:
    camera = arguments.camera
    if camera not in ("orbit", "test") and not any(Path(n).exists() for n in (camera, camera.partition("#")[0])):
        raise ConfigError(f"--camera {camera}: no such file; expected orbit, test, or a file or folder of cameras")
    environment = _read_environment_argument(arguments)
    from neuprim.cli.progress import DrawProgress
    from neuprim.runs.render_images import RenderRequest, render_run

    if arguments.shutter is None and arguments.shutter_samples is not None:
        raise ConfigError("--shutter-samples: needs --shutter, too; pass for example --shutter 0.5")
    names = "size format out frame frames conditions fps space layers datatype colorspace compression crop deep".split()
    names += ["shutter", "shutter_samples"]
    given = {name: value for name in names if (value := getattr(arguments, name)) is not None}
    request = RenderRequest(
        camera, environment=environment, overrides=arguments.overrides, overwrite=arguments.force, **given
    )
    with DrawProgress() as progress:
        paths = render_run(arguments.run, request, notify=progress.print_note, progress=progress.show)
    print(*paths, sep="\n")
    return 0


def _read_environment_argument(arguments: argparse.Namespace) -> EnvironmentFile | None:
    given = {name: getattr(arguments, f"environment_{name}") for name in ("samples", "rotation", "scale", "unseen")}
    settings = {name: value for name, value in given.items() if value is not None}
    if arguments.environment is None:
        for name in settings:
            raise ConfigError(f"--environment-{name} is given without --environment FILE.exr")
        return None
    from neuprim.core.environment import EnvironmentFile

    guesses = settings.pop("unseen", "keep") == "keep"
    return EnvironmentFile(arguments.environment, **settings, guesses=guesses)


def _parse_light_count_argument(text: str) -> int:
    return int(parse_number(text, 1, 4096, "a whole number from 1 to 4096", whole=True))


def _parse_degrees(text: str) -> float:
    return parse_number(text, -1e6, 1e6, "an angle in degrees")


def _parse_shutter(text: str) -> float:
    return parse_number(text, 1e-6, 1.0, "a part of the frame interval, above 0 and at most 1")


def _parse_factor(text: str) -> float:
    return parse_number(text, 0.0, 1e6, "a factor from 0 to 1e6")


RENDER_COMMAND = Command(
    "render",
    "render images of a run",
    _render_command,
    _add_render_arguments,
    _RENDER_CONDITIONS,
    RENDER_SETTINGS_HELP,
    take_condition_arguments,
    opens_run=True,
)


# ---------------------------------------------------------------- inspect


_INSPECT_CONDITIONS = """\
Each condition of the run's task is a flag, given after RUN_DIR: --time 0.5, or several frames: --time 0:1:20,
--time 0.2,0.8."""


def _add_inspect_arguments(parser: argparse.ArgumentParser) -> None:
    shown = "layers: volume, isosurface, slices, primitives, primitive, difference, ..."
    parser.add_argument("--show", default="", metavar="NAME,...", help=shown)
    one = "show this primitive alone"
    parser.add_argument("--primitive", type=parse_whole, metavar="INDEX", help=one)
    add_frame_argument(parser)
    parser.add_argument("--against", metavar="FILE.vdb|DIR|scene", help="ground truth to compare with")
    grid = "points along the longest side of the box (default: 128)"
    parser.add_argument("--grid", type=parse_count, default=128, metavar="N", help=grid)
    box = "two corners in the coordinates of the run's data, as --box=-1,-1,-1,1,1,1 (default: around the model)"
    parser.add_argument("--box", type=parse_numbers, metavar="X,Y,Z,X,Y,Z", help=box)
    levels = "extinctions of the isosurfaces, in 1/scene unit"
    parser.add_argument("--level", type=parse_numbers, default=[], metavar="S,...", help=levels)
    parser.add_argument("--up", choices=("x", "y", "z"), help="the upward axis (default: the scene's, or z)")
    parser.add_argument(
        "--size", type=parse_size_argument, metavar="WxH", help="size of the picture or window in pixels"
    )
    out = "where to write: .png, .webp, .gif, .mp4, .html or .vdb (default: show a window)"
    parser.add_argument("--out", type=Path, metavar="FILE", help=out)
    parser.add_argument("--force", action="store_true", help="replace files that exist")


def _inspect_command(arguments: argparse.Namespace) -> int:
    from neuprim.cli.progress import print_notes
    from neuprim.inspect import parse_inspection_box
    from neuprim.runs.inspect import InspectRequest, inspect_run

    names = [name.strip() for name in arguments.show.split(",") if name.strip()]
    names += ["primitive"] * (arguments.primitive is not None)
    request = InspectRequest(
        arguments.run,
        names or ["volume"],
        arguments.conditions,
        arguments.grid,
        None if arguments.box is None else parse_inspection_box(arguments.box),
        levels=tuple(arguments.level),
        primitive=arguments.primitive,
        against=arguments.against,
        out=arguments.out,
        size=arguments.size,
        up=arguments.up,
        overwrite=arguments.force,
    )
    print(*inspect_run(request, print_notes), sep="\n")
    return 0


INSPECT_COMMAND = Command(
    "inspect",
    "look inside a run's density",
    _inspect_command,
    _add_inspect_arguments,
    _INSPECT_CONDITIONS,
    take_rest=take_condition_arguments,
    opens_run=True,
)


# ---------------------------------------------------------------- view


def _add_view_arguments(parser: argparse.ArgumentParser) -> None:
    port = "port of the page; 0 for any that is free (default: 8080)"
    parser.add_argument("--port", type=_parse_port, default=8080, metavar="N", help=port)
    host = "address to listen on (default: 127.0.0.1, which only this machine can reach)"
    parser.add_argument("--host", metavar="ADDRESS", help=host)


def _view_command(args: argparse.Namespace) -> int:
    """Show the run in the browser until Ctrl-C; return the exit status."""
    from neuprim.cli.progress import DrawProgress, warn_of_open_host
    from neuprim.config.command_settings import LOOPBACK, ViewerSettings
    from neuprim.viewer.view import view_run

    settings = ViewerSettings(args.host or LOOPBACK, args.port)
    warn_of_open_host(settings)

    def print_address(address: str) -> None:
        print(f"{address}\nopen it in a browser; Ctrl-C ends the viewer", flush=True)

    try:
        with DrawProgress() as progress:
            view_run(args.run_dir, settings, print_address, progress.print_note, progress.show)
    except KeyboardInterrupt:
        print("neuprim: the viewer is closed", file=sys.stderr)
    return 0


def _parse_port(text: str) -> int:
    if not (text.isascii() and text.isdigit()) or int(text) > 65535:
        raise ConfigError(f"--port {text}: expected a port, 1 to 65535, or 0 for any")
    return int(text)


VIEW_COMMAND = Command(
    "view",
    "look at a run in the browser: turn it, play it, move its light",
    _view_command,
    _add_view_arguments,
    opens_run=True,
)


# ---------------------------------------------------------------- vdb info


def _add_vdb_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("info",), metavar="info", help="list the grids")
    parser.add_argument("path", type=Path, metavar="FILE|DIR", help="a .vdb file, or a folder of frames")
    parser.add_argument("--frames", action="store_true", help="list every frame of a folder")
    parser.add_argument("--json", action="store_true", help="print JSON")


def _vdb_info_command(arguments: argparse.Namespace) -> int:
    """Print the grids of OpenVDB files: one report per file, or one table for a folder with a sequence of frames."""
    files, notes, one_sequence = _find_vdb_command_files(arguments.path)
    if arguments.json:
        record = {"files": [_describe_vdb_command_file(file) for file in files], "notes": notes}
        print(json.dumps(record, indent=1, allow_nan=False))
        return 0
    console = plain_console()
    if one_sequence and len(files) > 1 and not arguments.frames:
        _print_vdb_sequence(console, [_describe_vdb_command_file(file) for file in files])
    else:
        for file in files:
            _print_vdb_file(console, _describe_vdb_command_file(file))
    for note in notes:
        console.print(note)
    return 0


def _find_vdb_command_files(path: Path) -> tuple[list[Path], list[str], bool]:
    """Find the OpenVDB files at ``path``, a file or folder.

    Return the files in the order of frames, texts that describe the folder, and whether the files are one sequence.
    """
    if not path.is_dir():
        return [path], [], False
    from neuprim.core.io.vdb import list_vdb_files

    try:
        frames = list_vdb_files(path)
    except DataError as error:
        files = sorted(p for p in path.iterdir() if p.suffix.lower() == ".vdb" and p.is_file())
        if not files:
            raise
        return files, [f"not one sequence: {error}"], False
    missing = ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in frames.gaps)
    numbers = f"{frames.frames[0].number} to {frames.frames[-1].number}"
    note = f"{len(frames)} frames, {numbers}; missing: {missing or 'none'}"
    return [frame.path for frame in frames.frames], [note], True


def _describe_vdb_command_file(path: Path) -> dict[str, Any]:
    """Return the contents of an OpenVDB file as JSON-ready values. Lengths are in world units. Bounds are voxel
    indices; the upper bound is excluded.
    """
    from neuprim.core.io.vdb import read_grids, read_header

    header = read_header(path)
    grids = read_grids(path, level_sets=True)  # in the same order, one in memory at a time
    return {
        "path": str(path),
        "version": header.version,
        "library": list(header.library),
        "metadata": _vdb_command_to_json(header.metadata),
        "grids": [_describe_grid(entry, None if entry.undecodable() else next(grids)) for entry in header.grids],
    }


def _describe_grid(header: GridHeader, grid: VdbGrid | None) -> dict[str, Any]:
    """Return a description of one OpenVDB grid as JSON-ready values.

    ``grid`` is None if the voxels cannot be decoded. Then the entry ``reason`` says why, and all values that are
    computed from voxels are missing.
    """
    entry: dict[str, Any] = {
        "name": header.name,
        "class": header.kind,
        "type": header.type,
        "half": header.half,
        "compression": header.compression,
        "map": header.map,
        "transform": None if header.transform is None else header.transform.tolist(),
        "voxel_size": header.voxel_size,
        "metadata": _vdb_command_to_json(header.metadata),
        "reason": header.refusal(),
    }
    if grid is None:
        return entry
    box = grid.world_bounds()
    return entry | {
        "background": _vdb_command_to_json(grid.background.ravel().tolist()),
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


def _vdb_command_to_json(value: Any) -> Any:
    """Convert OpenVDB metadata to JSON types. Bytes become text with their number; NaN and infinity become text."""
    if isinstance(value, Mapping):
        return {name: _vdb_command_to_json(item) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [_vdb_command_to_json(item) for item in value]
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _print_vdb_file(console: Console, file: dict[str, Any]) -> None:
    console.print(_printable(f"{file['path']}  (version {file['version']}, {len(file['grids'])} grids)"))
    for grid in file["grids"]:
        kind = grid["type"] + " as half" * grid["half"]
        texts = [f"{kind}, {grid['class']}, {grid['compression']}, {grid['map']}"]
        if grid["voxel_size"] is not None:
            texts.append("voxel size " + " ".join(f"{v:.4g}" for v in grid["voxel_size"]))
        if "bounds" in grid:
            box, span = grid["bounds"], grid["range"]
            texts.append("empty" if box is None else " ".join(f"{a}:{b}" for a, b in zip(*box, strict=True)))
            texts.append(f"{grid['active_voxels']:,} active" + (f", {span[0]:.4g} to {span[1]:.4g}" if span else ""))
            texts.append(f"{grid['dense_bytes'] / 2**20:,.2f} MiB dense")
        else:
            texts.append("not read")
        if grid["reason"]:
            texts.append(grid["reason"])
        if grid.get("non_finite"):
            texts.append(f"{grid['non_finite']} active values are NaN or infinite")
        console.print(_printable(f"  {grid['name']}: {'; '.join(texts)}"))


def _print_vdb_sequence(console: Console, files: Sequence[dict[str, Any]]) -> None:
    """Print a table of an OpenVDB sequence. Each row summarizes one grid over all frames."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for title in ("grid", "type", "frames", "voxel size", "voxel bounds", "active voxels", "values"):
        table.add_column(title)
    grids: dict[str, list[dict[str, Any]]] = {}
    for file in files:
        for grid in file["grids"]:
            grids.setdefault(grid["name"], []).append(grid)
    notes = []
    for name, found in grids.items():
        bounds = [grid["bounds"] for grid in found if grid.get("bounds")]
        edges = [(min(b[0][a] for b in bounds), max(b[1][a] for b in bounds)) for a in range(3)] if bounds else []
        active, spans = [grid.get("active_voxels", 0) for grid in found], [g["range"] for g in found if g.get("range")]
        cells = (
            " or ".join(sorted({f"{grid['type']}{' as half' * grid['half']}, {grid['class']}" for grid in found})),
            f"{len(found)}",
            " or ".join(sorted({" ".join(f"{v:.4g}" for v in grid["voxel_size"] or ()) for grid in found})),
            " ".join(f"{low}:{high}" for low, high in edges) or "empty",
            f"{min(active):,} to {max(active):,}",
            f"{min(span[0] for span in spans):.4g} to {max(span[1] for span in spans):.4g}" if spans else "none",
        )
        table.add_row(*(Text(_printable(cell)) for cell in (name, *cells)))
        notes += sorted({f"{name}: {grid['reason']}" for grid in found if grid["reason"]})
        if broken := sum(grid.get("non_finite", 0) for grid in found):
            notes.append(f"{name}: {broken:,} active values are NaN or infinite")
    console.print(table)
    for note in notes:
        console.print(_printable(note))
    console.print(f"{sum(Path(file['path']).stat().st_size for file in files) / 1e6:.1f} MB; --frames lists each file")


def _printable(text: str) -> str:
    """Replace control characters in a file name, so that the terminal does not interpret them."""
    return "".join(c if c.isprintable() or c == "\n" else "�" for c in text)


VDB_COMMAND = Command(
    "vdb",
    "print what OpenVDB files contain",
    _vdb_info_command,
    _add_vdb_arguments,
    "`info` lists grids: type, transform, bounds, active voxels, values, memory.",
)

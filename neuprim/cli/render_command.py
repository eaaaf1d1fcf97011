"""``neuprim render``: draw images of a run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import (
    RENDER_OVERRIDES_HELP,
    Command,
    parse_count,
    parse_number,
    parse_rate,
    parse_size,
    take_conditions,
    take_render_overrides,
)
from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from neuprim.core.environment import EnvironmentFile

_CONDITIONS = """\
Each condition of the run's task (time, light, ...) is a flag, given after RUN_DIR: --time 0.5; a number may also be a
list or a range, --time 0.2,0.8 or --time 0:1:20, one frame each.

"""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    cameras = (
        "which cameras; a file is JSON (frames, or a path of nerfstudio's viewer), USD (FILE#/PRIM) or a "
        "COLMAP model's folder"
    )
    parser.add_argument("--camera", required=True, metavar="orbit|test|FILE", help=cameras)
    space = (
        "coordinates of a file's cameras, of lights, and in .exr files: those of the run's data "
        "(default), or of the model (volumes: its unit box)"
    )
    parser.add_argument("--space", choices=("world", "scene"), help=space)
    parser.add_argument("--size", type=parse_size, metavar="WxH", help="pixels (default: the data set's)")
    formats = ("png", "exr", "npy", "webp", "gif", "mp4")
    parser.add_argument("--format", choices=formats, help="default: png, or webp for an animation")
    layers = (
        "of an .exr: beauty, alpha, depth, density, and what the run's task adds (an unknown name lists "
        "them); default: all"
    )
    parser.add_argument("--layers", metavar="NAME,...", help=layers)
    datatype = (
        "light and alpha of an .exr in 16 or 32 bits (default: float); depth and other numbers are float in either"
    )
    parser.add_argument("--datatype", choices=("half", "float"), help=datatype)
    rate = "frames per second of an animation (default: about four seconds in all)"
    parser.add_argument("--fps", type=parse_rate, metavar="F", help=rate)
    parser.add_argument("--out", type=Path, metavar="PATH", help="where to write (default: in RUN_DIR)")
    parser.add_argument("--frames", type=parse_count, default=60, metavar="N", help="frames of an orbit (default: 60)")
    parser.add_argument("--force", action="store_true", help="replace pictures of the run's report")
    group = parser.add_argument_group("light from all around, for tasks with a light")
    image = "radiance by latitude and longitude, twice as wide as high"
    group.add_argument("--environment", type=Path, metavar="FILE.exr", help=image)
    lights = "lights that stand for it (default: 64)"
    group.add_argument("--environment-samples", type=_parse_lights, metavar="N", help=lights)
    rotation = "anticlockwise about up, seen from above (default: 0)"
    group.add_argument("--environment-rotation", type=_parse_degrees, metavar="DEG", help=rotation)
    scale = "multiplies its radiance (default: 1)"
    group.add_argument("--environment-scale", type=_parse_factor, metavar="X", help=scale)
    unseen = "light from where the model never saw any: draw what it guesses, or leave it out (default: keep)"
    group.add_argument("--environment-unseen", choices=("keep", "drop"), help=unseen)


def _take_rest(arguments: argparse.Namespace, rest: list[str], parser: argparse.ArgumentParser) -> list[str]:
    return take_conditions(arguments, take_render_overrides(arguments, rest, parser), parser)


def _render(arguments: argparse.Namespace) -> int:
    camera = arguments.camera
    if camera not in ("orbit", "test") and not any(Path(n).exists() for n in (camera, camera.partition("#")[0])):
        raise ConfigError(f"--camera {camera}: no such file; expected orbit, test, or a file or folder of cameras")
    environment = _read_environment(arguments)
    from neuprim.cli.progress import DrawProgress
    from neuprim.runs.render_images import RenderRequest, render_run

    given = {"space": arguments.space, "layers": arguments.layers, "datatype": arguments.datatype}
    more: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    request = RenderRequest(
        camera,
        size=arguments.size,
        format=arguments.format,
        out=arguments.out,
        frames=arguments.frames,
        conditions=arguments.conditions,
        fps=arguments.fps,
        environment=environment,
        overrides=arguments.words,
        overwrite=arguments.force,
        **more,
    )
    with DrawProgress() as progress:
        paths = render_run(arguments.run, request, notify=progress.note, progress=progress.show)
    print(*paths, sep="\n")
    return 0


def _read_environment(arguments: argparse.Namespace) -> EnvironmentFile | None:
    given = {name: getattr(arguments, f"environment_{name}") for name in ("samples", "rotation", "scale", "unseen")}
    settings = {name: value for name, value in given.items() if value is not None}
    if arguments.environment is None:
        for name in settings:
            raise ConfigError(f"--environment-{name} is given without --environment FILE.exr")
        return None
    from neuprim.core.environment import EnvironmentFile

    guesses = settings.pop("unseen", "keep") == "keep"
    return EnvironmentFile(arguments.environment, **settings, guesses=guesses)


def _parse_lights(text: str) -> int:
    return int(parse_number(text, 1, 4096, "a whole number from 1 to 4096", whole=True))


def _parse_degrees(text: str) -> float:
    return parse_number(text, -1e6, 1e6, "an angle in degrees")


def _parse_factor(text: str) -> float:
    return parse_number(text, 0.0, 1e6, "a factor from 0 to 1e6")


COMMAND = Command(
    "render",
    "draw images of a run",
    _render,
    _add_arguments,
    _CONDITIONS + RENDER_OVERRIDES_HELP,
    _take_rest,
    opens_run=True,
)

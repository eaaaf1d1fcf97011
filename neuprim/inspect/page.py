"""One HTML file that draws the layers of all frames in any browser with WebGL 2, without a network: grids in 8 bits, a
ray march, sliders."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Protocol

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Inspector
from neuprim.core.io.files import write_text
from neuprim.inspect.field import FieldFrame
from neuprim.inspect.packing import Packed
from neuprim.inspect.paint import table
from neuprim.inspect.shapes import unit_sphere
from neuprim.inspect.stands import Stand, stand_of
from neuprim.inspect.views import DIFFERENCE, ISOSURFACE, SLICES, VOLUME

__all__ = ["Frames", "write_page"]

_ALWAYS = (VOLUME, ISOSURFACE, SLICES, DIFFERENCE)  # of grids that a page has anyway; the last where there is a truth
_SIZE_LIMIT = 2**29  # bytes of a page; browsers refuse longer strings


class Frames(Protocol):
    """What a page is made of: frames on one grid."""

    name: str
    up: str

    def __len__(self) -> int: ...

    def frame(self, index: int) -> FieldFrame: ...


def write_page(path: Path, film: Frames, inspectors: Sequence[Inspector]) -> None:
    """Writes the page, whole or not at all. It shows what was asked for first, and offers the built-in views of the
    same grids beside it.

    Raises:
        ConfigError: more frames than one page holds.
    """
    first = film.frame(0)
    free = [view for view in _ALWAYS if view.shows != "both" or first.truth is not None]
    views = [*free, *(view for view in inspectors if view not in free)]
    frames: list[dict[str, Any]] = []
    size = 0
    for i in range(len(film)):
        packed = Packed()
        frames.append(_frame(film.frame(i), views, film.up, packed))
        size += packed.size
        if size > _SIZE_LIMIT:
            raise ConfigError(
                f"--out {path}: more than {_SIZE_LIMIT >> 20} MiB after {i + 1} of {len(film)} frames; expected fewer, or a smaller --grid"
            )
    points, faces = unit_sphere(1)
    data = {
        "up": film.up,
        "box": first.box.tolist(),
        "views": {
            view.name: {"numbers": view.shows in ("sigma", "both"), "alone": view.shows == "primitive"}
            for view in views
        },
        "first": inspectors[0].name,
        "maps": {name: table(name).ravel().tolist() for name in sorted(set(_maps(frames)))},
        "ball": {"points": points.ravel().round(6).tolist(), "faces": faces.ravel().tolist()},
        "frames": frames,
    }
    template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    write_text(
        path, template.replace("__TITLE__", html.escape(f"neuprim inspect: {film.name}")).replace("__DATA__", text)
    )


def _frame(frame: FieldFrame, views: Sequence[Inspector], up: str, packed: Packed) -> dict[str, Any]:
    sides = {
        view.name: ("model", "truth") if view.shows == "sigma" and frame.truth is not None else ("model",)
        for view in views
    }
    layers = {
        view.name: {side: packed.layers(view.layers(frame.of_side(side))) for side in sides[view.name]}
        for view in views
    }
    stands = {view.name: _stand(stand_of(view, frame, up)) for view in views if view.shows == "primitive"}
    numbers = None if frame.numbers is None else dict(frame.numbers)
    words = {"title": frame.title, "truthName": frame.truth_name, "numbers": numbers}
    return {**words, "stands": stands, "layers": layers, "arrays": packed.arrays}


def _stand(stand: Stand) -> dict[str, Any]:
    return {"focus": stand.focus.tolist(), "radius": stand.radius, "away": stand.away.tolist()}


def _maps(frames: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Names of all colour maps, more than once."""
    for frame in frames:
        for sides in frame["layers"].values():
            for layers in sides.values():
                yield from (layer["scale"]["colours"] for layer in layers if layer.get("scale"))

"""One HTML file that shows the frames in any browser with WebGL 2, without a network: grids in 8 bits, a ray march, sliders."""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Protocol

import matplotlib
import numpy as np
import torch

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Inspector
from neuprim.core.io.files import write_text
from neuprim.plugins.inspect.field import UNIT, FieldFrame
from neuprim.plugins.inspect.shapes import unit_sphere
from neuprim.plugins.inspect.views import COLOURS, DIFFERENCE, ISOSURFACE, PRIMITIVES, SLICES, VOLUME, strongest

__all__ = ["PRIMITIVES_LIMIT", "Frames", "encoded", "write_page"]

PRIMITIVES_LIMIT = 4000
"""Ellipsoids of a frame that a page holds, those that absorb most."""

_VIEWS = {view.name: view for view in (VOLUME, ISOSURFACE, SLICES, DIFFERENCE, PRIMITIVES)}
_SIZE_LIMIT = 2**29  # bytes of a page; browsers refuse longer strings


class Frames(Protocol):
    """What a page is made of: frames on one grid."""

    name: str
    up: str

    def __len__(self) -> int: ...

    def frame(self, index: int) -> FieldFrame: ...


def write_page(path: Path, film: Frames, inspectors: Sequence[Inspector]) -> None:
    """Writes the page, whole or not at all.

    Raises:
        ConfigError: an inspector that a page cannot show, or more frames than one page holds.
    """
    for inspector in inspectors:
        if _VIEWS.get(inspector.name) is not inspector:  # another package's of that name draws something else
            raise ConfigError(f"--show {inspector.name}: not in a page, which shows {', '.join(_VIEWS)}; give --out FILE.png")
    names = [i.name for i in inspectors]
    frames: list[dict[str, Any]] = []
    first, size = film.frame(0), 0
    for i in range(len(film)):
        frames.append(_frame(film.frame(i), "primitives" in names))
        size += sum(len(v) for v in frames[-1].values() if isinstance(v, str))
        if size > _SIZE_LIMIT:
            raise ConfigError(
                f"--out {path}: more than {_SIZE_LIMIT >> 20} MiB after {i + 1} of {len(film)} frames; expected fewer, or a smaller --grid"
            )
    there = {"difference": first.truth is not None, "primitives": "primitives" in names}
    points, faces = unit_sphere(1)
    data = {
        "unit": UNIT,
        "up": film.up,
        "shape": first.shape,
        "box": first.box.tolist(),
        "step": first.step,
        "top": first.top,
        "gain": first.gain,
        "focus": [float(x) for x in (np.array(first.focus) - first.box[0]) / (first.box[1] - first.box[0])],
        "modes": [v for v in _VIEWS if there.get(v, True)],
        "first": names[0],
        "lut": _colours(COLOURS),
        "cold": _colours("coolwarm"),
        "ball": {"points": points.ravel().round(6).tolist(), "faces": faces.ravel().tolist()},
        "frames": frames,
    }
    template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    write_text(path, template.replace("__TITLE__", html.escape(f"neuprim inspect: {film.name}")).replace("__DATA__", text))


def encoded(values: np.ndarray, top: float) -> np.ndarray:
    """uint8 of (X, Y, Z) extinctions 0..``top``: 255 sqrt(sigma/top), which spends most of its steps on thin matter."""
    return np.asarray(np.rint(255 * np.sqrt(np.clip(values / top, 0.0, 1.0))).astype(np.uint8))


def _frame(frame: FieldFrame, with_primitives: bool) -> dict[str, Any]:
    sides = {"sigma": frame.sigma, **({} if frame.truth is None else {"truth": frame.in_panel(0, "truth").sigma})}
    found: dict[str, Any] = {name: _packed(encoded(values, frame.top).ravel(order="F")) for name, values in sides.items()}
    if with_primitives:
        chosen = strongest(frame)[:PRIMITIVES_LIMIT]
        one = frame.geometry[torch.from_numpy(chosen)]
        axes = (one.rotations * one.scales[:, None, :]).transpose(1, 2).reshape(-1, 9).detach().numpy()  # axis after axis
        found["prims"] = _packed(np.c_[one.means.detach().numpy(), axes, frame.colours[chosen]].astype("<f4"))
    return {**found, "title": frame.title, "truthName": frame.truth_name, "numbers": None if frame.numbers is None else dict(frame.numbers)}


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(values.tobytes(), 9)).decode()


def _colours(name: str) -> list[int]:
    return [int(v) for v in np.rint(255 * matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3]).ravel()]

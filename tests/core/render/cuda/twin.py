"""One frame's arrays from the numba backend, in the cuda backend's form, and the scenes on which the two are
compared."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.render import layout as P
from neuprim.core.render.cpu.backend import _rasterizer_view
from neuprim.core.render.cpu.prepare import PrimitiveArrays, Projected, View, prepare_primitives, prepare_wide
from neuprim.core.render.cpu.tiles import TileLists, bin_primitives
from neuprim.core.render.cuda.prepare import Frame, prepare_frame
from neuprim.core.render.layout import NON_FINITE, VISIBLE, min_visible_depth
from neuprim.core.render.output import RenderStats
from neuprim.core.render.rasterize import PARAMETERS, RasterRequest
from neuprim.core.settings import RenderSettings
from tests import scenes

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Case:
    """A scene and how it is looked at."""

    neurons: int
    channels: int = 3
    edge: int = 0
    near: float = 0.01
    dtype: torch.dtype = torch.float32
    wild: bool = False
    count: int = 500
    scene: dict[str, Any] = field(default_factory=dict)
    view: dict[str, Any] = field(default_factory=dict)
    omega0: float = 30.0

    @property
    def turns(self) -> float:
        return self.omega0 / (2 * math.pi)

    @property
    def camera(self) -> Camera:
        return scenes.camera(**{"width": 150, "height": 110, **self.view})

    def tensors(self) -> dict[str, Tensor]:
        t = scenes.tensors(self.count, self.neurons, self.channels, seed=11, dtype=torch.float64, **self.scene)
        if self.wild:
            widen(t)
        t["b2"] = t["b2"].reshape(-1)
        return {name: value.to(self.dtype) for name, value in t.items()}


def widen(t: dict[str, Tensor]) -> None:
    """Needles, discs, specks and giants, before, around and behind the camera, some with fast neurons, some smaller
    than float32 can tell."""
    g = torch.Generator().manual_seed(3)
    count = len(t["means"])
    t["means"] *= 5.0
    t["log_scales"] = 9.0 * torch.rand(count, 3, generator=g, dtype=torch.float64) - 8.0
    t["log_scales"][: count // 20] -= 75.0 * torch.rand(count // 20, 1, generator=g, dtype=torch.float64)
    t["log_scales"][count // 20 : count // 10] += 3.0
    t["W1"] *= (6.0 * torch.rand(count, 1, 1, generator=g, dtype=torch.float64) - 2.0).exp()


CASES = {
    "K=8": Case(8),
    "K=0 C=1": Case(0, channels=1),
    "K=3 C=5, float64": Case(3, channels=5, dtype=torch.float64),
    "K=16 C=4": Case(16, channels=4, count=100),
    "many small": Case(2, count=1500, scene={"radius": 0.03}),
    "soft edge before the near plane": Case(2, edge=2, near=2.9),
    "fast neurons": Case(8, omega0=300.0),
    "inside": Case(8, view={"distance": 0.15, "fov": 70.0}),
    "wild": Case(8, wild=True, count=2000, view={"distance": 2.0, "fov": 70.0}),
    "wild, no neurons, soft edge": Case(0, edge=2, wild=True, count=2000, near=0.3),
    "wild, principal point far off": Case(2, wild=True, count=2000, view={"shift": (-30000.0, 40.0), "fov": 0.5}),
    "wild, principal point off": Case(
        2, edge=1, wild=True, count=2000, dtype=torch.float64, view={"shift": (60.0, -90.0)}
    ),
    "one pixel": Case(2, view={"width": 1, "height": 1, "fov": 5.0}),
}


LEAST = min_visible_depth(1 / 255)


@dataclass
class Numba:
    """What the numba backend makes of a frame; neurons by ``order``."""

    case: Case
    parameters: PrimitiveArrays
    view: View
    projected: Projected
    which: Array
    wide: Array
    lists: TileLists

    @property
    def visible(self) -> Array:
        return self.projected.status == VISIBLE

    def neurons(self, rows: Array, which: Array) -> Array:
        """(n, K, 5) neurons in the model's order, from rows of primitives ``which``."""
        order = self.projected.order
        K = order.shape[1]
        given = rows[:, P.NEURONS : P.NEURONS + P.PER_NEURON * K].reshape(len(rows), K, P.PER_NEURON)
        out = np.empty_like(given)
        np.put_along_axis(out, np.repeat(order[which].astype(np.int64)[:, :, None], P.PER_NEURON, 2), given, 1)
        return out


def numba_frame(case: Case, t: dict[str, Tensor]) -> Numba:
    parameters = PrimitiveArrays(*(t[name].numpy() for name in PARAMETERS))
    count, K = parameters.W1.shape[:2]
    projected = Projected.allocate(count, K)
    view = _rasterizer_view(case.camera, case.camera.viewmat, case.near, case.turns)
    projected.order[:], projected.rows[:] = 0, 0  # which are not filled for what is too faint
    prepare_primitives(0, count, parameters, view, case.edge, LEAST, projected)
    which = np.flatnonzero(projected.in_float64 & (projected.status == VISIBLE))
    wide = np.empty((len(which), projected.rows.shape[1]))
    prepare_wide(0, len(which), which, parameters, view, projected.order, wide)
    lists = bin_primitives(projected, case.camera.width, case.camera.height, 1)
    return Numba(case, parameters, view, projected, which, wide, lists)


def both(name: str, device: str) -> tuple[Numba, Frame]:
    """The same frame of both backends, of those primitives of a case that are finite."""
    case = CASES[name]
    t = case.tensors()
    finite = torch.from_numpy(numba_frame(case, t).projected.status != NON_FINITE)
    t = {key: value[finite] for key, value in t.items()}
    return numba_frame(case, t), frame_of(case, t, device)


def frame_of(case: Case, t: dict[str, Tensor], device: str, forced: Tensor | None = None) -> Frame:
    t = {key: value.to(device) for key, value in t.items()}
    settings = RenderSettings(near=case.near, alpha_min=1 / 255)
    request = RasterRequest(case.camera, case.turns, case.edge, settings, RenderStats("cuda", case.count))
    return prepare_frame(request, case.camera.viewmat, t["colors"], [t[name] for name in PARAMETERS], forced)


def numpy(tensor: Tensor) -> Array:
    array: Array = tensor.cpu().numpy()
    return array


def ulps(a: Array, b: Array) -> Array:
    """Distance in units of the last place of float32."""
    with np.errstate(invalid="ignore", over="ignore"):
        unit = np.spacing(np.maximum(np.abs(a), np.abs(b)).astype(np.float32)).astype(np.float64)
        distance: Array = np.where(a == b, 0.0, np.abs(a.astype(np.float64) - b) / unit)
    return distance

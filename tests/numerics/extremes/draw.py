"""Random primitives and cameras with prescribed proportions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.geometry import quaternion_to_matrix
from tests import scenes
from tests.numerics.extremes.measure import OPEN, Case
from tests.numerics.extremes.oracle import GAIN_LIMIT, Integrals, long_integrals

__all__ = [
    "SIZE", "aimed", "amplified", "crowd", "cut", "grazing", "log_uniform", "networked", "normalised", "primitive",
    "signed", "silhouette", "single",
]  # fmt: skip

SIZE = 24  # pixels on a side


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high)))) if high > low else low


def primitive(
    rng: np.random.Generator, ratio: float, kind: str, neurons: int, scale: float = 1.0, mean: float = 1.0
) -> dict[str, Tensor]:
    """One primitive with axis ratio ``ratio``: "needle" (one long axis), "disc" (one thin axis) or "any"."""
    a, b = 1.0, 1.0 / ratio
    middle = {"needle": b * rng.uniform(1.05, 1.3), "disc": a * rng.uniform(0.75, 0.95), "any": log_uniform(rng, b, a)}[
        kind
    ]
    axes = np.array([a, min(middle, 0.95), b]) if ratio > 1.1 else np.array([1.0, 0.93, 0.85])
    rng.shuffle(axes)
    t = {
        "means": rng.normal(size=(1, 3)) * scale * mean,
        "log_scales": np.log(axes)[None] + math.log(scale),
        "quats": rng.normal(size=(1, 4)),
        "W1": rng.normal(size=(1, neurons, 3)),
        "b1": rng.uniform(-1, 1, size=(1, neurons)),
        "w2": rng.uniform(-1, 1, size=(1, neurons)) * 0.7 / max(neurons, 1),
        "b2": rng.uniform(0.4, 1.0, size=(1, 1)),
        "colors": rng.uniform(0.2, 1.0, size=(1, 3)),
    }
    return {k: torch.from_numpy(v).float().double() for k, v in t.items()}


def aimed(
    rng: np.random.Generator, t: dict[str, Tensor], distance: float, pixels: float, fov: float | None, off: float
) -> Camera:
    """A camera ``distance`` m from the centre that sees a random inner point at a random pixel.

    ``pixels``: how many pixels wide a length of the *thinnest* axis is, unless ``fov`` is given. ``off``: the principal
    point's distance from the middle of the image, in image widths.
    """
    s = t["log_scales"][0].exp()
    m = float(s.max())
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    eye = t["means"][0].numpy() + way * distance * m
    inner = rng.normal(size=3)
    inner *= rng.uniform() ** (1 / 3) * 0.9 / np.linalg.norm(inner)
    local = quaternion_to_matrix(t["quats"][0]).numpy()
    target = t["means"][0].numpy() + local @ (s.numpy() * inner)
    to = target - eye
    far = np.linalg.norm(to)
    f = SIZE / 2 / math.tan(math.radians(fov) / 2) if fov else max(pixels * far / float(s.min()), 0.2 * SIZE)
    angle = rng.uniform(0, 2 * math.pi)
    cx, cy = SIZE / 2 + off * SIZE * math.cos(angle), SIZE / 2 + off * SIZE * math.sin(angle)
    px, py = rng.uniform(0.25, 0.75, size=2) * SIZE
    ray = np.array([(px - cx) / f, (py - cy) / f, 1.0])
    ray /= np.linalg.norm(ray)
    # a rotation that takes the unit vector towards the target to the pixel's ray
    frame_a, frame_b = _basis(to / far, rng), _basis(ray, rng)
    R = frame_b @ frame_a.T
    u, _, vt = np.linalg.svd(R)
    R = u @ vt
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = torch.from_numpy(R)
    view[:3, 3] = torch.from_numpy(-R @ eye)
    return Camera(view, f, f * rng.uniform(0.9, 1.1), cx, cy, SIZE, SIZE)


def _basis(z: np.ndarray, rng: np.random.Generator) -> np.ndarray:  # type: ignore[type-arg]
    x = np.cross(z, rng.normal(size=3))
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], 1)


def normalised(t: dict[str, Tensor], exact: Integrals, rate: float | None, depth: float) -> dict[str, Tensor]:
    """Weights such that the largest S is ``depth`` and, if given, the fastest neuron turns ``rate`` radians along a
    chord."""
    out = dict(t)
    factor = depth / float(exact.scale.max())
    out["w2"], out["b2"] = t["w2"] * factor, t["b2"] * factor
    top = float(exact.rate.max())
    if rate is not None and top > 0:
        out["W1"] = t["W1"] * (rate / top)
    return {k: v.float().double() for k, v in out.items()}


def single(
    rng: np.random.Generator,
    distance: tuple[float, float] = (2.0, 5.0),
    ratio: tuple[float, float] = (1.2, 3.0),
    kind: str | None = None,
    rate: tuple[float, float] | float = (0.3, 10.0),
    neurons: int | None = None,
    pixels: tuple[float, float] = (2.0, 12.0),
    fov: float | None = None,
    off: float = 0.0,
    depth: float = 1.0,
    scale: float = 1.0,
    mean: float = 1.0,
    minimum: int = 4,
) -> Case:
    """One primitive that a 24 x 24 view meets in at least ``minimum`` pixels."""
    near = 0.01 * scale
    for _ in range(200):
        K = int(rng.choice([0, 1, 3, 8, 16])) if neurons is None else neurons
        t = primitive(rng, log_uniform(rng, *ratio), kind or str(rng.choice(["needle", "disc", "any"])), K, scale, mean)
        camera = aimed(rng, t, log_uniform(rng, *distance), log_uniform(rng, *pixels), fov, off)
        exact = long_integrals(t, 0, camera, near)
        if int(((exact.D > 0.1) & exact.hit).sum()) >= minimum:
            wanted = log_uniform(rng, *rate) if isinstance(rate, tuple) else rate
            return Case(normalised(t, exact, wanted, depth), camera, replace(OPEN, near=near))
    raise RuntimeError("no view of these proportions met the primitive")


def grazing(rng: np.random.Generator) -> Case:
    """A view of a few pixels of the rim only, so that most chords have D < 0.01."""
    for _ in range(50):
        case = single(rng, pixels=(300.0, 3000.0), minimum=SIZE * SIZE)
        # shift the principal point until the silhouette passes through the image: bisection between the centre and a
        # miss
        angle = rng.uniform(0, 2 * math.pi)
        inside, outside = 0.0, 4e6

        def moved(step: float, case: Case = case, angle: float = angle) -> Case:
            c = case.camera
            return replace(case, camera=replace(c, cx=c.cx + step * math.cos(angle), cy=c.cy + step * math.sin(angle)))

        for _ in range(60):
            found = moved((inside + outside) / 2)
            exact = long_integrals(found.tensors, 0, found.camera, found.settings.near)
            if 0.05 < exact.hit.mean() < 0.95:  # at once: going on would put a pixel on the silhouette to the last bit
                return replace(found, tensors=normalised(found.tensors, exact, None, 1.0))
            inside, outside = (
                ((inside + outside) / 2, outside) if exact.hit.mean() > 0.5 else (inside, (inside + outside) / 2)
            )
    raise RuntimeError("no view of a rim found")


def silhouette(rng: np.random.Generator) -> Case:
    """The same with one pixel on the rim itself, |D| of 1e-12 or less, where a hard edge has no bounded gradient; no
    floor under D."""
    case = grazing(rng)
    exact = long_integrals(case.tensors, 0, case.camera, case.settings.near)
    y, x = (int(i[0]) for i in np.nonzero(np.abs(exact.D) == np.abs(exact.D).min()))
    c = case.camera
    for axis in ("cx", "cy"):  # where D changes its sign as the principal point moves along the one or the other
        for way in (1.0, -1.0):
            low, high = 0.0, 30.0 * way
            for _ in range(80):
                middle = (low + high) / 2
                moved = replace(c, **{axis: getattr(c, axis) + middle})  # type: ignore[arg-type]
                inside = bool(long_integrals(case.tensors, 0, moved, case.settings.near).D[y, x] > 0)
                low, high = (middle, high) if inside == bool(exact.D[y, x] > 0) else (low, middle)
            found = replace(c, **{axis: getattr(c, axis) + low})  # type: ignore[arg-type]
            if abs(float(long_integrals(case.tensors, 0, found, case.settings.near).D[y, x])) < 1e-12:
                return replace(case, camera=found, settings=replace(case.settings, depth_floor=1e-30))
    raise RuntimeError("no pixel on the rim found")


def amplified(rng: np.random.Generator, case: Case) -> Case:
    """The same with a gain, up to four times beyond its clamp, and weights that make up for it."""
    log_gain = float(rng.choice([-1, 1]) * rng.choice([5.0, 19.9, 20.1, 80.0]))
    undone = math.exp(-max(min(log_gain, GAIN_LIMIT), -GAIN_LIMIT))
    t = {k: (v * undone).float().double() if k in ("w2", "b2") else v for k, v in case.tensors.items()}
    return replace(case, tensors=t | {"log_gain": torch.full((1, 1), log_gain, dtype=torch.float32).double()})


def signed(rng: np.random.Generator) -> Case:
    """Densities whose integral is negative on some chords and positive on others."""
    case = single(rng, neurons=int(rng.choice([1, 8])), rate=(3.0, 20.0))
    t = dict(case.tensors)
    t["b2"] = t["b2"] * float(rng.uniform(-0.3, 0.1))
    exact = long_integrals(t, 0, case.camera, case.settings.near)
    return replace(case, tensors=normalised(t, exact, None, 1.0))


def cut(rng: np.random.Generator, alpha_min: float = 0.0, alpha_max: float = 0.9999) -> Case:
    """Opacities on both sides of a cut or a clamp."""
    case = single(rng, distance=(2.0, 50.0), depth=1.5)
    return replace(case, settings=replace(case.settings, alpha_min=alpha_min, alpha_max=alpha_max))


def crowd(
    rng: np.random.Generator,
    count: int,
    equal: bool = False,
    alpha_min: float = 0.0,
    alpha_max: float = 0.9999,
    transmittance_min: float = 0.0,
) -> Case:
    """Overlapping primitives on one view; ``equal`` puts pairs of centres at the same depth to the bit."""
    t = scenes.tensors(count, int(rng.choice([1, 4, 8])), seed=int(rng.integers(1 << 30)), radius=0.3)
    camera = scenes.camera(SIZE, SIZE, distance=float(rng.uniform(2.0, 6.0)), fov=30.0)
    if equal:  # looking along z from a whole distance, depths are the centres' z
        view = torch.eye(4, dtype=torch.float64)
        view[2, 3] = 4.0
        camera = replace(camera, viewmat=view)
        t["means"][1::2, 2] = t["means"][0::2, 2]
    settings = replace(OPEN, alpha_min=alpha_min, alpha_max=alpha_max, transmittance_min=transmittance_min)
    return Case({k: v.double() for k, v in t.items()}, camera, settings)


def networked(rng: np.random.Generator, case: Case, rate: tuple[float, float] | float = (0.5, 10.0)) -> Case:
    """The same with a colour network per primitive, whose fastest unit turns ``rate`` radians over a length of 2 m."""
    t = {k: v for k, v in case.tensors.items() if k != "colors"}
    n, hidden = len(t["means"]), int(rng.choice([1, 8, 16]))
    Wx = rng.normal(size=(n, hidden, 3))
    turn = log_uniform(rng, *rate) if isinstance(rate, tuple) else rate
    Wx *= turn / 2 / np.linalg.norm(Wx, axis=-1).max(axis=1)[:, None, None]
    network = {
        "Wx": Wx,
        "bias": rng.uniform(-math.pi, math.pi, size=(n, hidden)),
        "Wout": rng.uniform(-1, 1, size=(n, 3, hidden)) / math.sqrt(hidden),
        "base": rng.uniform(0.2, 1.0, size=(n, 3)),
    }
    return replace(case, tensors=t | {k: torch.from_numpy(v).float().double() for k, v in network.items()})

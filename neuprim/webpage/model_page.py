"""Make one HTML file that shows a model. The file has the model's parameters, cameras, images and rendering scripts."""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, orbit
from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels
from neuprim.core.compression.codec import canonical_model, fit_quantizers, storage_order
from neuprim.core.compression.quantizers import RotationQuantizer, bit_table
from neuprim.core.compression.sections import COLUMNS, ROTATIONS, pack_section
from neuprim.core.conditions import FRAMES
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.io.images import encode_webp_data_uri
from neuprim.core.model.edge import EDGES, edge_profile
from neuprim.core.model.fields import ConditionSpec, Field
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.near_plane import resolve_near
from neuprim.core.settings import RenderSettings

_SHARED_SCRIPTS = ("lib.js", "codec.js", "sort.js", "prepare.js", "shadow.js", "worker.js")  # run by the worker, too
_MAIN_SCRIPTS = ("painter.js", "frames.js", "camera.js", "conditions.js", "main.js", "probe.js")
_SHADERS = ("splat.vert", "splat.frag", "screen.vert", "resolve.frag")
_PLACEHOLDER = re.compile(r"@(\w+)@")
_MAX_SLIDER_RANGE = 1e4
_JSON_INFINITY = 1e30  # JSON has no infinity
_SWEEP_SECONDS = 6.0
_QUANTILE_ROWS = 100_000  # torch.quantile is limited
_TRUTH_PIXELS, _STILL_PIXELS = 320, 640

DrawView = Callable[[Primitives, Camera, Mapping[str, Tensor]], Tensor]
"""Function (model, camera, conditions) -> (H, W, C) image over the scene's background."""


class Condition(NamedTuple):
    """A condition of the task, e.g. time, and its initial value on the page."""

    spec: ConditionSpec
    value: Tensor
    frames: tuple[int, int] | None = None  # numbers of the frames at both ends of the range, shown instead of the value
    fps: float | None = None  # frames per second at which the page plays; None for six seconds


@dataclass(frozen=True)
class PageView:
    """A view that the page can jump to; ``truth`` is its ground truth image as ``data:image/...``, or "" for none."""

    name: str
    camera: Camera
    conditions: Mapping[str, Tensor]
    truth: str = ""


@dataclass(frozen=True)
class PageScene:
    """What a page needs in addition to the model: background, upward axis, conditions and views.

    Attributes:
        background: (C,) in the model's colour space.
        linear: whether colours are linear light; if so, the page converts them to sRGB.
        views: cameras of the page, which opens with the first one.
        still: image to show if the browser cannot render the model, as ``data:image/...``.
        world: the coordinates of the user's files. The page itself uses the model's coordinates.
    """

    subtitle: str = ""
    background: Sequence[float] = (0.0, 0.0, 0.0)
    linear: bool = False
    up: Sequence[float] = (0.0, 0.0, 1.0)
    conditions: Sequence[Condition] = ()
    views: Sequence[PageView] = ()
    still: str = ""
    world: World | None = None


@dataclass(frozen=True)
class WebPage:
    """A finished page that renders a model.

    Attributes:
        text: content of the HTML file.
        model: the model with the parameter values that the page stores.
        nonce: random text that marks the page's own scripts in its content security policy. A page that embeds this
            page must allow the same nonce.
    """

    text: str
    model: Primitives
    nonce: str


def make_model_webpage(
    name: str,
    model: Primitives,
    rgb: tuple[int, int, int],
    settings: RenderSettings,
    scene: PageScene,
    level: int = 0,
) -> WebPage:
    """Make a page that renders a model.

    Args:
        rgb: indices of the model's channels that are red, green and blue.
        settings: render settings; only ``alpha_min``, ``alpha_max`` and the near plane are used.
        level: see :func:`pack_webpage_model`.

    Raises:
        ConfigError: a field has no script for browsers, or the level does not exist.
        CheckpointError: a parameter has values that cannot be stored.
    """
    scripts = {"density": _field_script("density", model.density), "colour": _field_script("colour", model.colour)}
    packed = pack_webpage_model(model, level)
    middle, radius, top = _measure_webpage_extent(
        packed.model, fullest_webpage_conditions(packed.model, scene.conditions)
    )
    home = scene.views[0].camera if scene.views else _make_webpage_camera(middle, radius, scene.up)
    header = {
        "name": name,
        "count": model.count,
        "fields": {"density": model.density.settings(), "colour": model.colour.settings()},
        "numbers": packed.parts,
        "rgb": list(rgb),
        "background": [float(scene.background[c]) for c in rgb],
        "linear": scene.linear,
        "renderer": {key: getattr(settings, key) for key in ("alpha_min", "alpha_max")},
        "near": resolve_near(settings, packed.model.params["means"], [home]).near_plane,
        "constants": [shader_constants(edge) for edge in EDGES],
        "up": [float(x) for x in scene.up],
        "center": middle,
        "radius": radius,
        "top": top,
        "conditions": [_condition_json(condition) for condition in scene.conditions],
        "views": [_view_json(view) for view in scene.views],
        "still": bool(scene.still),
        **({} if scene.world is None or scene.world.identity else {"world": scene.world.to_json()}),
        "home": webpage_camera_numbers(home),
    }
    assets = resources.files(__package__).joinpath("assets")
    names = ("page.html", "page.css", *_SHARED_SCRIPTS, *_MAIN_SCRIPTS, *_SHADERS)
    texts = {path: assets.joinpath(path).read_text(encoding="utf-8") for path in names}
    fields = "".join(f"{kind}: {script.rstrip().rstrip(';')},\n" for kind, script in scripts.items())
    shaders = f"const shaders = {json.dumps({path: texts[path] for path in _SHADERS})};"
    parts = {
        "title": html.escape(name),
        "subtitle": html.escape(scene.subtitle),
        "style": texts["page.css"],
        "still": html.escape(scene.still),
        "page": json.dumps(header, allow_nan=False).replace("<", "\\u003c"),
        "numbers": base64.b64encode(packed.data).decode(),
        "shared": "\n".join([*(texts[path] for path in _SHARED_SCRIPTS), f"const fieldScripts = {{\n{fields}}};"]),
        "main": "\n".join([shaders, *(texts[path] for path in _MAIN_SCRIPTS)]),
    }
    parts["nonce"] = hashlib.sha256("".join(parts.values()).encode()).hexdigest()[:32]  # no text inside can know it
    text = _PLACEHOLDER.sub(lambda place: parts[place.group(1)], texts["page.html"])
    return WebPage(text, packed.model, parts["nonce"])


def _field_script(kind: str, field: Field) -> str:
    """Return the JavaScript with which a browser evaluates the field, without the comment lines at the top."""
    text = field.script()
    if text is None:
        raise ConfigError(
            f"{kind} field {type(field).__name__} has no JavaScript version, so a page cannot show it; "
            "expected a field with a method script()"
        )
    if not isinstance(text, str) or "</script" in text.lower() or "<!--" in text:
        expected = "script() must return JavaScript text without </script or <!--"
        raise ConfigError(f"{kind} field {type(field).__name__}: {expected}")
    return re.sub(r"^(//[^\n]*\n)+", "", text)


# ---------------------------------------------------------------- scene


def held_out_webpage_views(dataset: Dataset, channels: Channels, limit: int, truths: bool = True) -> list[PageView]:
    """Return up to ``limit`` evenly spread held-out views of pinhole cameras; the view with most contrast is first.

    Args:
        truths: whether the views hold their ground truth.
    """
    count = min(limit, len(dataset.test))
    views, contrasts = [], []
    for index in (k * len(dataset.test) // count for k in range(count)):
        view = dataset.test.view(index)
        if isinstance(view.camera, Camera):
            image = channels.display(dataset.test.pixels(index).over(dataset.background)).clamp(0.0, 1.0)
            truth = encode_webp_data_uri(image, _TRUTH_PIXELS) if truths else ""
            views.append(PageView(view.name, view.camera, view.conditions, truth))
            contrasts.append(float(image.std()))
    if views:  # the first frame of a sequence may be empty
        views.insert(0, views.pop(contrasts.index(max(contrasts))))
    return views


def initial_webpage_conditions(
    specs: Sequence[ConditionSpec],
    views: Sequence[PageView],
    given: Mapping[str, Tensor],
    frames: tuple[int, int] | None = None,
    fps: float | None = None,
) -> list[Condition]:
    """Return the initial value of each condition, float64.

    The value is that in ``given``, else that of the first view, else the middle of a bounded range, else 1. ``frames``
    and ``fps`` are those of the condition "time".
    """
    shown = {**(views[0].conditions if views else {}), **given}
    found = []
    for spec in specs:
        low, high = spec.range
        middle = torch.full(spec.shape, 0.5 * (low + high) if high - low < 1e4 else 1.0)
        played = (frames, fps) if spec.name == "time" else (None, None)
        found.append(Condition(spec, shown.get(spec.name, middle).double(), *played))
    return found


def webpage_subtitle(task: str, data_source: str) -> str:
    """Return a page's subtitle: the name of the task, and the kind of data if they are not real."""
    return task if data_source == "real" else f"{task}, {data_source} data"


def scene_page(
    name: str,
    model: Primitives,
    channels: Channels,
    settings: RenderSettings,
    draw: DrawView,
    scene: PageScene,
    level: int = 1,
) -> WebPage:
    """Make a page that renders a model. The page's colour space comes from ``channels``; ``draw`` renders the still
    image.

    Raises:
        ConfigError: the channels are not red, green and blue, or a field has no script for browsers.
        CheckpointError: a parameter has values that cannot be stored.
    """
    if channels.own is not None or channels.rgb is None:
        raise ConfigError(
            f"an HTML page needs red, green and blue; this model has {channels.display_text or channels.name_list}"
        )
    still = ""
    if scene.views:
        start = {condition.spec.name: condition.value for condition in scene.conditions}
        image = draw(model, scene.views[0].camera, scene.views[0].conditions or start)
        still = encode_webp_data_uri(channels.display(image).clamp(0.0, 1.0), _STILL_PIXELS)
    scene = replace(scene, still=still, linear=channels.color_space == "linear")
    return make_model_webpage(name, model, channels.rgb, settings, scene, level)


def stored_up_axis(header: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the upward direction (3,) in a model's header; +z if the header has no valid direction.

    A valid direction has three finite numbers that are not all 0.
    """
    data = header.get("data")
    up = data.get("up") if isinstance(data, Mapping) else None
    if not isinstance(up, list) or len(up) != 3 or not all(isinstance(x, int | float) and math.isfinite(x) for x in up):
        return 0.0, 0.0, 1.0
    return tuple(map(float, up)) if any(up) else (0.0, 0.0, 1.0)


def fullest_webpage_conditions(model: Primitives, conditions: Sequence[Condition]) -> dict[str, Tensor]:
    """Return the initial values of the conditions, e.g. the time, changed if no primitive is active at these values.

    In that case, one scalar condition is changed so that as many primitives as possible are active.
    """
    start = {condition.spec.name: condition.value for condition in conditions}
    if model.active(start).geometry.count:
        return start
    candidates = [
        start | {spec.name: start[spec.name].new_tensor(x)}
        for spec in (condition.spec for condition in conditions)
        if spec.shape == () and spec.range[1] - spec.range[0] <= _MAX_SLIDER_RANGE
        for x in torch.linspace(*spec.range, FRAMES).tolist()
    ]
    return max(candidates, key=lambda found: model.active(found).geometry.count, default=start)


@torch.no_grad()
def _measure_webpage_extent(model: Primitives, conditions: Mapping[str, Tensor]) -> tuple[list[float], float, float]:
    """Return centre and radius of a sphere around 98 % of the active primitives, and a typical extinction.

    The typical extinction is the 95 % quantile of the extinctions at the centres of the primitives.
    """
    active = model.active(conditions)
    if not active.geometry.count:
        return [0.0, 0.0, 0.0], 1.0, 1.0
    means, reach = active.geometry.means.double(), active.geometry.scales.double().amax(1)
    low, high = (torch.quantile(means[:_QUANTILE_ROWS], q, dim=0) for q in (0.01, 0.99))
    middle = (low + high) / 2
    radius = float(torch.quantile(((means - middle).norm(dim=1) + reach)[:_QUANTILE_ROWS], 0.98))
    sigma = active.sigma(torch.arange(len(means)), active.geometry.means).clamp_min(0).double()
    return middle.tolist(), radius or 1.0, float(torch.quantile(sigma[:_QUANTILE_ROWS], 0.95)) or 1.0


def _make_webpage_camera(middle: Sequence[float], radius: float, up: Sequence[float]) -> Camera:
    """Return a camera that shows a sphere with centre ``middle`` and this radius, from the side and slightly above."""
    template = Camera(torch.eye(4, dtype=torch.float64), 717.0, 717.0, 256, 256, 512, 512)
    return orbit(template, torch.tensor(middle), torch.tensor(up), 3.2 * radius, 0.4, 1)[0]


def webpage_camera_numbers(camera: Camera) -> dict[str, Any]:
    """Return a camera as JSON-ready values for the page's scripts.

    "R" (row by row) and "t" are rotation and translation from world to camera, OpenCV axes. The other values are
    intrinsics and image size in pixels.
    """
    view = camera.viewmat.detach().double().cpu()
    numbers = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return {"R": view[:3, :3].flatten().tolist(), "t": view[:3, 3].tolist(), **numbers}


def _view_json(view: PageView) -> dict[str, Any]:
    conditions = {name: value.double().tolist() for name, value in view.conditions.items()}
    return {
        "name": view.name,
        "camera": webpage_camera_numbers(view.camera),
        "conditions": conditions,
        "truth": view.truth,
    }


def _condition_json(condition: Condition) -> dict[str, Any]:
    """Return a condition as JSON for the page's controls. A range that is too long for a slider is shortened."""
    spec = condition.spec
    low, high = (min(max(float(end), -_JSON_INFINITY), _JSON_INFINITY) for end in spec.range)
    if spec.shape == () and high - low > _MAX_SLIDER_RANGE:
        low, high = float(condition.value) - 1.0, float(condition.value) + 1.0
    place = spec.shape == (3,) and spec.unit.startswith("position")
    value, frames, period = condition.value.double().tolist(), condition.frames, _SWEEP_SECONDS
    if frames is not None and condition.fps is not None:
        period = max(frames[1] - frames[0], 1) / condition.fps
    found = {"name": spec.name, "value": value, "range": [low, high], "place": place, "period": period}
    return found if frames is None else {**found, "frames": list(frames)}


# ---------------------------------------------------------------- constants of the shaders

_DEGREE = 7
_FIT_SAMPLES = 200
_QUADRATURE_POINTS = 16  # for chords that the near plane cuts; with 8 of them errors reach 3e-4


def shader_constants(edge: int) -> dict[str, list[float]]:
    """Return constants of the page's shader: coefficients of polynomials in z = v^2, and a Gauss-Legendre rule.

    Each polynomial, highest power first, approximates a function of v for |v| <= 1/2. "cos" is cos(2 pi v), "sinc" is
    sin(2 pi v)/(2 pi v), and "edge" is B_p(2 pi v) of :mod:`neuprim.core.model.edge` for p = ``edge``. "nodes" and
    "weights" are the Gauss-Legendre rule's nodes above 0 and their weights; the rule is symmetric.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_POINTS)
    turn = 2 * math.pi
    return {
        "cos": _fit_webpage_polynomial(lambda v: np.cos(turn * v)),
        "sinc": _fit_webpage_polynomial(lambda v: np.sinc(2 * v)),
        "edge": _fit_webpage_polynomial(lambda v: edge_profile(torch.from_numpy(turn * v), edge).numpy()),
        "nodes": nodes[_QUADRATURE_POINTS // 2 :].tolist(),
        "weights": weights[_QUADRATURE_POINTS // 2 :].tolist(),
    }


def _fit_webpage_polynomial(function: Callable[[np.ndarray], np.ndarray]) -> list[float]:
    """Return a polynomial in z = v^2 that fits ``function``(v) for 0 <= v <= 1/2: coefficients, highest power first."""
    z = 0.125 * (1 + np.cos(np.pi * (np.arange(_FIT_SAMPLES) + 0.5) / _FIT_SAMPLES))
    fit = np.polynomial.chebyshev.Chebyshev.fit(z, function(np.sqrt(z)), _DEGREE, domain=[0, 0.25])
    return fit.convert(kind=np.polynomial.Polynomial).coef[::-1].tolist()  # type: ignore[no-any-return]


# ---------------------------------------------------------------- parameters


class PackedModel(NamedTuple):
    """A model in the binary form that a page stores; ``assets/codec.js`` decodes it.

    Attributes:
        parts: encoding of each parameter, in the order of ``data``.
        data: gzipped byte planes of all parameters; a byte plane has one byte of every primitive.
        model: the model that decoding gives.
    """

    parts: tuple[dict[str, Any], ...]
    data: bytes
    model: Primitives


def pack_webpage_model(model: Primitives, level: int) -> PackedModel:
    """Pack all parameters for a page: exact at level 0, quantised at levels 1 to 5 like ``neuprim compress --level``.

    Raises:
        ConfigError: the level does not exist.
        CheckpointError: a parameter has values that cannot be stored.
    """
    packed = _pack_exact_for_webpage(model) if level == 0 else _pack_quantized_for_webpage(model, level)
    data = gzip.compress(b"".join(planes for _, planes, _ in packed), 9, mtime=0)
    decoded = Primitives(model.density, model.colour, {part["name"]: values for part, _, values in packed})
    return PackedModel(tuple(part for part, _, _ in packed), data, decoded)


_PackedParameters = list[tuple[dict[str, Any], bytes, Tensor]]


def _pack_exact_for_webpage(model: Primitives) -> _PackedParameters:
    packed: _PackedParameters = []
    for spec in model.specs:
        x = model.params[spec.name].detach().cpu().float().contiguous()
        bytes_ = x.reshape(model.count, spec.size, 1).numpy().astype("<f4").view(np.uint8)  # (N, C, 4)
        planes = np.ascontiguousarray(bytes_.transpose(1, 2, 0)).tobytes()
        packed.append(({"name": spec.name, "shape": list(spec.shape), "coding": "float32"}, planes, x))
    return packed


def _pack_quantized_for_webpage(model: Primitives, level: int) -> _PackedParameters:
    model = canonical_model(model)
    quantizers = fit_quantizers(model, bit_table(level, (), model.specs))
    order = storage_order(model, quantizers)
    packed: _PackedParameters = []
    for spec in model.specs:
        quantizer = quantizers[spec.name]
        codes = quantizer.codes(model.params[spec.name].reshape(model.count, spec.size)[order])
        part: dict[str, Any] = {"name": spec.name, "shape": list(spec.shape)}
        if isinstance(quantizer, RotationQuantizer):
            kind = ROTATIONS
            part |= {"coding": "rotations", "bits": quantizer.bits}
        else:
            kind = COLUMNS
            table = {key: getattr(quantizer, key).tolist() for key in ("bits", "low", "high")}
            part |= {"coding": "columns", **table}
        section = pack_section(spec.name, spec.shape, quantizer, codes.numpy(), kind)
        packed.append((part, b"".join(section.planes), quantizer.values(codes).reshape(model.count, *spec.shape)))
    return packed

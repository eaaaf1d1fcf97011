"""The page: a model, cameras and pictures of its scene, and the scripts that draw it, in one file of HTML."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, orbit
from neuprim.core.cameras.world import World
from neuprim.core.conditions import FRAMES
from neuprim.core.errors import ConfigError
from neuprim.core.model.edge import EDGES
from neuprim.core.model.fields import ConditionSpec, Field
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.near_plane import resolve_near
from neuprim.core.settings import RenderSettings
from neuprim.webpage.constants import shader_constants
from neuprim.webpage.numbers import pack_model

_SHARED = ("lib.js", "codec.js", "sort.js", "prepare.js", "shadow.js", "worker.js")
"""Scripts that the worker runs, too."""

_MAIN = ("painter.js", "frames.js", "camera.js", "conditions.js", "main.js", "probe.js")
_SHADERS = ("splat.vert", "splat.frag", "screen.vert", "resolve.frag")
_PLACE = re.compile(r"@(\w+)@")
_WIDE = 1e4  # a range that no slider has
_ENDLESS = 1e30
_PERIOD = 6.0  # seconds of a sweep that plays


@dataclass(frozen=True)
class Condition:
    """A condition of the task, and its values from where a viewer begins."""

    spec: ConditionSpec
    value: Tensor


@dataclass(frozen=True)
class PageView:
    """A camera to jump to.

    Attributes:
        name, camera, conditions: of the view.
        truth: address of a picture of it, ``data:image/…``; "" without one.
    """

    name: str
    camera: Camera
    conditions: Mapping[str, Tensor]
    truth: str = ""


@dataclass(frozen=True)
class WebPage:
    """A page.

    Attributes:
        text: of the file.
        model: what the page draws: the model in the numbers that it holds.
        numbers: bytes of these, gzipped.
        nonce: what its policy knows its own scripts by, for a page that embeds it and whose policy it falls under.
    """

    text: str
    model: Primitives
    numbers: int
    nonce: str


def web_page(
    name: str,
    model: Primitives,
    rgb: tuple[int, int, int],
    settings: RenderSettings,
    *,
    level: int = 0,
    subtitle: str = "",
    background: Sequence[float] = (0.0, 0.0, 0.0),
    linear: bool = False,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    conditions: Sequence[Condition] = (),
    views: Sequence[PageView] = (),
    still: str = "",
    world: World | None = None,
) -> WebPage:
    """A page of a model.

    Args:
        rgb: which of the model's channels are red, green and blue.
        settings: cuts and near plane are taken from here; one ray a pixel, whole primitives in the order of their
        centres. level: of :func:`~neuprim.webpage.numbers.pack_model`.
        background: (C,) in the model's colour space.
        linear: whether colours are linear light, and need the sRGB curve to be seen.
        views: the page begins with the first one.
        still: address of a picture to show where the page cannot draw.
        world: the coordinates of the user's files, which the page says; all its numbers are the model's own.

    Raises:
        ConfigError: a field without a script for browsers, or no such level.
        CheckpointError: numbers that cannot be stored.
    """
    scripts = {kind: _script(kind, field) for kind, field in (("density", model.density), ("colour", model.colour))}
    packed = pack_model(model, level)
    middle, radius, top = _extent(packed.model, fullest(packed.model, conditions))
    home = views[0].camera if views else _home(middle, radius, up)
    header = {
        "name": name,
        "count": model.count,
        "fields": {"density": model.density.settings(), "colour": model.colour.settings()},
        "numbers": packed.parts,
        "rgb": list(rgb),
        "background": [float(background[c]) for c in rgb],
        "linear": linear,
        "renderer": {key: getattr(settings, key) for key in ("alpha_min", "alpha_max")},
        "near": resolve_near(settings, packed.model.params["means"], [home]).near_plane,
        "constants": [shader_constants(edge) for edge in EDGES],
        "up": [float(x) for x in up],
        "center": middle,
        "radius": radius,
        "top": top,
        "conditions": [_condition(one, views) for one in conditions],
        "views": [_view(view) for view in views],
        "still": bool(still),
        **({} if world is None or world.identity else {"world": world.to_json()}),
        "home": camera_numbers(home),
    }
    assets = resources.files(__package__).joinpath("assets")
    texts = {
        path: assets.joinpath(path).read_text(encoding="utf-8")
        for path in ("page.html", "page.css", *_SHARED, *_MAIN, *_SHADERS)
    }
    fields = (
        "const fieldScripts = {\n"
        + "".join(f"{kind}: {script.rstrip().rstrip(';')},\n" for kind, script in scripts.items())
        + "};"
    )
    shaders = f"const shaders = {json.dumps({path: texts[path] for path in _SHADERS})};"
    parts = {
        "title": html.escape(name),
        "subtitle": html.escape(subtitle),
        "style": texts["page.css"],
        "still": html.escape(still),
        "page": json.dumps(header, allow_nan=False).replace("<", "\\u003c"),
        "numbers": base64.b64encode(packed.data).decode(),
        "shared": "\n".join([*(texts[path] for path in _SHARED), fields]),
        "main": "\n".join([shaders, *(texts[path] for path in _MAIN)]),
    }
    parts["nonce"] = hashlib.sha256("".join(parts.values()).encode()).hexdigest()[:32]  # no text inside can know it
    text = _PLACE.sub(lambda place: parts[place.group(1)], texts["page.html"])
    return WebPage(text, packed.model, len(packed.data), parts["nonce"])


def _script(kind: str, field: Field) -> str:
    """The field's expression for browsers, without its comment."""
    text = field.script()
    if text is None:
        raise ConfigError(f"{kind} field {type(field).__name__} has no script for browsers; a page cannot show it")
    if not isinstance(text, str) or "</script" in text.lower() or "<!--" in text:
        raise ConfigError(
            f"{kind} field {type(field).__name__}: script() must be a text of JavaScript without an end of its element"
        )
    return re.sub(r"^(//[^\n]*\n)+", "", text)


# ---------------------------------------------------------------- what the page knows of the scene


def fullest(model: Primitives, conditions: Sequence[Condition]) -> dict[str, Tensor]:
    """The conditions where a viewer begins; if no primitive is active there, those among them along one range where
    most are."""
    start = {one.spec.name: one.value for one in conditions}
    if model.active(start).geometry.count:
        return start
    ranges = [one.spec for one in conditions if one.spec.shape == () and one.spec.range[1] - one.spec.range[0] <= _WIDE]
    others = [
        start | {spec.name: start[spec.name].new_tensor(x)}
        for spec in ranges
        for x in torch.linspace(*spec.range, FRAMES).tolist()
    ]
    return max(others, key=lambda found: model.active(found).geometry.count, default=start)


@torch.no_grad()
def _extent(model: Primitives, conditions: Mapping[str, Tensor]) -> tuple[list[float], float, float]:
    """Middle and radius of what is drawn, and a density that few centres are above."""
    active = model.active(conditions)
    means, scales = (
        active.geometry.means.double(),
        active.geometry.scales.double().amax(1) if active.geometry.count else torch.zeros(0),
    )
    if not len(means):
        return [0.0, 0.0, 0.0], 1.0, 1.0
    low, high = (torch.quantile(means[:100_000], q, dim=0) for q in (0.01, 0.99))
    middle = (low + high) / 2
    radius = float(torch.quantile(((means - middle).norm(dim=1) + scales)[:100_000], 0.98))
    inside = torch.arange(len(means))
    sigma = active.sigma(inside, active.geometry.means).clamp_min(0).double()
    return middle.tolist(), radius or 1.0, float(torch.quantile(sigma[:100_000], 0.95)) or 1.0


def _home(middle: Sequence[float], radius: float, up: Sequence[float]) -> Camera:
    """A camera that sees all of a scene, from the side and a little above."""
    template = Camera(torch.eye(4, dtype=torch.float64), 717.0, 717.0, 256, 256, 512, 512)
    (found,) = orbit(template, torch.tensor(middle), torch.tensor(up), 3.2 * radius, 0.4, 1)
    return found


def camera_numbers(camera: Camera) -> dict[str, Any]:
    """A camera as the scripts take it: R and t of the world-to-camera matrix row by row, OpenCV axes, intrinsics and
    size in pixels."""
    view = camera.viewmat.detach().double().cpu()
    numbers = {
        key.name: float(getattr(camera, key.name)) for key in dataclasses.fields(camera) if key.name != "viewmat"
    }
    return {"R": view[:3, :3].flatten().tolist(), "t": view[:3, 3].tolist(), **numbers}


def _view(view: PageView) -> dict[str, Any]:
    conditions = {name: value.double().tolist() for name, value in view.conditions.items()}
    return {"name": view.name, "camera": camera_numbers(view.camera), "conditions": conditions, "truth": view.truth}


def _condition(one: Condition, views: Sequence[PageView]) -> dict[str, Any]:
    """What controls need of it. A range that no slider has is that of the views."""
    low, high = (min(max(float(end), -_ENDLESS), _ENDLESS) for end in one.spec.range)  # JSON knows no infinity
    value = one.value.double().tolist()
    if one.spec.shape == () and high - low > _WIDE:
        seen = [float(view.conditions[one.spec.name]) for view in views if one.spec.name in view.conditions]
        low, high = (
            (min(seen), max(seen))
            if seen and min(seen) < max(seen)
            else (float(one.value) - 1.0, float(one.value) + 1.0)
        )
    place = one.spec.shape == (3,) and one.spec.unit.startswith("position")
    return {"name": one.spec.name, "value": value, "range": [low, high], "place": place, "period": _PERIOD}

"""One renderer for every task: ``render(model, camera, conditions, settings) -> RenderOutput``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.projections import AnyCamera, RayCamera
from neuprim.core.compute import device
from neuprim.core.compute.threads import limit_threads
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.primitives import Lowered, Primitives
from neuprim.core.render.backends import Backend, available, choose, find
from neuprim.core.render.near import decided
from neuprim.core.render.output import RenderOutput, RenderStats, Tally
from neuprim.core.render.refusals import refuse_non_finite
from neuprim.core.render.samples import render_samples
from neuprim.core.render.shading import Draw, elsewhere, with_shade
from neuprim.core.settings import RenderSettings

__all__ = [
    "Backend",
    "RenderOutput",
    "RenderSettings",
    "RenderStats",
    "Tally",
    "available",
    "choose",
    "find",
    "probe",
    "render",
    "render_lowered",
]

_PROBE_ERROR = 1e-5  # float32 with fast functions errs by less than 1e-6 here


def render(
    model: Primitives,
    camera: AnyCamera,
    conditions: Mapping[str, Tensor] | None = None,
    settings: RenderSettings | None = None,
    background: Tensor | None = None,
) -> RenderOutput:
    """Draw one frame; differentiable in every parameter, in ``camera.viewmat`` and in ``background``.

    Tensors may be on the processor or on a card, all of a model on one of them; the image is where they are.

    Args:
        model: the primitives; each field lowers under ``conditions`` first.
        camera: the view; rgb is (camera.height, camera.width, C). A :class:`RayCamera` (any central projection) is
        drawn
            by the reference backend alone.
        conditions: e.g. ``{"time": tensor(0.5)}``.
        settings: every speed/accuracy knob; None: the defaults, with ``near="auto"``.
        background: (C,) colour behind everything; None is black.

    Raises:
        FormError: a field, the camera or the background has a tensor that does not fit (field, tensor, found and
        expected).
        NonFiniteError: a parameter is NaN or infinite (named, with the primitive).
        BackendUnavailable: the backend asked for cannot draw this model or this camera, or cannot run here.
        ConfigError: there is no backend of the name asked for.
    """
    settings = settings or RenderSettings(near="auto")
    with (
        limit_threads(settings.threads) if settings.threads else nullcontext()
    ):  # fields are lowered by as many threads as pixels
        lowered = model.lower(camera, conditions or {}, settings)
        lowered.check_frame(camera.viewmat, background)
        return _drawn(lowered, camera, settings, background)


def render_lowered(
    lowered: Lowered, camera: AnyCamera, settings: RenderSettings, background: Tensor | None = None
) -> RenderOutput:
    """Draw a model whose conditions are already folded in; refuses what does not fit or is not finite, see
    :func:`render`."""
    lowered.check(camera.viewmat, background)
    return _drawn(lowered, camera, settings, background)


def _drawn(lowered: Lowered, camera: AnyCamera, settings: RenderSettings, background: Tensor | None) -> RenderOutput:
    """Of what is checked."""
    settings = decided(settings, lowered.geometry.means, [camera])
    backend = choose(lowered, settings, camera)
    if not backend.checks:
        refuse_non_finite(lowered)
    draw = backend.load()
    if backend.place(settings) != lowered.kind:
        draw = elsewhere(draw, device.current_device(backend.place(settings)))
    if background is not None:
        background = background.to(lowered.geometry.means.device, non_blocking=background.is_cpu)
    paint: Draw = draw if lowered.shade is None else with_shade(draw)
    if settings.samples > 1:
        if isinstance(camera, RayCamera):
            raise ConfigError(
                f"renderer.samples={settings.samples}: only pinhole cameras are sampled; give a RayCamera more directions"
            )
        output = render_samples(paint, lowered, camera, background, settings)
    else:
        output = paint(lowered, camera, background, settings)
    output.stats.rows = lowered.rows
    return output


def probe(name: str) -> str | None:
    """None if backend ``name`` works here, else why not: draws one small sphere and looks at the middle pixel."""
    from neuprim.core.model.geometry import Geometry

    try:
        missing = find(name).lacking
        if missing is not None:
            return missing
        view = torch.eye(4, dtype=torch.float64)
        view[2, 3] = 3.0
        camera = Camera(view, 16.0, 16.0, 8.0, 8.0, 16, 16)
        geometry = Geometry(torch.zeros(1, 3), torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]))
        density = Cosine(torch.zeros(1, 1, 3), torch.zeros(1, 1), torch.zeros(1, 1), torch.ones(1))
        lowered = Lowered(geometry, density, Constant(torch.ones(1, 3)))
        middle = render_lowered(lowered, camera, RenderSettings(backend=name)).rgb[8, 8, 0].item()
    except Exception as error:  # a broken installation may fail in any way; the reason is what the user wants to read
        return f"{type(error).__name__}: {error}"
    aside = (camera.cx - 8.5) / camera.fx  # the pixel's centre is half a pixel from the sphere's, on both axes
    missed = 3.0 * math.sin(math.atan(math.hypot(aside, aside)))  # how far from the centre its ray passes
    expected = 1.0 - math.exp(-2.0 * math.sqrt(1.0 - missed**2))  # density 1 along the chord of a unit sphere
    return None if abs(middle - expected) < _PROBE_ERROR else f"drew {middle:.6f} where {expected:.6f} was expected"

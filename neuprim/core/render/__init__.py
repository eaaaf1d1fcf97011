"""Render a model of any task: ``render(model, camera, conditions, settings) -> RenderOutput``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.pinhole import AnyCamera, RayCamera
from neuprim.core.compute import device
from neuprim.core.compute.threads import limit_threads
from neuprim.core.errors import ConfigError, NonFiniteError
from neuprim.core.model.fields import Constant, Cosine, LoweredDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives, Primitives
from neuprim.core.render.backends import (
    Backend,
    available_backends,
    candidate_backends,
    choose_backend,
    find_backend,
)
from neuprim.core.render.near_plane import resolve_near
from neuprim.core.render.output import (
    Contributions,
    RenderOutput,
    RenderStats,
    draw_on_device,
    draw_pixel_samples,
    draw_shaded_view,
)
from neuprim.core.settings import RenderSettings

if TYPE_CHECKING:
    from neuprim.core.render.cuda.recorded_frames import FrameRecorder

__all__ = [
    "Backend",
    "Contributions",
    "RenderOutput",
    "RenderSettings",
    "RenderStats",
    "available_backends",
    "choose_backend",
    "find_backend",
    "probe_backend",
    "render",
    "render_lowered",
    "render_slabs",
]

_PROBE_ERROR = 1e-5  # float32 with fast functions errs by less than 1e-6 here


def render(
    model: Primitives,
    camera: AnyCamera,
    conditions: Mapping[str, Tensor] | None = None,
    settings: RenderSettings | None = None,
    background: Tensor | None = None,
) -> RenderOutput:
    """Render one view; differentiable in every parameter, in ``camera.viewmat`` and in ``background``.

    All tensors of a model are on one device, the CPU or a GPU. The image is on the same device.

    Args:
        camera: the camera; rgb is (camera.height, camera.width, C). Only "reference" renders a :class:`RayCamera`.
        conditions: one value for each condition of the model, e.g. ``{"time": tensor(0.5)}``.
        settings: render settings; None for the defaults with ``near="auto"``.
        background: (C,) colour behind all primitives; None means black.

    Raises:
        FormError: a tensor of a field, the camera or the background has a wrong shape, type or device.
        NonFiniteError: a parameter is NaN or infinite; the message names parameter and primitive.
        BackendUnavailable: the chosen backend cannot render this model or camera, or cannot run here.
        ConfigError: no backend has this name.
    """
    settings = settings or RenderSettings(near="auto")
    recorder = _frame_recorder(model, camera, settings)
    if recorder is not None and isinstance(camera, Camera):
        output = recorder.render(model, camera, conditions or {}, settings, background)
        if output is not None:
            return output
    # lowering uses as many threads as the pixels
    with limit_threads(settings.threads) if settings.threads else nullcontext():
        lowered = model.lower(camera, conditions or {}, settings)
        lowered.check_frame(camera.viewmat, background)
        output = _render_checked_view(lowered, camera, settings, background)
    if recorder is not None:
        recorder.observe(output)
    return output


def _frame_recorder(model: Primitives, camera: AnyCamera, settings: RenderSettings) -> FrameRecorder | None:
    """Return the recorder that records this model's frames as CUDA graphs; None if frames cannot be recorded."""
    if model.device.type != device.CUDA or torch.is_grad_enabled():
        return None
    if [backend.name for backend in candidate_backends(settings, device.CUDA)][:1] != ["cuda"]:
        return None
    from neuprim.core.render.cuda.recorded_frames import can_record_frame, frame_recorder

    return frame_recorder(model) if can_record_frame(model, camera, settings) else None


def render_lowered(
    lowered: LoweredPrimitives, camera: AnyCamera, settings: RenderSettings, background: Tensor | None = None
) -> RenderOutput:
    """Render primitives whose density and colour :meth:`Primitives.lower` evaluated for one frame.

    Raises the same errors as :func:`render`.
    """
    lowered.check(camera.viewmat, background)
    return _render_checked_view(lowered, camera, settings, background)


def _render_checked_view(
    lowered: LoweredPrimitives, camera: AnyCamera, settings: RenderSettings, background: Tensor | None
) -> RenderOutput:
    settings = resolve_near(settings, lowered.geometry.means, [camera])
    backend = choose_backend(lowered, settings, camera)
    if not backend.checks:
        lowered.check_finite()
    draw = backend.load()
    place = backend.drawing_device(settings)
    if place != lowered.kind:
        draw = draw_on_device(draw, device.current_device(place))
    if background is not None:
        background = background.to(lowered.geometry.means.device, non_blocking=background.is_cpu)
    if lowered.shade is not None:
        draw = draw_shaded_view(draw)
    if settings.samples == 1:
        output = draw(lowered, camera, background, settings)
    elif isinstance(camera, RayCamera):
        raise ConfigError(
            f"renderer.samples={settings.samples}: a RayCamera is not supersampled; expected 1. "
            "For more rays, give the RayCamera more directions"
        )
    else:
        output = draw_pixel_samples(draw, lowered, camera, background, settings)
    output.stats.rows = lowered.rows
    return output


def probe_backend(name: str) -> str | None:
    """Render one sphere with the backend ``name``; return None if the image is correct, else what went wrong."""
    from neuprim.core.model.geometry import Geometry

    try:
        reason = find_backend(name).unavailable()
        if reason is not None:
            return reason
        view = torch.eye(4, dtype=torch.float64)
        view[2, 3] = 3.0
        camera = Camera(view, 16.0, 16.0, 8.0, 8.0, 16, 16)
        geometry = Geometry(torch.zeros(1, 3), torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]))
        density = Cosine(torch.zeros(1, 1, 3), torch.zeros(1, 1), torch.zeros(1, 1), torch.ones(1))
        lowered = LoweredPrimitives(geometry, density, Constant(torch.ones(1, 3)))
        middle = render_lowered(lowered, camera, RenderSettings(backend=name)).rgb[8, 8, 0].item()
    except Exception as error:  # a broken installation may fail in any way; the reason is what the user wants to read
        return f"{type(error).__name__}: {error}"
    aside = (camera.cx - 8.5) / camera.fx  # the pixel's centre is half a pixel from the sphere's, on both axes
    missed = 3.0 * math.sin(math.atan(math.hypot(aside, aside)))  # distance of its ray from the sphere's centre
    expected = 1.0 - math.exp(-2.0 * math.sqrt(1.0 - missed**2))  # density 1 along the chord of a unit sphere
    return None if abs(middle - expected) < _PROBE_ERROR else f"drew {middle:.6f} where {expected:.6f} was expected"


def render_slabs(
    geometry: Geometry, density: LoweredDensity, slabs: Tensor, count: int, camera: Camera, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Render each slab (a group of primitives) alone; return (S, H, W) opacities and mean depths, without gradients.

    S is at most ``count``, because a backend may leave out the images of slabs without primitives, which are 0. The
    images stay in the order of the slabs.

    Args:
        slabs: (N,) index of the slab of each primitive, 0 to ``count`` - 1, on the primitives' device.
        settings: render settings; ``depth`` must be on.
    """
    with torch.no_grad():
        black = Constant(torch.zeros(geometry.count, 1, device=geometry.means.device))
        lowered = LoweredPrimitives(geometry, density, black)
        lowered.check(camera.viewmat, None)
        backend = choose_backend(lowered, settings, camera)
        plain = settings.sort == "center" and settings.samples == 1 and backend.drawing_device(settings) == lowered.kind
        draw_together = backend.slabs() if plain else None
        if draw_together is not None:
            return draw_together(lowered, slabs, count, camera, settings)
        order = torch.argsort(slabs, stable=True)
        geometry, density, images = geometry[order], density.primitive_rows(order), []
        ends = torch.bincount(slabs, minlength=count).cumsum(0).tolist()
        for first, end in zip([0, *ends], ends, strict=False):
            if first == end:
                continue
            slab = slice(first, end)
            alone = LoweredPrimitives(geometry[slab], density.primitive_rows(slab), Constant(black.rgb[slab]))
            try:
                output = render_lowered(alone, camera, settings)
            except NonFiniteError:
                lowered.check_finite()
                raise
            assert output.depth is not None
            images.append((output.alpha, output.depth))
        opacities, depths = (torch.stack(found) for found in zip(*images, strict=True))
        return opacities, depths

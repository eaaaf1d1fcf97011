"""Shared code of the cpu and cuda backends: call a backend's :class:`torch.autograd.Function` and pass gradients on.

``forward`` of a backend's function takes ``(ctx, request, viewmat, background, palette, *tensors)``. ``palette`` holds
the (N, C) colours. ``tensors`` are the tensors that :data:`PARAMETERS` names and, for colour networks, the tensors that
``NET`` names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.threads import apply_kernel_operation, kernel_needs_grad
from neuprim.core.model.fields import Constant, Cosine, RayNet
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render.output import RenderOutput, RenderStats, mean_depth
from neuprim.core.settings import RenderSettings

PARAMETERS = ("means", "log_scales", "quats", "W1", "b1", "w2", "b2")
"""Names of the tensors of geometry and density, in the order in which the kernels take them."""

NET = ("Wx", "bias", "Wout")


@dataclass(frozen=True)
class RasterRequest:
    """All inputs of one frame for the cpu or cuda backend that are not tensors."""

    camera: Camera
    turns: float  # omega0 / 2 pi of the density; converts frequencies and phases to turns
    edge: int  # exponent p of the density's edge, see neuprim.core.model.edge
    settings: RenderSettings
    stats: RenderStats
    differentiable: bool = False  # whether a backward pass may follow
    capacity: Any = None  # fixed sizes of the frame's arrays; None: the backend counts what the arrays must hold

    @classmethod
    def of(
        cls, lowered: LoweredPrimitives, camera: Camera, settings: RenderSettings, stats: RenderStats, *rest: Any
    ) -> RasterRequest:
        density = lowered.density
        assert isinstance(density, Cosine), "the caller chooses a backend that knows the forms"
        return cls(camera, density.omega0 / (2 * math.pi), density.edge, settings, stats, *rest)


def rasterizer_tensors(lowered: LoweredPrimitives) -> tuple[Tensor, ...]:
    """Return the tensors of geometry and density that :data:`PARAMETERS` names, in that order."""
    g, density = lowered.geometry, lowered.density
    assert isinstance(density, Cosine), "the caller chooses a backend that knows the forms"
    return g.means, g.log_scales, g.quats, density.W1, density.b1, density.w2, density.b2.reshape(-1)


def rasterize(
    operation: type[torch.autograd.Function],
    name: str,
    lowered: LoweredPrimitives,
    camera: Camera,
    background: Tensor | None,
    settings: RenderSettings,
    capacity: Any = None,
) -> RenderOutput:
    """Render a model with a backend's autograd function ``operation``; return the image, alpha and optional depth.

    The density must be :class:`Cosine`, the colour :class:`Constant` or :class:`RayNet`. ``name`` is the backend's
    name.
    """
    colour = lowered.colour
    net: tuple[Tensor, ...] = ()
    assert isinstance(colour, Constant | RayNet), "the caller chooses a backend that knows the forms"
    if isinstance(colour, RayNet):
        palette, net = colour.base, (colour.Wx, colour.bias, colour.Wout)
    else:
        palette = colour.rgb
    if background is None:
        background = torch.zeros(palette.shape[1], device=palette.device)
    tensors = (camera.viewmat, background, palette, *rasterizer_tensors(lowered), *net)
    stats = RenderStats(name, lowered.geometry.count)
    request = RasterRequest.of(lowered, camera, settings, stats, kernel_needs_grad(*tensors), capacity)
    rgb, transmittance, zsum = apply_kernel_operation(operation, request, *tensors)
    dtype = lowered.geometry.means.dtype
    alpha = 1 - transmittance
    depth = mean_depth(zsum, alpha).to(dtype) if settings.depth else None
    return RenderOutput(rgb.to(dtype), alpha.to(dtype), depth, stats)


def remember_rasterizer_inputs(ctx: Any, inputs: Sequence[Tensor]) -> None:
    """Save the device and dtype of each input in ``ctx``, for :func:`rasterizer_input_gradients`.

    Also make autograd pass None instead of zeros to ``backward`` for each output that has no gradient.
    """
    ctx.inputs_like = [(x.device, x.dtype) for x in inputs]
    ctx.set_materialize_grads(False)  # without a gradient, the depth image adds no cost


def rasterizer_input_gradients(ctx: Any, view: Tensor | None, gradients: Sequence[Tensor | None]) -> tuple[Any, ...]:
    """Return the tuple that ``backward`` must return: None for the request, then one gradient per input tensor.

    Each gradient gets the dtype and device of its input. ``view`` is the (3, 4) gradient of the camera's rotation and
    translation (R | t). ``gradients`` has one gradient for each input after ``viewmat``.
    """
    full = None
    if view is not None:
        full = torch.zeros(4, 4, dtype=torch.float64, device=view.device)
        full[:3] = view
    found = (full, *gradients)
    return (None, *(None if g is None else g.to(*like) for g, like in zip(found, ctx.inputs_like, strict=True)))

"""The CUDA backend as one differentiable operation: lowered tensors in, image out, all on the tensors' device and the
caller's stream."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.fields import Constant, Cosine, RayNet
from neuprim.core.model.primitives import Lowered
from neuprim.core.render.cpu.seen import depth_that_counts
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.forms import Form
from neuprim.core.render.cuda.frame import NAMES, NotFinite, prepared
from neuprim.core.render.cuda.net import Net, net_backward, prepared_net, wide_net
from neuprim.core.render.cuda.passes import Composited, backward, forward
from neuprim.core.render.cuda.prepare_backward import prepare_backward
from neuprim.core.render.cuda.ray_colours import FIRST_COLOUR
from neuprim.core.render.output import RenderOutput, RenderStats, mean_depth
from neuprim.core.settings import RenderSettings

__all__ = ["render", "render_parts"]


_NET = ("Wx", "bias", "Wout")


def _refuse(tensors: dict[str, Tensor]) -> None:
    """Raise for the first number of a colour network that is not finite; the host waits for the device."""
    sums = torch.stack([t.sum(dtype=torch.float64) for t in tensors.values()])
    if not bool(torch.isfinite(sums).all()):
        for name, value in tensors.items():
            bad = ~torch.isfinite(value).reshape(len(value), -1).all(dim=1)
            if bool(bad.any()):
                row = int(bad.nonzero()[0])
                raise NonFiniteError(f"{name} of primitive {row} is not finite: {value[row].flatten()[:8].tolist()}")


def _blame(tensors: dict[str, Tensor], row: int) -> NonFiniteError:
    for name, value in tensors.items():
        if not bool(torch.isfinite(value[row]).all()):
            return NonFiniteError(f"{name} of primitive {row} is not finite: {value[row].flatten()[:8].tolist()}")
    if not bool(tensors["quats"][row].any()):
        return NonFiniteError(f"quats of primitive {row} is zero; expected a non-zero quaternion")
    scale = tensors["log_scales"][row].tolist()
    return NonFiniteError(
        f"log_scales of primitive {row} is {scale}: the semi-axes or weights leave the range of float32"
    )


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, means: Tensor, log_scales: Tensor, quats: Tensor, W1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor,
        colors: Tensor, viewmat: Tensor, background: Tensor, camera: Camera, omega0: float, edge: int, settings: RenderSettings,
        stats: RenderStats, differentiable: bool, *network: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        tensors = dict(zip(NAMES, (means, log_scales, quats, W1, b1, w2, b2), strict=True))
        form = Form(W1.shape[1], edge, colors.shape[1], network[0].shape[1] if network else -1)
        net: Net | None = None
        if network:
            _refuse(dict(zip(_NET, network, strict=True)))
            net = prepared_net(log_scales, quats, *network)
        try:
            frame = prepared(
                tensors,
                colors,
                camera,
                viewmat,
                settings.near_plane,
                omega0 / (2 * math.pi),
                edge,
                depth_that_counts(settings.alpha_min),
                net.fast if net is not None and net.hidden else None,
            )
        except NotFinite as error:
            raise _blame(tensors | {"base" if network else "colors": colors}, error.row) from None
        if net is not None and net.hidden and len(frame.which):
            wide_net(net, frame.which, frame.parameters[1], frame.parameters[2])
        stats.pairs, stats.extra["float64"] = frame.lists.pairs, frame.wide.shape[0]
        behind = background.detach().to(means.device, torch.float32).contiguous()
        drawn = forward(frame, form, net, behind, settings, differentiable)
        h, w = camera.height, camera.width
        stats.extra["hits"] = drawn.hits.shape[0]
        ctx.frame, ctx.form, ctx.net, ctx.drawn, ctx.settings, ctx.stats, ctx.background = (
            frame,
            form,
            net,
            drawn,
            settings,
            stats,
            behind,
        )
        ctx.net_dtypes = [x.dtype for x in network]
        ctx.dtypes = [x.dtype for x in (means, log_scales, quats, W1, b1, w2, b2, colors)]
        ctx.view_dtype, ctx.view_device, ctx.background_dtype, ctx.background_device = (
            viewmat.dtype, viewmat.device, background.dtype, background.device,
        )  # fmt: skip
        ctx.set_materialize_grads(False)
        z = drawn.zsum.view(h, w) if settings.depth else drawn.zsum
        return drawn.rgb.view(h, w, form.channels), drawn.transmittance.view(h, w), z

    @staticmethod
    def backward(ctx: Any, g_rgb: Tensor | None, g_T: Tensor | None, g_z: Tensor | None) -> tuple[Any, ...]:  # type: ignore[override]
        frame, form, settings, stats = ctx.frame, ctx.form, ctx.settings, ctx.stats
        drawn: Composited | None = ctx.drawn
        if drawn is None:
            raise RuntimeError(
                "the cuda backend's backward pass uses up what the forward pass kept: it runs once per frame"
            )
        ctx.drawn = None
        device, pixels = frame.device, drawn.transmittance.shape[0]
        rgb = (
            torch.zeros(pixels, form.channels, device=device)
            if g_rgb is None
            else g_rgb.reshape(pixels, -1).float().contiguous()
        )
        T = rgb @ ctx.background
        if g_T is not None:
            T = T + g_T.reshape(-1).float()
        z = g_z.reshape(-1).float().contiguous() if settings.depth and g_z is not None else None
        watched = stats.watched
        error = (
            torch.zeros(pixels, device=device)
            if watched is None
            else watched.error.to(device, torch.float32).reshape(-1).contiguous()
        )
        net: Net | None = ctx.net
        grads, net_grads = backward(frame, form, net, drawn, settings, rgb, T.contiguous(), z, error)
        base = L.G_NEURONS + L.PER_NEURON * form.neurons
        colours = grads[:, base : base + form.channels]
        if net_grads is not None:
            grads[:, : L.G_OFFSET] += net_grads[:, : L.G_OFFSET]
            colours = net_grads[:, FIRST_COLOUR : FIRST_COLOUR + form.channels]
        want_view = bool(ctx.needs_input_grad[8])
        own, g_view = prepare_backward(frame, grads, want_view)
        if watched is not None:
            watched.fill(grads[:, L.G_WEIGHT].clone(), grads[:, L.G_ERROR].clone())
        g_net: tuple[Tensor, ...] = ()
        if net is not None and net_grads is not None:
            logs, quats = frame.parameters[1], frame.parameters[2]
            g_net = net_backward(net, logs, quats, grads, net_grads, FIRST_COLOUR + form.channels, own[1], own[2])
        results = [*own, colours.clone()]
        tensors = [r.to(d) for r, d in zip(results, ctx.dtypes, strict=True)]
        view = None
        if g_view is not None:
            full = torch.zeros(4, 4, dtype=torch.float64, device=device)
            full[:3] = g_view
            view = full.to(ctx.view_device, ctx.view_dtype)
        behind = None
        if ctx.needs_input_grad[9]:
            behind = (rgb * drawn.transmittance[:, None]).sum(0).to(ctx.background_device, ctx.background_dtype)
        nets = (g.to(dtype) for g, dtype in zip(g_net, ctx.net_dtypes, strict=True))
        return (*tensors, view, behind, None, None, None, None, None, None, *nets)


def render(lowered: Lowered, camera: Camera, background: Tensor | None, settings: RenderSettings) -> RenderOutput:
    """Render a :class:`Cosine` density with :class:`Constant` or :class:`RayNet` colours; see
    ``neuprim.core.render.render``."""
    density, colour = lowered.density, lowered.colour
    assert isinstance(density, Cosine) and isinstance(colour, Constant | RayNet), (
        "the caller chooses a backend that knows the forms"
    )
    g = lowered.geometry
    stats = RenderStats("cuda", g.count)
    palette, net = (
        (colour.base, (colour.Wx, colour.bias, colour.Wout)) if isinstance(colour, RayNet) else (colour.rgb, ())
    )
    if background is None:
        background = torch.zeros(palette.shape[1], device=g.means.device)
    tensors = (
        g.means, g.log_scales, g.quats, density.W1, density.b1, density.w2, density.b2.reshape(-1), palette, camera.viewmat, background,
    )  # fmt: skip
    differentiable = torch.is_grad_enabled() and any(x.requires_grad for x in (*tensors, *net))
    rgb, T, zsum = _Rasterize.apply(
        *tensors, camera, density.omega0, density.edge, settings, stats, differentiable, *net
    )
    dtype = g.means.dtype
    alpha = 1 - T
    depth = mean_depth(zsum, alpha).to(dtype) if settings.depth else None
    return RenderOutput(rgb.to(dtype), alpha.to(dtype), depth, stats)


def render_parts(
    lowered: Lowered, parts: Tensor, count: int, camera: Camera, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Opacity and depth of parts of the primitives, each as if it were alone, in one frame; see
    :func:`neuprim.core.render.parts.render_parts`."""
    g, density = lowered.geometry, lowered.density
    assert isinstance(density, Cosine), "the caller chooses a backend that knows the forms"
    tensors = dict(
        zip(
            NAMES,
            (g.means, g.log_scales, g.quats, density.W1, density.b1, density.w2, density.b2.reshape(-1)),
            strict=True,
        )
    )
    tensors = {name: value.detach() for name, value in tensors.items()}
    blank = torch.zeros(g.count, 1, device=g.means.device)
    form, turns = Form(density.W1.shape[1], density.edge, 1, -1), density.omega0 / (2 * math.pi)
    own = replace(settings, depth=True)
    try:
        images = (parts.int().contiguous(), count)
        frame = prepared(
            tensors,
            blank,
            camera,
            camera.viewmat,
            own.near_plane,
            turns,
            density.edge,
            depth_that_counts(own.alpha_min),
            None,
            images,
        )
    except NotFinite as error:
        raise _blame(tensors, error.row) from None
    drawn = forward(frame, form, None, blank.new_zeros(1), own, False, count)
    alpha = (1 - drawn.transmittance).view(count, camera.height, camera.width).to(g.means.dtype)
    return alpha, mean_depth(drawn.zsum.view(alpha.shape), alpha).to(alpha.dtype)

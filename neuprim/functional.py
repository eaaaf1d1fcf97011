"""The renderer as one function for your own training loop: tensors in, images out, batched over cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, check_viewmat
from neuprim.core.errors import BackendUnavailable, ConfigError, DataError, NonFiniteError, nearest
from neuprim.core.model.cosine import apply_density_gain
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.model.tensors import Sizes, primitive_tensor_fault
from neuprim.core.render import Contributions, RenderSettings, RenderStats, backends, render_lowered

__all__ = ["Rasterized", "rasterize"]

_REQUIRED = ("means", "log_scales", "quats", "W1", "b1", "w2", "b2", "colors")


@dataclass(frozen=True)
class Rasterized:
    """Result of :func:`rasterize`: images of one model from C cameras.

    Attributes:
        rgb: (C, H, W, channels) colours, composited over the backgrounds.
        alpha: (C, H, W) accumulated opacity: 1 minus the transmittance behind all primitives.
        depth: (C, H, W) mean depth (camera z, scene units), weighted like the colours. The depth of a primitive is
            the depth of the middle of the ray's segment inside the primitive. 0 where a ray hits no primitive. None
            unless ``depth=True``.
        stats: statistics of each camera's image, see :class:`~neuprim.core.render.output.RenderStats`.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    stats: tuple[RenderStats, ...]

    def request_contributions(self, error: Tensor) -> tuple[Contributions, ...]:
        """Return, for each camera, how much every primitive contributes to the image and to an error of the image.

        Call this method before ``backward()``. The result is 0 until ``backward()`` fills it.

        Args:
            error: (C, H, W) error of each pixel, in any measure; receives no gradient.
        """
        _check_tensor("request_contributions: error", error)
        if error.shape != self.alpha.shape:
            expected = f"{tuple(self.alpha.shape)}, that of alpha"
            raise _wrong("request_contributions: error", f"shape {tuple(error.shape)}", expected)
        return tuple(stats.request_contributions(part) for stats, part in zip(self.stats, error, strict=True))


def rasterize(
    primitives: Mapping[str, Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    size: tuple[int, int],
    *,
    omega0: float = 30.0,
    edge: int = 0,
    backgrounds: Tensor | None = None,
    **settings: Any,
) -> Rasterized:
    """Render N primitives from C pinhole cameras; differentiable.

    A primitive is an ellipsoid with centre mu (``means``), rotation R (``quats``) and semi-axes
    ``s = exp(log_scales)``. Its density at a point x inside (1 / scene unit) is

        sigma(x) = g (1 - |y|^2)^p f((x - mu) / m) / m,   m = max(s),   y = diag(1 / s) R^T (x - mu),
        g = exp(log_gain),   f(u) = sum_k w2_k cos(omega0 (W1_k . u + b1_k)) + b2

    and 0 outside. The exponent p is ``edge``; W1, b1, w2, b2 and log_gain are tensors of ``primitives``. I_i is the
    integral, in closed form, of the density of primitive i along a pixel's ray. Primitives are sorted front to back:

        alpha_i = min(alpha_max, 1 - exp(-max(I_i, 0))),   T_i = prod_{j<i} (1 - alpha_j),
        rgb = sum_i colors_i alpha_i T_i + T background.

    T is the product of all 1 - alpha_j, and alpha_max is a render setting.

    Gradients reach every primitive tensor, ``viewmats`` (all twelve entries) and ``backgrounds`` on every backend.
    Gradients reach ``Ks`` only with ``backend="reference"``.

    Args:
        primitives: name -> tensor. All tensors and the images have the same device and dtype, float32 or float64:
            ``means`` (N, 3) centres, ``log_scales`` (N, 3) natural logarithms of the semi-axes, scene units;
            ``quats`` (N, 4) wxyz, any non-zero norm; ``W1`` (N, K, 3) frequencies, ``b1`` (N, K) phases, both without
            the factor omega0, ``w2`` (N, K) amplitudes, ``b2`` (N, 1) or (N,) offsets, K is 0 to 256; ``colors``
            (N, channels), or (C, N, channels) for colours that depend on the camera; and optionally ``log_gain``
            (N, 1) or (N,), clamped to +-20; clamped values get no gradient.
        viewmats: (C, 4, 4) world-to-camera, OpenCV axes (x right, y down, z forward). float64 is most accurate.
        Ks: (C, 3, 3) intrinsics in pixels, ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``; pixel centres lie at +0.5.
        size: (width, height) of every image in pixels.
        omega0: factor on the phase W1_k . u + b1_k of every cosine.
        edge: exponent p; 0 is the paper's hard edge, 1 and 2 are soft (:mod:`neuprim.core.model.edge`).
        backgrounds: (channels,) or (C, channels); None is black.
        **settings: fields of :class:`neuprim.core.settings.RenderSettings`: ``backend``, ``near``, ``depth``, ...

    Raises:
        DataError: a tensor has a wrong type, dtype, device or shape; a camera is not finite or not rigid, or has skew.
            The message names the argument, what was found and what was expected.
        ConfigError: a setting is unknown, or its value is impossible.
        NonFiniteError: a primitive tensor or background holds NaN or infinity, or a quaternion is zero.
        BackendUnavailable: ``Ks`` requires a gradient, but ``backend`` allows a backend without this gradient.
    """
    render_settings = _render_settings(settings)
    geometry, density, palettes = _check_primitives(primitives, len(viewmats), omega0, edge)
    cameras, channels = _check_cameras(viewmats, Ks, size), primitives["colors"].shape[-1]
    backdrop = _check_backgrounds(backgrounds, len(cameras), channels)
    candidates = backends.candidate_backends(render_settings, geometry.means.device.type)
    if Ks.requires_grad and not all(backend.differentiates_intrinsics for backend in candidates):
        able = " or ".join(f'backend="{b.name}"' for b in backends.available_backends() if b.differentiates_intrinsics)
        raise BackendUnavailable(
            f'rasterize: Ks requires a gradient, which backend="{render_settings.backend}" does not compute; '
            f"pass {able} or Ks.detach()"
        )
    frames = [
        render_lowered(LoweredPrimitives(geometry, density, Constant(palette)), camera, render_settings, behind)
        for palette, camera, behind in zip(palettes, cameras, backdrop, strict=True)
    ]
    if not frames:
        # tied to the inputs, so that a loss over no cameras still has a (zero) gradient
        tied = sum((v.sum() * 0 for v in primitives.values()), geometry.means.new_zeros(()))
        empty = tied.expand(0, size[1], size[0])
        return Rasterized(tied.expand(*empty.shape, channels), empty, empty if render_settings.depth else None, ())
    depths = [f.depth for f in frames if f.depth is not None]
    return Rasterized(
        torch.stack([f.rgb for f in frames]),
        torch.stack([f.alpha for f in frames]),
        torch.stack(depths) if depths else None,
        tuple(f.stats for f in frames),
    )


def _wrong(name: str, found: str, expected: str) -> DataError:
    return DataError(f"rasterize: {name} has {found}; expected {expected}")


def _render_settings(settings: dict[str, Any]) -> RenderSettings:
    names = [f.name for f in fields(RenderSettings)]
    for name in settings:
        if name not in names:
            raise ConfigError(f"rasterize: unknown setting {name!r}{nearest(name, names)}")
    made = RenderSettings(**settings)
    backends.check_backend_name(made.backend)
    return made


def _check_tensor(name: str, value: Any) -> None:
    fault = primitive_tensor_fault(value)
    if fault is not None:
        raise DataError(f"rasterize: {name} has {fault}")


def _check_primitives(
    t: Mapping[str, Tensor], views: int, omega0: float, edge: int
) -> tuple[Geometry, Cosine, list[Tensor]]:
    """Check names, types and shapes of the tensors ``t``, the argument ``primitives`` of :func:`rasterize`.

    Only ``log_gain`` is also checked for NaN and infinity. Return the ellipsoids, the density field with the gain
    applied, and a tensor (N, channels) of colours for each of ``views`` cameras.
    """
    for name in t:
        if name not in (*_REQUIRED, "log_gain"):
            raise DataError(f"rasterize: unknown tensor {name!r}{nearest(name, [*_REQUIRED, 'log_gain'])}")
    for name in _REQUIRED:
        if name not in t:
            raise DataError(f"rasterize: {name} is missing; expected the tensors {', '.join(_REQUIRED)}")
    for name, value in t.items():
        _check_tensor(name, value)
        if value.dtype != t["means"].dtype:
            raise _wrong(name, f"dtype {value.dtype}", f"{t['means'].dtype}, the dtype of means")
        if value.device != t["means"].device:
            raise _wrong(name, f"device {value.device}", f"{t['means'].device}, the device of means")
    sizes: Sizes = {}
    geometry = Geometry(t["means"], t["log_scales"], t["quats"])
    for form in (geometry, Cosine(t["W1"], t["b1"], t["w2"], t["b2"], omega0, edge)):
        if (fault := form.fault(sizes)) is not None:
            raise DataError(f"rasterize: {fault}")
    n, colors, gain = sizes["N"][0], t["colors"], t.get("log_gain")
    if gain is not None and tuple(gain.shape) not in ((n, 1), (n,)):
        raise _wrong("log_gain", f"shape {tuple(gain.shape)}", f"({n}, 1) or ({n},), as means has N={n}")
    if gain is not None and not bool((finite := torch.isfinite(gain.detach()).reshape(-1)).all()):
        raise NonFiniteError(f"rasterize: log_gain of primitive {int((~finite).nonzero()[0])} is not finite")
    if colors.dim() not in (2, 3) or colors.shape[-2] != n or colors.shape[-1] < 1:
        expected = f"(N, channels) or (C, N, channels) with N={n} as in means and channels >= 1"
        raise _wrong("colors", f"shape {tuple(colors.shape)}", expected)
    if colors.dim() == 3 and len(colors) != views:
        expected = f"({views}, {n}, channels), one set per camera of viewmats"
        raise _wrong("colors", f"shape {tuple(colors.shape)}", expected)
    w2, b2 = apply_density_gain(t["w2"], t["b2"], gain)
    palettes = list(colors.unbind()) if colors.dim() == 3 else [colors] * views
    return geometry, Cosine(t["W1"], t["b1"], w2, b2, float(omega0), edge), palettes


def _check_cameras(viewmats: Tensor, Ks: Tensor, size: tuple[int, int]) -> list[Camera]:
    """Check the cameras of :func:`rasterize`; return one camera for each matrix of ``viewmats``.

    The intrinsics of a camera are numbers, or tensors if they require a gradient.
    """
    if len(size) != 2 or any(isinstance(side, bool) or not isinstance(side, int) or side < 1 for side in size):
        raise _wrong("size", f"value {size!r}", "two positive ints, width and height")
    _check_tensor("viewmats", viewmats)
    _check_tensor("Ks", Ks)
    if viewmats.dim() != 3 or viewmats.shape[1:] != (4, 4):
        raise _wrong("viewmats", f"shape {tuple(viewmats.shape)}", "(C, 4, 4)")
    if tuple(Ks.shape) != (len(viewmats), 3, 3):
        raise _wrong("Ks", f"shape {tuple(Ks.shape)}", f"({len(viewmats)}, 3, 3), as viewmats has C={len(viewmats)}")
    cameras = []
    for c, (view, K) in enumerate(zip(viewmats, Ks, strict=True)):
        check_viewmat(view, f"rasterize: viewmats[{c}]")
        last = view[3].tolist()
        if any(abs(found - wanted) > 1e-6 for found, wanted in zip(last, (0.0, 0.0, 0.0, 1.0), strict=True)):
            raise _wrong(f"viewmats[{c}]", f"last row {last}", "[0, 0, 0, 1] (world-to-camera, not transposed)")
        k = K.detach().double()
        if not bool(torch.isfinite(k).all()):
            raise _wrong(f"Ks[{c}]", f"entries {k.tolist()}", "finite numbers")
        (fx, skew, cx), (low, fy, cy), bottom = k.tolist()
        if bottom != [0.0, 0.0, 1.0]:
            raise _wrong(f"Ks[{c}]", f"last row {bottom}", "[0, 0, 1]")
        if skew != 0.0 or low != 0.0:
            raise _wrong(f"Ks[{c}]", f"skew K[0,1]={skew}, K[1,0]={low}", "0: skewed pixels are not supported")
        if fx <= 0.0 or fy <= 0.0:
            raise _wrong(f"Ks[{c}]", f"focal lengths fx={fx}, fy={fy}", "positive pixels")
        lens: tuple[Any, Any, Any, Any] = (fx, fy, cx, cy)
        if K.requires_grad:
            K64 = K.double()
            lens = (K64[0, 0], K64[1, 1], K64[0, 2], K64[1, 2])
        cameras.append(Camera(view, *lens, *size))
    return cameras


def _check_backgrounds(backgrounds: Tensor | None, views: int, channels: int) -> Sequence[Tensor | None]:
    """Check the backgrounds of :func:`rasterize`; return one (channels,) tensor, or None for black, per camera."""
    if backgrounds is None:
        return [None] * views
    _check_tensor("backgrounds", backgrounds)
    if tuple(backgrounds.shape) not in ((channels,), (views, channels)):
        raise _wrong("backgrounds", f"shape {tuple(backgrounds.shape)}", f"({channels},) or ({views}, {channels})")
    if not bool(torch.isfinite(backgrounds.detach()).all()):
        raise NonFiniteError(f"rasterize: backgrounds is not finite: {backgrounds.detach().flatten()[:8].tolist()}")
    return backgrounds.expand(views, channels).unbind()

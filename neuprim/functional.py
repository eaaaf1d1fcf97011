"""The functional front door: tensors in, images out, batched over cameras, for people with a trainer of their own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, check_viewmat
from neuprim.core.errors import BackendUnavailable, ConfigError, DataError, NonFiniteError, nearest
from neuprim.core.model.densities.cosine import amplified
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered
from neuprim.core.model.tensors import Sizes, tensor_fault
from neuprim.core.render import Contributions, RenderSettings, RenderStats, backends, render_lowered

__all__ = ["Rasterized", "rasterize"]


@dataclass(frozen=True)
class Rasterized:
    """C frames of one model.

    Attributes:
        rgb: (C, H, W, channels) composited over the backgrounds.
        alpha: (C, H, W) accumulated opacity 1 - T.
        depth: (C, H, W) weighted mean camera-z of the chord middles, scene units, 0 where nothing is hit; None unless
            ``depth=True`` was asked for.
        stats: one per camera, see :class:`neuprim.core.render.output.RenderStats`.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    stats: tuple[RenderStats, ...]

    def request_contributions(self, error: Tensor) -> tuple[Contributions, ...]:
        """Let the backward pass tell which primitives each camera saw, and which had a part in an error; call it before
        ``backward()``.

        Args:
            error: (C, H, W) any measure of what is wrong at each pixel; no gradient reaches it.

        Returns:
            for each camera the (N,) sums ``weight`` and ``error_weight``, which the backward pass fills: see
            :class:`neuprim.core.render.Contributions`.

        Raises:
            DataError: ``error`` is not of the frames' size.
        """
        _check_tensor("request_contributions: error", error)
        if error.shape != self.alpha.shape:
            raise _wrong(
                "request_contributions: error",
                f"shape {tuple(error.shape)}",
                f"{tuple(self.alpha.shape)}, that of alpha",
            )
        return tuple(stats.request_contributions(part) for stats, part in zip(self.stats, error, strict=True))


def rasterize(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    W1: Tensor,
    b1: Tensor,
    w2: Tensor,
    b2: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    omega0: float = 30.0,
    edge: int = 0,
    log_gain: Tensor | None = None,
    backgrounds: Tensor | None = None,
    **settings: Any,
) -> Rasterized:
    """Draw N primitives from C pinhole cameras, differentiably.

    Inside its ellipsoid, of semi-axes ``s = exp(log_scales)``, a primitive has the density (1 / scene unit)

        sigma(x) = g (1 - |y|^2)^p f((x - mu) / m) / m,   m = max(s),   y = diag(1 / s) R^T (x - mu),   g =
        exp(log_gain), f(u) = sum_k w2_k cos(omega0 (W1_k . u + b1_k)) + b2

    and outside none. With I the integral of sigma along a pixel's ray, in closed form, and primitives sorted front to
    back,

        alpha_i = min(alpha_max, 1 - exp(-max(I_i, 0))),   T_i = prod_{j<i} (1 - alpha_j),
        rgb = sum_i colors_i alpha_i T_i + T background.

    Gradients reach every primitive tensor, ``viewmats`` (poses) and ``backgrounds`` on every backend, and ``Ks`` with
    ``backend="reference"``. A pose is best optimised through a parametrisation of rigid transforms: the gradient is
    that of all twelve matrix entries.

    Args:
        means: (N, 3) centres, scene units.
        log_scales: (N, 3) natural logarithms of the semi-axes, scene units.
        quats: (N, 4) wxyz, any non-zero norm.
        W1: (N, K, 3) frequencies, as stored: before the factor omega0. K = 0 to 256; 0 is an ellipsoid of constant
        density. b1: (N, K) phases, before the factor omega0.
        w2: (N, K) amplitudes.
        b2: (N, 1) or (N,) offsets.
        colors: (N, channels), or (C, N, channels) for colours that depend on the camera. Any number of channels.
        viewmats: (C, 4, 4) world-to-camera, OpenCV axes (x right, y down, z forward). float64 is best.
        Ks: (C, 3, 3) intrinsics in pixels, ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``; pixel centres lie at +0.5. Pixels
        need
            not be square, nor the principal point central.
        width, height: size of every image in pixels.
        omega0: factor on the whole phase.
        edge: p; 0 is the hard edge of the paper's primitive, 1 and 2 are soft (:mod:`neuprim.core.model.edge`).
        log_gain: (N, 1) or (N,); None: g = 1. Beyond +-20 it counts as that and has no gradient.
        backgrounds: (channels,) or (C, channels); None is black.
        **settings: fields of :class:`neuprim.core.settings.RenderSettings`: ``backend``, ``near``, ``depth``,
        ``alpha_min``, …

    The primitive tensors share one dtype, float32 or float64; images have that dtype too. The cpu backend computes
    pixels in float32 even so, the reference everything in float64. They share one device, which images are on too;
    cameras and backgrounds may be on the processor all the same.

    Returns:
        :class:`Rasterized`; no cameras (C = 0) and no primitives (N = 0) are fine.

    Raises:
        DataError: a tensor of the wrong type, dtype, device or shape; a camera that is not finite, rigid and free of
        skew.
            The message names the argument, what was found and what was expected.
        ConfigError: an unknown setting, or an impossible value.
        NonFiniteError: a primitive tensor or background holds NaN or infinity, or a quaternion is zero.
        BackendUnavailable: ``Ks`` requires a gradient, and the backend, or any that "auto" may choose, does not compute
        it.
    """
    primitives = {
        "means": means,
        "log_scales": log_scales,
        "quats": quats,
        "W1": W1,
        "b1": b1,
        "w2": w2,
        "b2": b2,
        "colors": colors,
    }
    if log_gain is not None:
        primitives["log_gain"] = log_gain
    knobs = _settings(settings)
    count, channels = _check_primitives(primitives, omega0, edge)
    cameras = _check_cameras(viewmats, Ks, width, height)
    views = len(viewmats)
    if colors.dim() == 3 and len(colors) != views:
        raise _wrong(
            "colors", f"shape {tuple(colors.shape)}", f"({views}, {count}, channels), one set per camera of viewmats"
        )
    backdrop = _check_backgrounds(backgrounds, views, channels)
    if Ks.requires_grad and not all(
        backend.differentiates_intrinsics for backend in backends.candidate_backends(knobs, means.device.type)
    ):
        able = " or ".join(f'backend="{b.name}"' for b in backends.available_backends() if b.differentiates_intrinsics)
        raise BackendUnavailable(
            f'rasterize: Ks requires a gradient, which backend="{knobs.backend}" does not compute; '
            f"pass {able} or Ks.detach()"
        )
    w2, b2 = amplified(w2, b2, log_gain)
    geometry, density = Geometry(means, log_scales, quats), Cosine(W1, b1, w2, b2, float(omega0), edge)
    palettes = list(colors.unbind()) if colors.dim() == 3 else [colors] * views
    frames = [
        render_lowered(Lowered(geometry, density, Constant(palette)), camera, knobs, behind)
        for palette, camera, behind in zip(palettes, cameras, backdrop, strict=True)
    ]
    if not frames:
        # tied to the inputs, so that a loss over no cameras still has a (zero) gradient
        tied = sum((v.sum() * 0 for v in primitives.values()), means.new_zeros(()))
        empty = tied.expand(0, height, width)
        return Rasterized(tied.expand(0, height, width, channels), empty, empty if knobs.depth else None, ())
    depths = [f.depth for f in frames if f.depth is not None]
    return Rasterized(
        torch.stack([f.rgb for f in frames]),
        torch.stack([f.alpha for f in frames]),
        torch.stack(depths) if depths else None,
        tuple(f.stats for f in frames),
    )


# ---------------------------------------------------------------- checks at the edge


def _wrong(name: str, found: str, expected: str) -> DataError:
    return DataError(f"rasterize: {name} has {found}; expected {expected}")


def _settings(settings: dict[str, Any]) -> RenderSettings:
    names = [f.name for f in fields(RenderSettings)]
    for name in settings:
        if name not in names:
            raise ConfigError(f"rasterize: unknown setting {name!r}{nearest(name, names)}")
    knobs = RenderSettings(**settings)
    backends.check_backend_name(knobs.backend)
    return knobs


def _check_tensor(name: str, value: Any) -> None:
    """A float32 or float64 tensor on the processor or a card."""
    fault = tensor_fault(value)
    if fault is not None:
        raise DataError(f"rasterize: {name} has {fault}")


def _check_primitives(t: dict[str, Tensor], omega0: float, edge: int) -> tuple[int, int]:
    """(N, channels) of tensors that fit together."""
    for name, value in t.items():
        _check_tensor(name, value)
        if value.dtype != t["means"].dtype:
            raise _wrong(name, f"dtype {value.dtype}", f"{t['means'].dtype}, as means has")
        if value.device != t["means"].device:
            raise _wrong(name, f"device {value.device}", f"{t['means'].device}, as means has")
    sizes: Sizes = {}
    density = Cosine(t["W1"], t["b1"], t["w2"], t["b2"], omega0, edge)
    for form in (Geometry(t["means"], t["log_scales"], t["quats"]), density):
        fault = form.fault(sizes)
        if fault is not None:
            raise DataError(f"rasterize: {fault}")
    n, colors = sizes["N"][0], tuple(t["colors"].shape)
    if "log_gain" in t and tuple(t["log_gain"].shape) not in ((n, 1), (n,)):
        raise _wrong("log_gain", f"shape {tuple(t['log_gain'].shape)}", f"({n}, 1) or ({n},), as means has N={n}")
    if "log_gain" in t and not bool((finite := torch.isfinite(t["log_gain"].detach()).reshape(-1)).all()):
        raise NonFiniteError(f"rasterize: log_gain of primitive {int((~finite).nonzero()[0])} is not finite")
    if len(colors) not in (2, 3) or colors[-2] != n or colors[-1] < 1:
        raise _wrong(
            "colors", f"shape {colors}", f"(N, channels) or (C, N, channels) with N={n} as in means and channels >= 1"
        )
    for name, row, numbers in _non_finite(t):
        raise NonFiniteError(f"rasterize: {name} of primitive {row} is not finite: {numbers}")
    zero = ~t["quats"].detach().any(-1)
    if bool(zero.any()):
        raise NonFiniteError(
            f"rasterize: quats of primitive {int(zero.nonzero()[0])} is zero; expected a non-zero quaternion"
        )
    return n, colors[-1]


def _non_finite(tensors: dict[str, Tensor]) -> Iterator[tuple[str, int, list[float]]]:
    """(name, primitive, its first values) wherever a tensor has a row that is not finite."""
    for name, tensor in tensors.items():
        value = tensor.detach()
        if bool(torch.isfinite(value.sum(dtype=torch.float64))):  # one pass in the usual case
            continue
        rows = value.transpose(0, 1) if name == "colors" and value.dim() == 3 else value
        bad = ~torch.isfinite(rows).reshape(len(rows), -1).all(1)
        for row in bad.nonzero()[:1, 0].tolist():
            yield name, row, rows[row].flatten()[:8].tolist()


def _check_cameras(viewmats: Tensor, Ks: Tensor, width: int, height: int) -> list[Camera]:
    """One camera per matrix; intrinsics that require a gradient stay tensors, which the reference backend
    differentiates."""
    for name, size in (("width", width), ("height", height)):
        if isinstance(size, bool) or not isinstance(size, int) or size < 1:
            raise _wrong(name, f"value {size!r}", "a positive int")
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
        cameras.append(Camera(view, *lens, width, height))
    return cameras


def _check_backgrounds(backgrounds: Tensor | None, views: int, channels: int) -> Sequence[Tensor | None]:
    """One background per camera."""
    if backgrounds is None:
        return [None] * views
    _check_tensor("backgrounds", backgrounds)
    if tuple(backgrounds.shape) not in ((channels,), (views, channels)):
        raise _wrong("backgrounds", f"shape {tuple(backgrounds.shape)}", f"({channels},) or ({views}, {channels})")
    if not bool(torch.isfinite(backgrounds.detach()).all()):
        raise NonFiniteError(f"rasterize: backgrounds is not finite: {backgrounds.detach().flatten()[:8].tolist()}")
    return backgrounds.expand(views, channels).unbind()

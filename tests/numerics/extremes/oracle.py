"""The line integral of one primitive in extended precision, independent of the renderers.

``long_integrals`` is vectorised and runs in numpy's longdouble: 64 bits of mantissa on x86, so that its own rounding stays
below the bound where float64's does not (distance over radius times axis ratio reaches 1e9). ``mp_integral`` takes one pixel,
fifty digits and another form: the quadratic's two roots and the antiderivative at both, which cancel harmlessly there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np
from torch import Tensor

from neuprim.core.cameras import Camera

__all__ = ["Integrals", "long_colours", "long_integrals", "mp_integral"]

L = np.longdouble
Array = np.ndarray[Any, Any]
OMEGA0 = 30.0


@dataclass
class Integrals:
    """Of one primitive, per pixel (H, W).

    Attributes:
        depth: the optical depth I, unclamped; 0 where the ray misses.
        scale: S = (N_p h/m)(|b2| + sum |w2|), of the chord that the near plane leaves; N = 2, 4/3, 16/15 for edges 0, 1, 2.
        central: the same for a chord through the centre in the same direction, uncut.
        D: 1 - |x_m|^2 of the whole line; positive where it meets the ellipsoid.
        rate: the largest change of a neuron's phase along the chord, radians.
        local: (H, W, 3) x~_m, the middle of the chord that the near plane leaves, in units of m from the centre, scene axes.
    """

    depth: Array
    scale: Array
    central: Array
    D: Array
    rate: Array
    local: Array

    @property
    def hit(self) -> Array:
        return self.scale > 0


def _long(tensor: Tensor) -> Array:
    return tensor.detach().numpy().astype(L)


def _rotation(q: Any) -> list[list[Any]]:
    w, x, y, z = q
    n = w * w + x * x + y * y + z * z
    return [
        [1 - 2 * (y * y + z * z) / n, 2 * (x * y - w * z) / n, 2 * (x * z + w * y) / n],
        [2 * (x * y + w * z) / n, 1 - 2 * (x * x + z * z) / n, 2 * (y * z - w * x) / n],
        [2 * (x * z - w * y) / n, 2 * (y * z + w * x) / n, 1 - 2 * (x * x + y * y) / n],
    ]


def _faded(quadratic: Array, edge: int, phase: Array, change: Array) -> Array:
    """1/2 integral over u in [-1, 1] of (c0 + c1 u + c2 u^2)^p cos(phase + change u): Gauss-Legendre, or by parts where that turns too fast.

    Shapes broadcast; ``quadratic`` holds c0, c1, c2 in its last axis.
    """
    x, w = (q.astype(L) for q in np.polynomial.legendre.leggauss(32))
    weight = (quadratic[..., 0, None] + quadratic[..., 1, None] * x + quadratic[..., 2, None] * x * x) ** edge
    slow = (w * weight * np.cos(phase[..., None] + change[..., None] * x)).sum(-1) / 2
    # derivatives of the weight, as coefficients of u^0..u^4
    c0, c1, c2 = np.moveaxis(quadratic, -1, 0)
    zero = np.zeros_like(c0)
    q = [c0, c1, c2, zero, zero] if edge == 1 else [c0 * c0, 2 * c0 * c1, c1 * c1 + 2 * c0 * c2, 2 * c1 * c2, c2 * c2]
    safe = np.where(np.abs(change) < 8, L(8), change)
    fast = np.zeros(np.broadcast(phase, change, c0).shape, L)
    for n in range(5):  # the antiderivative: sum over n of q^(n)(u) sin(phase + change u - n pi/2 + ...)/change^(n + 1)
        for u, sign in ((L(1), 1), (L(-1), -1)):
            value = sum(q[k] * u**k for k in range(len(q)))
            angle = phase + safe * u
            wave = (np.sin(angle), np.cos(angle), -np.sin(angle), -np.cos(angle))[n % 4]
            fast = fast + sign * value * wave / safe ** (n + 1)
        q = [k * q[k] for k in range(1, len(q))] or [zero]
    return np.where(np.abs(change) < 8, slow, fast / 2)


def long_integrals(t: dict[str, Tensor], row: int, camera: Camera, near: float, edge: int = 0) -> Integrals:
    """All pixels of a view against primitive ``row`` of ``t``."""
    R, shift = _long(camera.viewmat[:3, :3]), _long(camera.viewmat[:3, 3])
    center = R @ _long(t["means"][row]) + shift
    s = np.exp(_long(t["log_scales"][row]))
    m = s.max()
    axes, c = s / m, center / m
    local = np.array(_rotation(_long(t["quats"][row])), L)
    B = R @ local
    x = (np.arange(camera.width).astype(L) + L(0.5) - L(camera.cx)) / L(camera.fx)
    y = (np.arange(camera.height).astype(L) + L(0.5) - L(camera.cy)) / L(camera.fy)
    e = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width), L)], -1)  # camera-z is 1
    v = (e @ B) / axes
    a = (v * v).sum(-1)
    # the rotation is orthogonal to float64's rounding only, so p and v are formed as the renderers define them, in more digits
    p = -(c @ B) / axes
    tm = -(v @ p) / a
    side = np.cross(np.broadcast_to(p, v.shape), v)
    D = 1 - (side * side).sum(-1) / a
    closest = np.cross(v, side) / a[..., None]  # v x (p x v) / a
    h = np.sqrt(np.maximum(D, 0) / a)
    t0, t1 = np.maximum(tm - h, L(near) / m), tm + h
    half = np.where(D > 0, np.maximum(t1 - t0, 0) / 2, 0)
    middle = closest + (np.where(half > 0, (t0 + t1) / 2 - tm, 0))[..., None] * v
    norm = np.sqrt((e * e).sum(-1))
    W1, b1, w2, b2 = (_long(t[k][row]) for k in ("W1", "b1", "w2", "b2"))
    phase = OMEGA0 * ((middle * axes) @ (W1 @ local).T + b1)
    change = OMEGA0 * ((v * axes) @ (W1 @ local).T) * half[..., None]
    sinc = np.where(change == 0, 1, np.sin(change) / np.where(change == 0, 1, change))
    waves, one = np.cos(phase) * sinc, L(1)
    if edge:
        shift = np.where(half > 0, (t0 + t1) / 2 - tm, 0)
        quadratic = np.stack([D - a * shift**2, -2 * a * shift * half, -a * half**2], -1)
        waves = _faded(quadratic[..., None, :], edge, phase, change)
        one = _faded(quadratic, edge, np.zeros_like(half), np.zeros_like(half))
    field = b2.reshape(-1)[0] * one + (w2 * waves).sum(-1)
    norm = norm * (1, L(2) / 3, L(8) / 15)[edge]
    field = field / (1, L(2) / 3, L(8) / 15)[edge]
    amplitude = np.abs(b2).sum() + np.abs(w2).sum()
    rate = 2 * np.abs(change).max(-1) if W1.shape[0] else np.zeros_like(half)
    return Integrals(
        2 * half * norm * field, 2 * half * norm * amplitude, 2 * norm / np.sqrt(a) * amplitude, D, rate, (middle * axes) @ local.T
    )


def long_colours(t: dict[str, Tensor], row: int, exact: Integrals) -> tuple[Array, Array]:
    """(H, W, C) colours of primitive ``row``'s network at the chords' middles, and (C,) |base| + sum |Wout|, their size."""
    Wx, bias, Wout, base = (_long(t[k][row]) for k in ("Wx", "bias", "Wout", "base"))
    waves = np.cos(exact.local @ Wx.T + bias)
    return np.maximum(base + waves @ Wout.T, 0), np.abs(base) + np.abs(Wout).sum(1)


def mp_integral(t: dict[str, Tensor], row: int, camera: Camera, near: float, px: int, py: int, digits: int = 50) -> tuple[Any, Any]:
    """(I, S) of one pixel from the roots of |p + t v|^2 = 1 and the antiderivative of the density, in ``digits`` digits."""
    with mpmath.workdps(digits):
        M = mpmath.mpf

        def numbers(tensor: Tensor) -> list[Any]:
            return [M(float(x)) for x in tensor.detach().double().flatten()]

        view = [numbers(r) for r in camera.viewmat[:3]]
        mean, s, q = numbers(t["means"][row]), [mpmath.exp(x) for x in numbers(t["log_scales"][row])], numbers(t["quats"][row])
        m = max(s)
        local = _rotation(q)
        e = [(M(px) + M(0.5) - M(camera.cx)) / M(camera.fx), (M(py) + M(0.5) - M(camera.cy)) / M(camera.fy), M(1)]
        norm = mpmath.sqrt(sum(x * x for x in e))
        # the matrix is a rotation to float64's rounding only: what the renderers use is c = R mu + t, x_camera = r e
        c = [sum(view[i][j] * mean[j] for j in range(3)) + view[i][3] for i in range(3)]
        p, v = [], []
        for axis in range(3):
            column = [sum(view[i][j] * local[j][axis] for j in range(3)) for i in range(3)]
            p.append(-sum(column[i] * c[i] for i in range(3)) / s[axis])
            v.append(sum(column[i] * e[i] for i in range(3)) / norm / s[axis])
        A, Bh, C = sum(x * x for x in v), sum(x * y for x, y in zip(p, v, strict=True)), sum(x * x for x in p) - 1
        disc = Bh * Bh - A * C
        if disc <= 0:
            return M(0), M(0)
        t0, t1 = (-Bh - mpmath.sqrt(disc)) / A, (-Bh + mpmath.sqrt(disc)) / A
        t0 = max(t0, M(near) * norm)
        if t1 <= t0:
            return M(0), M(0)
        b2 = numbers(t["b2"][row])[0]
        total, amplitude = b2 * (t1 - t0), abs(b2)
        for W, b, w in zip(t["W1"][row], numbers(t["b1"][row]), numbers(t["w2"][row]), strict=True):
            weights = numbers(W)
            on_axis = [sum(weights[i] * local[i][axis] for i in range(3)) * s[axis] / m for axis in range(3)]
            rate = OMEGA0 * sum(on_axis[a] * v[a] for a in range(3))
            start = OMEGA0 * (sum(on_axis[a] * p[a] for a in range(3)) + b)
            if rate == 0:
                total += w * mpmath.cos(start) * (t1 - t0)
            else:
                total += w * (mpmath.sin(start + rate * t1) - mpmath.sin(start + rate * t0)) / rate
            amplitude += abs(w)
        return total / m, (t1 - t0) / m * amplitude

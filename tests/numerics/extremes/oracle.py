"""The line integral of one primitive in extended precision, independent of the renderers.

``long_integrals`` is vectorised and runs in numpy's longdouble: 64 bits of mantissa on x86, so that its own rounding
stays below the bound where float64's does not (distance over radius times axis ratio reaches 1e9). ``mp_integral``
takes one pixel, fifty digits and another form: the quadratic's two roots and the antiderivative at both, which cancel
harmlessly there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np
from torch import Tensor

from neuprim.core.cameras import Camera

L = np.longdouble
Array = np.ndarray[Any, Any]
OMEGA0 = 30.0
GAIN_LIMIT = 20.0


@dataclass
class Integrals:
    """Of one primitive, per pixel (H, W).

    Attributes:
        depth: the optical depth I, unclamped; 0 where the ray misses.
        scale: S = (N_p h/m)(|b2| + sum |w2|), of the chord that the near plane leaves; N = 2, 4/3, 16/15 for edges 0,
        1, 2. central: the same for a chord through the centre in the same direction, uncut.
        D: 1 - |x_m|^2 of the whole line; positive where it meets the ellipsoid.
        rate: the largest change of a neuron's phase along the chord, radians.
        local: (H, W, 3) x~_m, the middle of the chord that the near plane leaves, in units of m from the centre, scene
        axes.
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


def _nodes(count: int) -> tuple[Array, Array]:
    """Nodes and weights of Gauss-Legendre quadrature, to longdouble's last digits."""
    x = np.polynomial.legendre.leggauss(count)[0].astype(L)
    for _ in range(3):  # Newton from float64's nodes
        low, high = np.ones_like(x), x
        for n in range(1, count):
            low, high = high, ((2 * n + 1) * x * high - n * low) / (n + 1)
        slope = count * (x * high - low) / (x * x - 1)
        x = x - high / slope
    return x, 2 / ((1 - x * x) * slope * slope)


_SLOW = 4  # radians over half a chord up to which the quadrature is exact to longdouble's digits
_NODES = _nodes(16)


def _faded(quadratic: Array, edge: int, phase: Array, change: Array) -> Array:
    """1/2 integral over u in [-1, 1] of (c0 + c1 u + c2 u^2)^p cos(phase + change u): Gauss-Legendre, or by parts where
    that turns too fast.

    Shapes broadcast; ``quadratic`` holds c0, c1, c2 in its last axis.
    """
    x, w = _NODES
    weight = (quadratic[..., 0, None] + quadratic[..., 1, None] * x + quadratic[..., 2, None] * x * x) ** edge
    slow = (w * weight * np.cos(phase[..., None] + change[..., None] * x)).sum(-1) / 2
    # derivatives of the weight, as coefficients of u^0..u^4
    c0, c1, c2 = np.moveaxis(quadratic, -1, 0)
    zero = np.zeros_like(c0)
    q = [c0, c1, c2, zero, zero] if edge == 1 else [c0 * c0, 2 * c0 * c1, c1 * c1 + 2 * c0 * c2, 2 * c1 * c2, c2 * c2]
    safe = np.where(np.abs(change) < _SLOW, L(_SLOW), change)
    fast = np.zeros(np.broadcast(phase, change, c0).shape, L)
    ends = [(sign, np.sin(phase + sign * safe), np.cos(phase + sign * safe)) for sign in (L(1), L(-1))]
    for n in range(
        2 * edge + 1
    ):  # the antiderivative: sum over n of q^(n)(u) sin(phase + change u + n pi/2)/change^(n + 1)
        for sign, sine, cosine in ends:
            value = sum(q[k] * sign**k for k in range(len(q)))
            fast = fast + sign * value * (sine, cosine, -sine, -cosine)[n % 4] / safe ** (n + 1)
        q = [k * q[k] for k in range(1, len(q))] or [zero]
    return np.where(np.abs(change) < _SLOW, slow, fast / 2)


def long_integrals(t: dict[str, Tensor], row: int, camera: Camera, near: float, edge: int = 0) -> Integrals:
    """All pixels of a view against primitive ``row`` of ``t``, its gain included where ``t`` has one."""
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
    # the rotation is orthogonal to float64's rounding only, so p and v are formed as the renderers define them, in more
    # digits
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
    if "log_gain" in t:
        gain = np.exp(np.clip(_long(t["log_gain"][row]), -GAIN_LIMIT, GAIN_LIMIT))
        w2, b2 = w2 * gain, b2 * gain
    phase = OMEGA0 * ((middle * axes) @ (W1 @ local).T + b1)
    change = OMEGA0 * ((v * axes) @ (W1 @ local).T) * half[..., None]
    sinc = np.where(change == 0, 1, np.sin(change) / np.where(change == 0, 1, change))
    waves, one = np.cos(phase) * sinc, L(1)
    if edge:
        shift = np.where(half > 0, (t0 + t1) / 2 - tm, 0)
        quadratic = np.stack([D - a * shift**2, -2 * a * shift * half, -a * half**2], -1)
        met = half > 0
        still = np.zeros(int(met.sum()), L)
        waves[met] = _faded(quadratic[met][:, None, :], edge, phase[met], change[met])
        one = np.zeros_like(half)
        one[met] = _faded(quadratic[met], edge, still, still)
    field = b2.reshape(-1)[0] * one + (w2 * waves).sum(-1)
    norm = norm * (1, L(2) / 3, L(8) / 15)[edge]
    field = field / (1, L(2) / 3, L(8) / 15)[edge]
    amplitude = np.abs(b2).sum() + np.abs(w2).sum()
    rate = 2 * np.abs(change).max(-1) if W1.shape[0] else np.zeros_like(half)
    return Integrals(
        2 * half * norm * field,
        2 * half * norm * amplitude,
        2 * norm / np.sqrt(a) * amplitude,
        D,
        rate,
        (middle * axes) @ local.T,
    )


def long_colours(t: dict[str, Tensor], row: int, exact: Integrals) -> tuple[Array, Array]:
    """(H, W, C) colours of primitive ``row``'s network at the chords' middles, and (C,) |base| + sum |Wout|, their
    size."""
    Wx, bias, Wout, base = (_long(t[k][row]) for k in ("Wx", "bias", "Wout", "base"))
    waves = np.cos(exact.local @ Wx.T + bias)
    return np.maximum(base + waves @ Wout.T, 0), np.abs(base) + np.abs(Wout).sum(1)


def mp_integral(
    t: dict[str, Tensor], row: int, camera: Camera, near: float, px: int, py: int, edge: int = 0, digits: int = 50
) -> tuple[Any, Any]:
    """(I, S) of one pixel from the roots of |p + t v|^2 = 1 and the antiderivative of the density, in ``digits``
    digits.

    That of a soft edge is divided by the rate 2p + 1 times: it takes as many more digits as slow neurons then cost.
    """
    digits += 75 * edge
    with mpmath.workdps(digits):
        M = mpmath.mpf

        def numbers(tensor: Tensor) -> list[Any]:
            return [M(float(x)) for x in tensor.detach().double().flatten()]

        view = [numbers(r) for r in camera.viewmat[:3]]
        mean = numbers(t["means"][row])
        s = [mpmath.exp(x) for x in numbers(t["log_scales"][row])]
        q = numbers(t["quats"][row])
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
        gain = (
            mpmath.exp(min(max(numbers(t["log_gain"][row])[0], -M(GAIN_LIMIT)), M(GAIN_LIMIT)))
            if "log_gain" in t
            else M(1)
        )
        b2 = numbers(t["b2"][row])[0] * gain
        weight = [M(1)]  # 1 - |p + t v|^2 to the power p, coefficients of t^0..t^2p
        for _ in range(edge):
            old = [*weight, M(0), M(0)]
            weight = [
                -C * old[k] - 2 * Bh * (old[k - 1] if k > 0 else 0) - A * (old[k - 2] if k > 1 else 0)
                for k in range(len(old))
            ]
        plain = sum(c * (t1 ** (k + 1) - t0 ** (k + 1)) / (k + 1) for k, c in enumerate(weight))
        total, amplitude = b2 * plain, abs(b2)
        for W, b, w in zip(t["W1"][row], numbers(t["b1"][row]), numbers(t["w2"][row]), strict=True):
            weights = numbers(W)
            on_axis = [sum(weights[i] * local[i][axis] for i in range(3)) * s[axis] / m for axis in range(3)]
            rate = OMEGA0 * sum(on_axis[a] * v[a] for a in range(3))
            start = OMEGA0 * (sum(on_axis[a] * p[a] for a in range(3)) + b)
            if rate == 0:
                total += w * gain * mpmath.cos(start) * plain
            else:
                q, n = weight, 0
                while q:
                    ends = [
                        sum(c * at**k for k, c in enumerate(q)) * mpmath.sin(start + rate * at + n * mpmath.pi / 2)
                        for at in (t1, t0)
                    ]
                    total += w * gain * (ends[0] - ends[1]) / rate ** (n + 1)
                    q, n = [k * c for k, c in enumerate(q)][1:], n + 1
            amplitude += abs(w) * gain
        amplitude *= (1, M(2) / 3, M(8) / 15)[edge]
        return total / m, (t1 - t0) / m * amplitude

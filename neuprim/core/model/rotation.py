"""Rotation matrices of quaternions and their gradient, for the kernels;
:func:`~neuprim.core.model.geometry.quaternion_to_matrix` in torch."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import strict


@strict
def rotation(q, out):  # type: ignore[no-untyped-def]
    w, x, y, z = (
        np.float64(q[0]),
        np.float64(q[1]),
        np.float64(q[2]),
        np.float64(q[3]),
    )  # float32 squares would scale the rotation
    n = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * n, x * n, y * n, z * n
    out[0, 0] = 1 - 2 * (y * y + z * z)
    out[0, 1] = 2 * (x * y - w * z)
    out[0, 2] = 2 * (x * z + w * y)
    out[1, 0] = 2 * (x * y + w * z)
    out[1, 1] = 1 - 2 * (x * x + z * z)
    out[1, 2] = 2 * (y * z - w * x)
    out[2, 0] = 2 * (x * z - w * y)
    out[2, 1] = 2 * (y * z + w * x)
    out[2, 2] = 1 - 2 * (x * x + y * y)
    return n


@strict
def rotation_backward(q, n, g, out):  # type: ignore[no-untyped-def]
    """dL/dq from dL/dR; the normalisation projects out the radial part."""
    w, x, y, z = q[0] * n, q[1] * n, q[2] * n, q[3] * n
    gw = 2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    gx = 2 * (w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) - 2 * x * (g[1, 1] + g[2, 2]))
    gy = 2 * (w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) - 2 * y * (g[0, 0] + g[2, 2]))
    gz = 2 * (w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - 2 * z * (g[0, 0] + g[1, 1]))
    dot = gw * w + gx * x + gy * y + gz * z
    out[0] = (gw - dot * w) * n
    out[1] = (gx - dot * x) * n
    out[2] = (gy - dot * y) * n
    out[3] = (gz - dot * z) * n

"""Where generated cameras and lights stand, z up: directions on the sphere, and the pose of a camera that looks at the
origin."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from neuprim.core.cameras import look_at

__all__ = ["camera_to_world", "direction"]


def direction(cosine: float, azimuth: float) -> NDArray[np.float64]:
    """(3,) unit vector at this cosine of the angle from the zenith, ``azimuth`` radians from x towards y."""
    across = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    return np.array([across * math.cos(azimuth), across * math.sin(azimuth), cosine])


def camera_to_world(eye: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) camera-to-world matrix, OpenGL axes, of a camera at ``eye`` (3,) that looks at the origin, z up."""
    view = look_at(torch.from_numpy(np.asarray(eye, dtype=np.float64)), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return torch.linalg.inv(view).numpy() @ np.diag([1.0, -1.0, -1.0, 1.0])

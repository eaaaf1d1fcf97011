"""The camera in an OpenEXR file's header, by the definitions of its standard."""

from __future__ import annotations

import numpy as np
import torch

from neuprim.core.cameras.pinhole import camera_exr_attributes
from tests import scenes

CAMERA = scenes.camera(64, 48, shift=(5.0, -3.0))
POINTS = torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [-0.4, 0.5, 0.2]], dtype=torch.float64)


def test_points_through_the_matrices_land_where_the_camera_projects_them() -> None:
    found = camera_exr_attributes(CAMERA, 0.25)
    rows = np.concatenate([POINTS.numpy(), np.ones((3, 1))], 1) @ found["worldToNDC"]  # row vectors, as Imath
    pixels, z = CAMERA.project(POINTS)
    assert np.abs(rows[:, :2] / rows[:, 3:] * (64, 48) - pixels.numpy()).max() < 1e-3
    assert np.abs(rows[:, 3] - z.numpy()).max() < 1e-5 and np.abs(rows[:, 2] - (z.numpy() - 0.25)).max() < 1e-5


def test_camera_space_is_left_handed_with_y_up_and_z_ahead() -> None:
    matrix = camera_exr_attributes(CAMERA, 0.25)["worldToCamera"]
    view = CAMERA.viewmat
    ahead = CAMERA.position - view[1, :3] + 2 * view[2, :3]  # up in the image is against the second row
    assert np.abs(np.append(ahead.numpy(), 1.0) @ matrix - (0.0, 1.0, 2.0, 1.0)).max() < 1e-5
    assert np.linalg.det(matrix[:3, :3].astype(float)) < 0
    assert matrix.dtype == np.float32 and matrix.shape == (4, 4) and matrix.flags.c_contiguous, (
        "it is written as it lies"
    )

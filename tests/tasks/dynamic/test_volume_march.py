"""The integrator against closed forms, a slow march in float64, and itself."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from neuprim.tasks.dynamic.volume.medium import Medium
from neuprim.tasks.dynamic.volume.raymarch import render_medium
from tests.tasks.dynamic.volumes import box, camera, grey, march_slowly, ragged, sheet


def along_z(size: int = 9, far: float = 1e4) -> object:
    """A camera so far up that all rays are parallel to z; its image is a little wider than a unit box."""
    return camera((0.0, 0.0, far), size, math.degrees(2 * math.atan(0.55 / far)), (0.0, 1.0, 0.0))


def layers(sigma: list[float], colors: list[float], side: float = 1.0) -> tuple[Medium, float]:
    """Layers across z, constant in x and y but for the rim, and the edge of a voxel."""
    n = len(sigma)
    profile = np.tile(np.array(sigma), (n, n, 1))
    values = np.stack([profile, *[profile * np.array(colors)] * 3], -1).astype(np.float32)
    return Medium.dense(values, box((n, n, n))).padded(), side / n


@pytest.mark.parametrize("sigma", [0.01, 1.0, 20.0, 300.0])
def test_homogeneous_box(sigma: float) -> None:
    """alpha = 1 - exp(-σ d) with the ramps of half a weight on both sides, and L = c alpha."""
    medium, h = layers([sigma] * 16, [1.0] * 16)
    image = render_medium(medium, along_z(), 1)[4, 4]
    alpha = 1 - math.exp(-sigma * 16 * h)
    assert image[3].item() == pytest.approx(alpha, abs=1.01e-4)  # a ray ends at a transmittance of 1e-4
    assert image[:3].tolist() == pytest.approx([image[3].item()] * 3, rel=1e-5, abs=1e-6)


def test_source_without_extinction() -> None:
    """σ c may be given where σ is 0: the radiance is its plain integral."""
    n = 8
    values = np.zeros((n, n, n, 4), np.float32)
    values[..., 1:] = 3.0
    image = render_medium(Medium.dense(values, box((n, n, n))).padded(), along_z(), 1)[4, 4]
    assert image.tolist() == pytest.approx([3.0, 3.0, 3.0, 0.0], rel=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_random_media_against_a_slow_march(seed: int) -> None:
    medium = ragged(seed)
    view = camera(((2.2, 0.5, 1.4), (-1.0, 2.4, 0.3), (0.1, 0.2, 2.6))[seed], 10)
    expected = march_slowly(medium, view)
    found = render_medium(medium, view, 1, subdivisions=8).numpy()
    assert expected[..., 3].max() > 0.6 and np.abs(found - expected).max() < 1e-4
    rough = render_medium(medium, view, 1).numpy()
    assert np.abs(rough[..., 3] - expected[..., 3]).max() < 5e-5  # the optical depth does not depend on the step
    assert np.abs(rough - expected).max() < 1e-3


@pytest.mark.parametrize("seed", range(2))
def test_halving_the_step_moves_no_pixel(seed: int) -> None:
    medium = sheet(seed)
    views = [camera((1.6, -1.5, 1.5), 64), camera((-2.6, 0.4, 0.5), 128)]
    for view in views:
        images = [render_medium(medium, view, 1, subdivisions=n) for n in (1, 2, 4, 8)]
        peak = images[-1][..., :3].max()
        changes = [((a - b).abs().max() / peak).item() for a, b in itertools.pairwise(images)]
        assert changes[0] < 2e-3 and changes[1] < 2e-4 and changes[2] < 2e-5, changes


@pytest.mark.parametrize("strength", [100.0, 3000.0, 1e6])
def test_voxels_from_thick_to_solid(strength: float) -> None:
    """Steps become shorter by themselves; sources stay between the least and the greatest one."""
    rng = np.random.default_rng(1)
    sigma = rng.random((9, 9, 9)) * strength
    values = np.concatenate([sigma[..., None], sigma[..., None] * rng.uniform(0.5, 1.0, (9, 9, 9, 3))], -1)
    medium = Medium.dense(values.astype(np.float32), box((9, 9, 9))).padded()
    image, fine = (render_medium(medium, camera((1.6, -1.5, 1.5), 64), 1, subdivisions=n) for n in (1, 8))
    rgb, alpha = image[..., :3], image[..., 3:]
    assert torch.isfinite(image).all() and (rgb <= alpha * (1 + 1e-5)).all() and (rgb >= 0.499 * alpha).all()
    if strength < 1e4:
        assert (image - fine).abs().max() < 2e-3


def test_anisotropic_and_sheared_voxels() -> None:
    """One smooth field on different voxels: only their resolution tells, so σ is per scene unit, not per voxel."""
    view, images = camera((1.5, 1.8, 1.0), 24), []
    shear = np.eye(4)
    shear[0, 1] = 0.3
    for shape, extra in (((40, 40, 40), np.eye(4)), ((60, 30, 45), np.eye(4)), ((56, 40, 40), shear)):
        matrix = np.eye(4)
        sides = np.array([1.4, 1.0, 1.0] if extra is shear else [1.0, 1.0, 1.0])
        matrix[range(3), range(3)] = sides / shape
        matrix[:3, 3] = -0.5 * sides + np.diag(matrix)[:3] / 2
        matrix = extra @ matrix
        index = np.stack(np.meshgrid(*[np.arange(s) for s in shape], indexing="ij"), -1)
        where = index @ matrix[:3, :3].T + matrix[:3, 3]
        images.append(
            render_medium(Medium.dense(grey(8.0 * np.exp(-20.0 * (where**2).sum(-1))), matrix).padded(), view)
        )
    assert images[0][..., 3].max() > 0.8
    assert (images[0] - images[1]).abs().max() < 5e-3 and (images[0] - images[2]).abs().max() < 5e-3


def test_empty_space_is_skipped_without_a_trace() -> None:
    """Far apart voxels in a large grid, with skips and without."""
    values = np.zeros((90, 40, 60, 4), np.float32)
    rng = np.random.default_rng(0)
    for i, j, k in rng.integers(1, 38, (40, 3)):
        values[2 * i, j, k] = 300.0 * rng.random(4)
    view = camera((2.0, 1.0, 1.5), 64)
    sparse, dense = (Medium.dense(values, box((90, 40, 60))) for _ in range(2))
    assert sparse.skips.max() > 5
    dense.__dict__["skips"] = np.zeros_like(sparse.skips)
    a, b = render_medium(sparse, view), render_medium(dense, view)
    assert b[..., 3].max() > 0.1 and (a - b).abs().max() < 1e-5


def test_nothing() -> None:
    view = camera((2.0, 1.0, 1.5), 7)
    zeros = np.zeros((5, 6, 7, 4), np.float32)
    padded = (Medium.dense(voxels, np.eye(4)).padded() for voxels in (zeros, zeros[:0]))
    for medium in (Medium.without_voxels(), *padded, Medium.dense(zeros[:1], np.eye(4))):
        assert torch.equal(render_medium(medium, view), torch.zeros(7, 7, 4))

"""The integrator against closed forms, a slow march in float64, and itself."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from neuprim.core.errors import ConfigError, DataError
from neuprim.tasks.dynamic.volume import Medium, integrate
from tests.tasks.dynamic.volumes import box, camera, grey, march_slowly, ragged, rays, rotation, sheet

pytestmark = pytest.mark.usefixtures("either_kernel")


def along_z(size: int = 9, far: float = 1e4) -> object:
    """A camera so far up that all rays are parallel to z; its image is a little wider than a unit box."""
    return camera((0.0, 0.0, far), size, math.degrees(2 * math.atan(0.55 / far)), (0.0, 1.0, 0.0))


def layers(sigma: list[float], colors: list[float], side: float = 1.0) -> tuple[Medium, float]:
    """Layers across z, constant in x and y but for the rim, and the edge of a voxel."""
    n = len(sigma)
    profile = np.tile(np.array(sigma), (n, n, 1))
    values = np.stack([profile, *[profile * np.array(colors)] * 3], -1).astype(np.float32)
    return Medium.padded(values, box((n, n, n))), side / n


@pytest.mark.parametrize("sigma", [0.01, 1.0, 20.0, 300.0])
def test_homogeneous_box(sigma: float) -> None:
    """alpha = 1 - exp(-σ d) with the ramps of half a weight on both sides, and L = c alpha."""
    medium, h = layers([sigma] * 16, [1.0] * 16)
    image = integrate(medium, along_z(), 1)[4, 4]
    alpha = 1 - math.exp(-sigma * 16 * h)
    assert image[3].item() == pytest.approx(alpha, abs=1.01e-4)  # a ray ends at a transmittance of 1e-4
    assert image[:3].tolist() == pytest.approx([image[3].item()] * 3, rel=1e-5, abs=1e-6)


def test_homogeneous_box_seen_from_anywhere() -> None:
    """Every ray that misses the rim by a voxel has the optical depth of its chord through the inner box, plus that of
    the rim."""
    n, sigma = 24, 2.0
    medium = Medium.padded(grey(np.full((n, n, n), sigma)), box((n, n, n)))
    view = camera((1.9, -1.2, 1.4), 24)
    origin, directions = rays(view)
    directions = directions[:, :, 0]
    chords = []
    for half in (0.5 - 0.5 / n, 0.5 + 0.5 / n):
        with np.errstate(divide="ignore"):
            a, b = (-half - origin) / directions, (half - origin) / directions
        chords.append(np.maximum(np.maximum(a, b).min(-1) - np.minimum(a, b).max(-1), 0.0))
    image = integrate(medium, view, 1).numpy()
    low, high = (1 - np.exp(-sigma * c) for c in chords)
    assert ((image[..., 3] >= low - 1e-5) & (image[..., 3] <= high + 1e-5)).all() and low.max() > 0.8
    assert np.allclose(image[..., :3], image[..., 3:] * np.array([1.0, 0.5, 0.25]), atol=1e-6)


def test_sphere() -> None:
    """alpha of a ball from its chords; the voxels of its surface are the only error."""
    n, sigma, radius = 64, 3.0, 0.4
    where = np.stack(np.meshgrid(*[(np.arange(n) - (n - 1) / 2) / n] * 3, indexing="ij"), -1)
    coverage = np.clip((radius - np.linalg.norm(where, axis=-1)) * n + 0.5, 0.0, 1.0)
    medium = Medium.padded(grey(sigma * coverage), box((n, n, n)))
    view = camera((1.0, 2.0, 1.5), 32)
    origin, directions = rays(view)
    nearest = np.linalg.norm(np.cross(directions[:, :, 0], origin), axis=-1)
    chord = 2 * np.sqrt(np.maximum(radius**2 - nearest**2, 0.0))
    error = np.abs(integrate(medium, view, 1)[..., 3].numpy() - (1 - np.exp(-sigma * chord)))
    assert error[nearest < 0.36].max() < 5e-3 and error[nearest > radius + 2.5 / n].max() < 1e-6


def test_two_layers() -> None:
    """Emission and absorption: what is behind shines through what is in front; the boundary is one voxel of ramp."""
    n = 64
    medium, h = layers([2.0] * (n // 2) + [5.0] * (n // 2), [1.0] * (n // 2) + [0.2] * (n // 2))
    value = integrate(medium, along_z(), 1)[4, 4]
    front, behind = math.exp(-5.0 / 2), math.exp(-2.0 / 2)
    assert value[3].item() == pytest.approx(1 - front * behind, abs=1e-5)
    assert value[0].item() == pytest.approx(0.2 * (1 - front) + front * (1 - behind), abs=1.5 * h * front)


def test_ramp() -> None:
    """A density that grows linearly has a quadratic optical depth, exactly."""
    n = 20
    medium, h = layers([0.5 * k for k in range(1, n + 1)], [1.0] * n)
    depth = h * sum(0.5 * k for k in range(1, n + 1))
    assert integrate(medium, along_z(), 1)[4, 4, 3].item() == pytest.approx(1 - math.exp(-depth), abs=2e-6)


def test_source_without_extinction() -> None:
    """σ c may be given where σ is 0: the radiance is its plain integral."""
    n = 8
    values = np.zeros((n, n, n, 4), np.float32)
    values[..., 1:] = 3.0
    image = integrate(Medium.padded(values, box((n, n, n))), along_z(), 1)[4, 4]
    assert image.tolist() == pytest.approx([3.0, 3.0, 3.0, 0.0], rel=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_random_media_against_a_slow_march(seed: int) -> None:
    medium = ragged(seed)
    view = camera(((2.2, 0.5, 1.4), (-1.0, 2.4, 0.3), (0.1, 0.2, 2.6))[seed], 10)
    expected = march_slowly(medium, view)
    found = integrate(medium, view, 1, subdivisions=8).numpy()
    assert expected[..., 3].max() > 0.6 and np.abs(found - expected).max() < 1e-4
    rough = integrate(medium, view, 1).numpy()
    assert np.abs(rough[..., 3] - expected[..., 3]).max() < 5e-5  # the optical depth does not depend on the step
    assert np.abs(rough - expected).max() < 1e-3


@pytest.mark.parametrize("seed", range(2))
def test_halving_the_step_moves_no_pixel(seed: int) -> None:
    medium = sheet(seed)
    views = [camera((1.6, -1.5, 1.5), 64), camera((-2.6, 0.4, 0.5), 128)]
    for view in views:
        images = [integrate(medium, view, 1, subdivisions=n) for n in (1, 2, 4, 8)]
        peak = images[-1][..., :3].max()
        changes = [((a - b).abs().max() / peak).item() for a, b in itertools.pairwise(images)]
        assert changes[0] < 2e-3 and changes[1] < 2e-4 and changes[2] < 2e-5, changes


@pytest.mark.parametrize("strength", [100.0, 3000.0, 1e6])
def test_voxels_from_thick_to_solid(strength: float) -> None:
    """Steps become shorter by themselves; sources stay between the least and the greatest one."""
    rng = np.random.default_rng(1)
    sigma = rng.random((9, 9, 9)) * strength
    medium = Medium.padded(
        np.concatenate([sigma[..., None], sigma[..., None] * rng.uniform(0.5, 1.0, (9, 9, 9, 3))], -1).astype(
            np.float32
        ),
        box((9, 9, 9)),
    )
    image, fine = (integrate(medium, camera((1.6, -1.5, 1.5), 64), 1, subdivisions=n) for n in (1, 8))
    assert (
        torch.isfinite(image).all()
        and (image[..., :3] <= image[..., 3:] * (1 + 1e-5)).all()
        and (image[..., :3] >= 0.499 * image[..., 3:]).all()
    )
    if strength < 1e4:
        assert (image - fine).abs().max() < 2e-3


def test_rotation() -> None:
    """The grid turned by its transform, and the camera with it: the same image."""
    medium, view = ragged(5), camera((2.0, 1.0, 1.5), 24)
    turn = rotation(3)
    turned = Medium(medium.values, turn @ medium.scene_from_index)
    follows = type(view)(
        view.viewmat @ torch.from_numpy(turn.T.copy()), view.fx, view.fy, view.cx, view.cy, view.width, view.height
    )
    assert (integrate(medium, view) - integrate(turned, follows)).abs().max() < 2e-6


def test_anisotropic_and_sheared_voxels() -> None:
    """One smooth field on different voxels: only their resolution tells, so σ is per scene unit, not per voxel."""
    view, images = camera((1.5, 1.8, 1.0), 24), []
    shear = np.eye(4)
    shear[0, 1] = 0.3
    for shape, extra in (((40, 40, 40), np.eye(4)), ((60, 30, 45), np.eye(4)), ((56, 40, 40), shear)):
        matrix = np.eye(4)
        matrix[range(3), range(3)] = np.array([1.4, 1.0, 1.0] if extra is shear else [1.0, 1.0, 1.0]) / shape
        matrix[:3, 3] = (
            -0.5 * np.array([1.4, 1.0, 1.0] if extra is shear else [1.0, 1.0, 1.0]) + np.diag(matrix)[:3] / 2
        )
        matrix = extra @ matrix
        index = np.stack(np.meshgrid(*[np.arange(s) for s in shape], indexing="ij"), -1)
        where = index @ matrix[:3, :3].T + matrix[:3, 3]
        images.append(integrate(Medium.padded(grey(8.0 * np.exp(-20.0 * (where**2).sum(-1))), matrix), view))
    assert images[0][..., 3].max() > 0.8
    assert (images[0] - images[1]).abs().max() < 5e-3 and (images[0] - images[2]).abs().max() < 5e-3


def test_antialiasing_is_the_mean_of_smaller_pixels() -> None:
    medium, view = ragged(6), camera((2.0, 1.0, 1.5), 12)
    fine = integrate(medium, view.resized(36, 36), 1).reshape(12, 3, 12, 3, 4).mean((1, 3))
    assert (integrate(medium, view, 3) - fine).abs().max() < 1e-6
    assert np.abs(integrate(medium, view, 2, 8).numpy() - march_slowly(medium, view, 2, steps=4000)).max() < 2e-4


def test_empty_space_is_skipped_without_a_trace() -> None:
    """Far apart voxels in a large grid, with skips and without."""
    values = np.zeros((90, 40, 60, 4), np.float32)
    rng = np.random.default_rng(0)
    for i, j, k in rng.integers(1, 38, (40, 3)):
        values[2 * i, j, k] = 300.0 * rng.random(4)
    view = camera((2.0, 1.0, 1.5), 64)
    sparse, dense = Medium(values, box((90, 40, 60))), Medium(values, box((90, 40, 60)))
    assert sparse.skips.max() > 5
    dense.__dict__["skips"] = np.zeros_like(sparse.skips)
    a, b = integrate(sparse, view), integrate(dense, view)
    assert b[..., 3].max() > 0.1 and (a - b).abs().max() < 1e-5


def test_a_camera_inside_sees_what_is_in_front() -> None:
    n = 16
    medium = Medium.padded(grey(np.full((n, n, n), 2.0)), box((n, n, n)))
    view = camera((1e-3, 0.0, 0.0), 5, 10.0)
    assert integrate(medium, view, 1)[2, 2, 3].item() == pytest.approx(1 - math.exp(-2.0 * 0.501), abs=1e-4)
    away = camera((-2.0, 0.0, 0.0), 5, 10.0)
    shift = np.eye(4)
    shift[0, 3] = -4.0
    behind = Medium(medium.values, shift @ medium.scene_from_index)
    assert integrate(behind, away, 1).abs().max() == 0.0


def test_any_number_of_threads() -> None:
    medium, view = ragged(7), camera((2.0, 1.0, 1.5), 33)
    images = [integrate(medium, view, threads=n) for n in (1, 2, 3, 7, 0)]
    assert all(torch.equal(images[0], other) for other in images[1:])


def test_nothing() -> None:
    view = camera((2.0, 1.0, 1.5), 7)
    zeros = np.zeros((5, 6, 7, 4), np.float32)
    for medium in (
        Medium.nothing(),
        Medium.padded(zeros, np.eye(4)),
        Medium.padded(zeros[:0], np.eye(4)),
        Medium(zeros[:1], np.eye(4)),
    ):
        assert torch.equal(integrate(medium, view), torch.zeros(7, 7, 4))


def test_refusals() -> None:
    values = np.ones((3, 3, 3, 4), np.float32)
    for call in (
        lambda: Medium(values, np.eye(4)),
        lambda: Medium(values[..., 0], np.eye(4)),
        lambda: Medium.padded(-values, np.eye(4)),
        lambda: Medium.padded(values * np.float32(np.nan), np.eye(4)),
        lambda: Medium.padded(values, np.diag([1.0, 1.0, 0.0, 1.0])),
        lambda: Medium.padded(values, np.full((4, 4), np.nan)),
    ):
        with pytest.raises(DataError, match=r"expected|zero"):
            call()
    with pytest.raises(ConfigError, match="at least 1"):
        integrate(Medium.nothing(), camera((2.0, 1.0, 1.5)), 0)

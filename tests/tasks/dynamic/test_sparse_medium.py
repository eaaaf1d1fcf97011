"""Media in bricks against the same media in one block: images, light, voxels to learn from, and refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.errors import DataError
from neuprim.core.io.vdb import VdbGrid, VdbTiles, read_grids, vdb_scale_transform, write_vdb
from neuprim.tasks.dynamic.volume import lit_medium
from neuprim.tasks.dynamic.volume.capture_density import sample_extinction
from neuprim.tasks.dynamic.volume.capture_voxels import MediumVoxels
from neuprim.tasks.dynamic.volume.lit_medium import LitMedium, build_medium
from neuprim.tasks.dynamic.volume.medium import Bricks, Medium, bricks_with_voxels
from neuprim.tasks.dynamic.volume.optics import Light, Optics
from neuprim.tasks.dynamic.volume.raymarch import point_transmittance, render_medium
from tests.tasks.dynamic.volumes import camera, grid_of, rotation

SHAPE = (70, 45, 52)
LOOK = Optics(
    extinction=40.0,
    albedo=(0.9, 0.6, 0.3),
    ambient=(0.1, 0.2, 0.3),
    light=Light((0.3, -0.5, 0.8), (3.0, 2.0, 1.0)),
    emission=2.0,
    flame_extinction=9.0,
    fire_lights=4,
    color_grid="color",
)


def scattered_blobs(seed: int, shape: tuple[int, int, int]) -> np.ndarray:
    """Blobs along a diagonal of a box, smooth and ragged."""
    rng = np.random.default_rng(seed)
    where = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)
    values = np.zeros(shape)
    for share in (0.08, 0.5, 0.9):
        center = share * np.array(shape) + rng.normal(0, 1, 3)
        values += np.maximum(1 - np.square((where - center) / 4).sum(-1), 0) * (0.5 + rng.random(shape))
    return values


def fire(seed: int) -> dict[str, VdbGrid]:
    """Smoke and colours on the same voxels, flames on others, turned against them; indices do not start at a leaf."""
    smoke = vdb_scale_transform(1 / 70)
    density = VdbGrid.from_dense("density", scattered_blobs(seed, SHAPE), lower=(-13, 5, 1003), transform=smoke)
    color = np.random.default_rng(seed).random((*SHAPE, 3)) * (scattered_blobs(seed, SHAPE) > 0)[..., None]
    place = smoke.copy()
    place[:3, :3] = 1.7 / 70 * rotation(seed)[:3, :3]
    place[:3, 3] = smoke[:3, :3] @ (np.array((-13, 5, 1003)) + np.array(SHAPE) / 2) - place[:3, :3] @ [10, 10, 10]
    return {
        "density": density,
        "color": VdbGrid.from_dense("color", color, lower=(-13, 5, 1003), transform=smoke),
        "flames": grid_of("flames", scattered_blobs(seed + 1, (20, 20, 20)), place),
    }


def both(grids: dict[str, VdbGrid], optics: Optics, patch: pytest.MonkeyPatch) -> tuple[Medium, Medium]:
    """The medium in one block and in bricks; its box is centred at the origin."""
    world = np.eye(4)
    box = grids["density"].world_bounds()
    assert box is not None
    world[:3, 3] = -box.mean(0)
    dense = build_medium(grids, optics, world)
    patch.setattr(lit_medium, "_DENSE_VOXELS", 0)
    sparse = build_medium(grids, optics, world)
    assert dense.bricks.dense and not sparse.bricks.dense
    assert sparse.values.nbytes < dense.values.nbytes
    return dense, sparse


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("eye", [(1.6, -1.2, 0.9), (0.02, 0.03, 0.01), (0.0, 0.0, 2.0)])
def test_images_are_the_same(seed: int, eye: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch) -> None:
    dense, sparse = both(fire(seed), dataclasses.replace(LOOK, anisotropy=0.4), monkeypatch)
    view = camera(eye, 40, up=(0.0, 1.0, 0.0))
    a, b = (
        LitMedium.of(m, LOOK.light, dataclasses.replace(LOOK, anisotropy=0.4)).render(view, 2) for m in (dense, sparse)
    )
    assert float(a[..., 3].max()) > 0.1
    assert torch.allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("seed", range(2))
def test_light_and_voxels_are_the_same(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    dense, sparse = both(fire(seed), LOOK, monkeypatch)
    a, b = (MediumVoxels.of(medium, lit=True) for medium in (dense, sparse))
    centers = [
        np.stack(np.unravel_index(v.index, v.shape), -1) @ m.scene_from_index[:3, :3].T + m.scene_from_index[:3, 3]
        for v, m in ((a, dense), (b, sparse))
    ]
    assert len(a.index) == len(b.index) and (np.diff(b.index) > 0).all()
    assert np.allclose(*centers, atol=1e-9) and np.allclose(a.values, b.values, rtol=1e-4, atol=1e-5)
    for medium, count in ((dense, 1), (sparse, len(sparse.bricks.origins))):
        assert len(medium.values) == count
    place = centers[0][len(centers[0]) // 2] + 0.003
    found = []
    for medium in (dense, sparse):
        where, places = medium.voxels(medium.values[..., 0] > 0)
        found.append((np.lexsort(where.round(6).T), point_transmittance(medium, place.tolist())[places]))
    assert np.allclose(found[0][1][found[0][0]], found[1][1][found[1][0]], rtol=1e-4, atol=1e-5)
    lattice = torch.diag(torch.tensor([0.021, 0.018, 0.02, 1.0], dtype=torch.float64))
    lattice[:3, 3] = -0.6
    for part in (False, True):
        sampled = [sample_extinction(medium, lattice, (60, 66, 60), part) for medium in (dense, sparse)]
        assert sampled[0].max() > 1 and np.allclose(*sampled, rtol=1e-4, atol=1e-5)


def test_tiles_are_filled(monkeypatch: pytest.MonkeyPatch) -> None:
    """A constant tile of 128 voxels, which reaches out of the box on one side, and a leaf far away."""
    leaf = VdbGrid.from_dense(
        "density", np.full((3, 2, 1), 0.5), lower=(300, 200, 7), transform=np.diag([1 / 300] * 3 + [1])
    )
    tiles = VdbTiles(
        np.array([[128, 0, 0], [304, 200, 8]], np.int32), np.array([128, 8], np.int32),
        np.array([0.01, 0.7], np.float32), np.array([True, False]),
    )  # fmt: skip
    dense, sparse = both(
        {"density": dataclasses.replace(leaf, tiles=tiles)}, Optics(ambient=(1.0, 0.5, 0.2)), monkeypatch
    )
    assert len(sparse.bricks.origins) < 17**3 + 8
    view = camera((1.3, 0.9, 1.1), 48)
    a, b = render_medium(dense, view), render_medium(sparse, view)
    assert float(a[..., 3].max()) > 0.01 and torch.allclose(a, b, rtol=1e-4, atol=1e-6)
    assert np.array_equal(MediumVoxels.of(dense).values, MediumVoxels.of(sparse).values)


@pytest.mark.parametrize("flame", [1.0, 0.0])
def test_flames_in_one_leaf_on_other_voxels(flame: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The flames have a single brick, or no active voxel."""
    grids = fire(0)
    place = grids["flames"].transform.copy()
    place[:3, 3] += place[:3, :3] @ [9.0, 9.0, 9.0]
    grids["flames"] = VdbGrid.from_dense("flames", np.full((4, 3, 2), flame), lower=(2, 3, 1), transform=place)
    dense, sparse = both(grids, LOOK, monkeypatch)
    a, b = (MediumVoxels.of(medium, lit=True) for medium in (dense, sparse))
    assert np.allclose(a.values, b.values, rtol=1e-4, atol=1e-5)


def test_a_grid_with_another_background_stays_dense(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lit_medium, "_DENSE_VOXELS", 0)
    grid = VdbGrid.from_dense("density", scattered_blobs(0, SHAPE), background=0.25)
    assert build_medium({"density": grid}, LOOK, np.eye(4)).bricks.dense


@pytest.mark.parametrize("edge", [1.0, 1.7])
@pytest.mark.parametrize("dense", [True, False])
def test_colours_are_the_background_where_none_are_stored(
    edge: float, dense: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """White is the background; on the same voxels and on others, in bricks and in one block."""
    if not dense:
        monkeypatch.setattr(lit_medium, "_DENSE_VOXELS", 0)
    density = VdbGrid.from_dense("density", scattered_blobs(0, SHAPE))
    black = np.zeros((8, 8, 8, 3), np.float32)
    place = vdb_scale_transform(edge, (0.0, 0.0, 0.0))
    color = VdbGrid.from_dense("color", black, transform=place, background=1.0)
    optics = Optics(color_grid="color", ambient=(1.0, 1.0, 1.0))
    for grid in (color, VdbGrid.from_dense("color", np.ones_like(black), transform=place, background=1.0)):
        medium = build_medium({"density": density, "color": grid}, optics, np.eye(4))
        assert medium.bricks.dense == dense
        values = medium.values.reshape(-1, 4)
        ratio = values[:, 1][values[:, 0] > 0] / values[:, 0][values[:, 0] > 0]
        assert (ratio > 0.999).mean() > 0.6 and (grid is not color or ratio.min() < 0.01)


def test_samples_are_the_background_where_none_is_stored() -> None:
    values = np.full((8, 8, 8), 300.0, np.float32)
    values[0, 0, 0] = 1500.0
    grid = VdbGrid.from_dense("temperature", values, background=300.0)
    points = np.array([[0.0, 0, 0], [4, 4, 4], [20, 0, 0], [-50, 9, 9]])
    np.testing.assert_array_equal(lit_medium.vdb_grid_sampler(grid)(points)[:, 0], [1500, 300, 300, 300])
    nowhere = VdbGrid.from_dense("temperature", np.full((8, 8, 8), 300.0, np.float32), background=300.0)
    np.testing.assert_array_equal(lit_medium.vdb_grid_sampler(nowhere)(points), np.full((4, 1), 300.0))


def test_refusals(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two far voxels: a box of 10^15 voxels; and more bricks than fit."""
    grid = VdbGrid.from_dense("density", np.ones((1, 1, 1)))
    far = dataclasses.replace(
        grid,
        origins=np.array([[0, 0, 0], [100_000, 100_000, 100_000]], np.int32),
        values=np.repeat(grid.values, 2, 0),
        masks=np.repeat(grid.masks, 2, 0),
    )
    write_vdb(tmp_path / "far.vdb", [far])
    (far,) = read_grids(tmp_path / "far.vdb")
    with pytest.raises(DataError, match=r"100009 x 100009 x 100009 voxels; expected at most 33554432 bricks"):
        build_medium({"density": far}, LOOK, np.eye(4))
    monkeypatch.setattr(lit_medium, "_DENSE_VOXELS", 0)
    monkeypatch.setattr(lit_medium, "DENSE_LIMIT", 9**3 * 16 * 20)
    with pytest.raises(DataError, match=r"grid 'density' has \d+ blocks of voxels that are not empty"):
        build_medium(fire(0), LOOK, np.eye(4))


def test_layout() -> None:
    used = bricks_with_voxels([np.array([[[8, 8, 8], [9, 9, 9]]])], np.array([24, 24, 24]))
    assert used.sum() == 8 and used[:2, :2, :2].all()  # the voxel is in the outer layer of seven bricks
    layout = Bricks.at(used)
    assert layout.shape == (25, 25, 25) and layout.table[2, 2, 2] == -1
    wide = np.zeros((5, 1, 1), bool)
    wide[0] = True
    assert Bricks.at(wide).table.ravel().tolist() == [0, -1, -9, -17, -25]
    assert (Bricks.at(np.zeros((2, 2, 2), bool)).table < 0).all()

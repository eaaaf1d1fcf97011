"""Starting points from PLY files: points, colours, and the Gaussians of 3D Gaussian splatting."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.lib.recfunctions
import pytest
import torch
from torch import Tensor

from neuprim.core.data.points_file import read_points
from neuprim.core.errors import DataError
from neuprim.core.io.ply import read_ply, write_ply
from neuprim.core.model import sh
from neuprim.core.model.cosine import CosineDensity, gaussian_support
from neuprim.core.model.edge import EDGES
from neuprim.core.model.primitives import Primitives
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.settings import ModelSettings
from neuprim.tasks.static import SphericalHarmonics
from tests.core import tiny


def fresh(path: Path | str, primitives: int = 50, edge: int = 0, **init: object) -> Primitives:
    settings = ModelSettings(primitives=primitives, init={"points": str(path), **init})
    return initial_model_to_train(
        CosineDensity(4, edge=edge), SphericalHarmonics(1), tiny.two_primitives(), settings, 0
    )


def splats(path: Path, **changes: float) -> Path:
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    rows = np.zeros(3, [(n, "<f4") for n in names])
    rows["x"], rows["y"], rows["z"] = [0.0, 1.0, 2.0], [0.5, 0.6, 0.7], [-1.0, 0.0, 1.0]
    rows["f_dc_0"], rows["opacity"] = 1.0, [0.0, 20.0, -20.0]
    rows["scale_0"], rows["scale_1"], rows["scale_2"] = math.log(0.1), math.log(0.2), math.log(0.3)
    rows["rot_0"] = rows["rot_3"] = 2.0  # a quarter turn about z
    for name, value in changes.items():
        rows[name][1] = value
    write_ply(path, rows)
    return path


def test_gaussians_give_places_colours_shapes_and_opacities(tmp_path: Path) -> None:
    model = fresh(splats(tmp_path / "g.ply"))
    assert torch.equal(model.params["means"], torch.tensor([[0.0, 0.5, -1.0], [1.0, 0.6, 0.0], [2.0, 0.7, 1.0]]))
    assert torch.allclose(model.params["sh_dc"][:, 0], torch.tensor(1.0), atol=1e-5)
    assert not bool(model.params["sh_rest"].any())


@pytest.mark.parametrize("edge", EDGES)
@pytest.mark.parametrize("volume", [False, True])
def test_the_footprint_is_the_closest_of_those_that_hide_as_much(edge: int, volume: bool) -> None:
    r = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000 * 6
    opacities = torch.tensor([0.02, 0.3, 0.8, 0.97], dtype=torch.float64)
    c, depth = gaussian_support(edge, opacities, volume)
    bell = (-r * r / 2).exp()
    for i, o in enumerate(opacities):
        target = 1 - torch.exp(torch.log1p(-o) * bell) if volume else o * bell

        def left(c: Tensor, target: Tensor = target, o: Tensor = o) -> tuple[Tensor, Tensor]:
            shape = (1 - (r / c).square()).clamp_min(0) ** (edge + 0.5)
            low, high = 0.0, 50.0
            for _ in range(60):
                middle = (low + high) / 2
                low, high = (
                    (middle, high) if ((1 - (-middle * shape).exp()) * r).sum() < (target * r).sum() else (low, middle)
                )
            return ((1 - (-low * shape).exp() - target).square() * r).sum(), torch.tensor(low)

        error, exact = left(c[i])
        assert float(depth[i]) == pytest.approx(float(exact), rel=5e-3)
        assert all(float(error) <= float(left(c[i] * f)[0]) * 1.001 for f in (0.9, 0.97, 1.03, 1.1))
    assert bool((c[0] > 1.9) & (c[0] < 2.9)), "well inside what is searched"


@pytest.mark.parametrize("form", ["bytes", "floats", "large floats", "ints", "ushorts", "ascii", "none"])
def test_plain_clouds(tmp_path: Path, form: str) -> None:
    path = tmp_path / "p.ply"
    if form == "ascii":
        head = (
            "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar "
            "green\nproperty uchar blue\n"
        )
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex 2\n{head}end_header\n0 0 0 51 102 255\n1 2 3 51 102 255\n"
        )
    else:
        floats = [(c, "<f4") for c in ("red", "green", "blue")]
        kind = {"floats": floats, "large floats": floats}
        for name, code in (("bytes", "u1"), ("ints", "<i4"), ("ushorts", "<u2")):
            kind[name] = [(c, code) for c in ("red", "green", "blue")]
        rows = np.zeros(2, [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), *kind.get(form, [])])
        rows["x"], rows["y"], rows["z"] = [0, 1], [0, 2], [0, 3]
        for name, value in zip(("red", "green", "blue"), (51, 102, 255), strict=True):
            if form in kind:
                rows[name] = value / 255 if form == "floats" else value
        write_ply(path, rows)
    cloud = read_points(path, 3, "srgb")
    assert cloud.means.tolist() == [[0, 0, 0], [1, 2, 3]] and cloud.axes is cloud.alphas is cloud.deviations is None
    expected = [0.5, 0.5, 0.5] if form == "none" else [0.2, 0.4, 1.0]
    assert torch.allclose(cloud.colors, torch.tensor(expected), atol=1e-6)
    linear = read_points(path, 3, "linear").colors
    assert torch.allclose(linear[:, 1], torch.tensor(0.214041 if form == "none" else 0.132868), atol=1e-4)
    model = fresh(path)
    assert torch.allclose(model.params["sh_dc"] * sh.C0 + 0.5, torch.tensor(expected), atol=1e-3)
    assert model.count == 2
    assert torch.allclose(model.params["log_scales"].exp(), torch.tensor(math.sqrt(14.0)), rtol=1e-5)


def test_the_filter_of_mip_splatting_is_applied(tmp_path: Path) -> None:
    rows = read_ply(splats(tmp_path / "g.ply")).rows
    filtered = numpy.lib.recfunctions.append_fields(rows, "filter_3D", np.array([0.0, 0.1, 0.1]), "<f4", usemask=False)
    write_ply(tmp_path / "f.ply", filtered)
    plain, found = (read_points(tmp_path / name, 3, "srgb") for name in ("g.ply", "f.ply"))
    for cloud in (plain, found):
        assert cloud.deviations is not None and cloud.alphas is not None
    wide = torch.tensor([0.1, 0.2, 0.3]).square().add(0.01).sqrt()
    torch.testing.assert_close(found.deviations, torch.stack([torch.tensor([0.1, 0.2, 0.3]), wide, wide]))  # type: ignore[arg-type]
    share = float(torch.tensor([0.1, 0.2, 0.3]).prod() / wide.prod())
    torch.testing.assert_close(found.alphas, plain.alphas * torch.tensor([1.0, share, share]))  # type: ignore[operator]


def test_anchors_of_scaffold_are_no_gaussians(tmp_path: Path) -> None:
    rows = np.zeros(2, [(name, "<f4") for name in ("x", "y", "z", "f_anchor_feat_0", "scale_0")])
    write_ply(tmp_path / "a.ply", rows)
    with pytest.raises(DataError, match=r"a\.ply: anchors of Scaffold-GS .*; expected Gaussians or points"):
        read_points(tmp_path / "a.ply", 3, "srgb")


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("position", {"x": math.nan}),
        ("position", {"y": 4e7}),
        ("position", {"z": -math.inf}),
        ("colour", {"f_dc_1": math.inf}),
        ("size", {"scale_0": 1e5}),
        ("size", {"scale_2": math.nan}),
        ("size", {"scale_0": -math.inf, "scale_1": -90.0, "scale_2": -math.inf}),
        ("rotation", {"rot_0": 0.0, "rot_3": 0.0}),
        ("rotation", {"rot_2": math.nan}),
        ("opacity", {"opacity": math.nan}),
    ],
)
def test_rows_that_are_no_points_are_left_out_and_counted(tmp_path: Path, what: str, changes: dict[str, float]) -> None:
    path = splats(tmp_path / "g.ply", **changes)
    with pytest.warns(match=rf"g\.ply: 1 of 3 vertices are not usable as points \(1 with bad {what}, e.g. vertex 1\)"):
        cloud = read_points(path, 3, "srgb")
    assert cloud.means.tolist() == [[0, 0.5, -1], [2, float(np.float32(0.7)), 1]] and fresh(path).count == 2
    rows = read_ply(path).rows
    write_ply(path, rows[[1]])
    if changes != {"y": 4e7}:  # alone it is not far from anything
        with pytest.raises(DataError, match="1 of 1 vertices are not usable as points"):
            read_points(path, 3, "srgb")


def test_discs_are_flat_along_their_third_axis_and_balls_are_round(tmp_path: Path) -> None:
    path = splats(tmp_path / "g.ply")
    rows = read_ply(path).rows
    discs = rows[[n for n in rows.dtype.names or () if n != "scale_2"]]
    write_ply(tmp_path / "discs.ply", np.lib.recfunctions.repack_fields(discs))
    cloud = read_points(tmp_path / "discs.ply", 3, "srgb")
    assert cloud.deviations is not None
    assert torch.allclose(cloud.deviations, torch.tensor([0.1, 0.2, 0.01]).expand(3, 3))
    assert torch.equal(cloud.quats, read_points(path, 3, "srgb").quats)
    flat_scale, round_scale = (
        fresh(tmp_path / "discs.ply").geometry.scales.max(),
        fresh(path).geometry.scales[:, 1].max(),
    )
    assert float(flat_scale / round_scale) == pytest.approx(1, rel=1e-5)
    flat = read_points(splats(tmp_path / "flat.ply", scale_1=-math.inf), 3, "srgb").deviations
    assert flat is not None and torch.allclose(flat[1], torch.tensor([0.1, 0.01, 0.3]))
    balls = rows[[n for n in rows.dtype.names or () if n not in ("scale_1", "scale_2") and "rot" not in n]]
    write_ply(tmp_path / "balls.ply", np.lib.recfunctions.repack_fields(balls))
    found = read_points(tmp_path / "balls.ply", 3, "srgb").deviations
    assert found is not None and torch.allclose(found, torch.tensor(0.1))
    bare = rows[[n for n in rows.dtype.names or () if n != "rot_2"]]
    write_ply(tmp_path / "bare.ply", np.lib.recfunctions.repack_fields(bare))
    with pytest.warns(match="has scale_0, scale_1, scale_2, but no rot_2; its sizes are ignored"):
        assert read_points(tmp_path / "bare.ply", 3, "srgb").deviations is None


@pytest.mark.parametrize("name", ["a.splat", "a.KSPLAT", "a.sog", "a.lcc", "a.compressed.ply"])
def test_compressed_formats_are_named_with_what_to_do(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    head = "element chunk 1\nproperty float min_x\nelement vertex 1\nproperty uint packed_position\nend_header\n"
    path.write_bytes(f"ply\nformat binary_little_endian 1.0\n{head}".encode() + bytes(8))
    with pytest.raises(
        DataError, match=r"is not supported; expected an uncompressed PLY or SPZ. Convert it with SuperSplat"
    ):
        fresh(path)

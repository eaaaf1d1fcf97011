"""SPZ files: written ones read by gsply, those of gsply read by neuprim, older versions, and damaged ones."""

from __future__ import annotations

import gzip
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from scipy.spatial.transform import Rotation

from neuprim.core.data.points_file import read_points
from neuprim.core.errors import DataError
from neuprim.core.io.spz import SpzGaussians, decode_spz, encode_spz, read_spz

gsply = pytest.importorskip("gsply", reason="needs gsply: pip install gsply")


def gaussians(count: int = 200, degree: int = 3, reach: float = 5.0) -> SpzGaussians:
    rng = np.random.default_rng(count + degree)
    quats = Rotation.random(count, rng=rng).as_quat()[:, [3, 0, 1, 2]]
    return SpzGaussians(
        rng.uniform(-reach, reach, (count, 3)),
        rng.uniform(-9, 5, (count, 3)),
        quats,
        rng.uniform(0, 1, count),
        rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3)),
    )


def assert_close(found: SpzGaussians, wanted: SpzGaussians, step: float) -> None:
    """Equal up to the rounding of the format; ``step`` is that of coordinates."""
    np.testing.assert_allclose(found.means, wanted.means, atol=0.501 * step)
    np.testing.assert_allclose(found.log_scales, wanted.log_scales, atol=0.501 / 16)
    np.testing.assert_allclose(np.abs((found.quats * wanted.quats).sum(1)), 1, atol=1e-5)
    np.testing.assert_allclose(found.opacities, wanted.opacities, atol=0.501 / 255)
    np.testing.assert_allclose(found.harmonics[:, 0], wanted.harmonics[:, 0], atol=0.501 / (0.15 * 255))
    np.testing.assert_allclose(found.harmonics[:, 1:], wanted.harmonics[:, 1:], atol=0.501 / 128)


def of_gsply(data: Any) -> SpzGaussians:
    own = [data.sh0[:, None]] + ([] if data.shN is None else [data.shN])
    opacities = 1 / (1 + np.exp(-data.opacities.astype(np.float64).reshape(-1)))
    return SpzGaussians(data.means, data.scales, data.quats, opacities, np.concatenate(own, 1).astype(np.float64))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_another_reader_reads_the_same(tmp_path: Path, degree: int) -> None:
    wanted = gaussians(degree=degree)
    (tmp_path / "g.spz").write_bytes(encode_spz(wanted))
    read = of_gsply(gsply.spz.read_spz(tmp_path / "g.spz"))
    assert_close(read, wanted, 2.0**-20)  # 5 x 2^20 fits 24 bits, 5 x 2^21 does not
    assert_close(read_spz(tmp_path / "g.spz"), wanted, 2.0**-20)


@pytest.mark.parametrize("version", [3, 4])
def test_files_of_another_writer(tmp_path: Path, version: int) -> None:
    wanted = gaussians()
    plain = {"means": wanted.means, "scales": wanted.log_scales, "quats": wanted.quats}
    logits = np.log(wanted.opacities / (1 - wanted.opacities))
    own = {**plain, "opacities": logits, "sh0": wanted.harmonics[:, 0], "shN": wanted.harmonics[:, 1:]}
    data = gsply.GSData.from_arrays(**{n: v.astype(np.float32) for n, v in own.items()}, format="ply")
    gsply.spz.write_spz(tmp_path / "g.spz", data, version=version)
    assert_close(read_spz(tmp_path / "g.spz"), wanted, 2.0**-12)


def legacy(version: int, parts: list[bytes], count: int = 1, degree: int = 0, bits: int = 8) -> bytes:
    return gzip.compress(
        struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, bits, 0, 0) + b"".join(parts), mtime=0
    )


def test_versions_1_and_2_by_hand() -> None:
    rest = [bytes([51]), bytes([255, 0, 127]), bytes([160, 176, 144]), bytes([255, 127, 128])]
    halves = np.array([1.5, -2.25, 100], "<f2").tobytes()
    fixed = b"".join(int(value * 256).to_bytes(3, "little", signed=True) for value in (1.5, -2.25, 100))
    for version, places in ((1, halves), (2, fixed)):
        found = decode_spz(legacy(version, [places, *rest]), "g.spz")
        np.testing.assert_array_equal(found.means, [[1.5, -2.25, 100]])
        np.testing.assert_allclose(found.opacities, [0.2])
        np.testing.assert_allclose(found.harmonics, [[[1 / 0.3, -1 / 0.3, -0.5 / 38.25]]])
        np.testing.assert_allclose(found.log_scales, [[0, 1, -1]])
        np.testing.assert_allclose(found.quats, [[0, 1, -0.5 / 127.5, 0.5 / 127.5]], atol=1e-8)


def test_values_outside_the_ranges_become_the_nearest_ones() -> None:
    extreme = SpzGaussians(
        np.array([[0.0, 5e5, -5e5]]), np.array([[-30.0, 30, 0]]), np.array([[-1.0, 0, 0, 0]]), np.array([1.0]),
        np.array([[[9.0, -9, 0]], [[3.0, -3, 0]]]).reshape(1, 2, 3).repeat(2, 1),
    )  # fmt: skip
    found = decode_spz(encode_spz(extreme), "g.spz")
    np.testing.assert_array_equal(found.means, extreme.means)
    np.testing.assert_allclose(found.log_scales, [[-10, 255 / 16 - 10, 0]])
    np.testing.assert_allclose(np.abs(found.quats), [[1, 0, 0, 0]])
    np.testing.assert_allclose(found.harmonics[0, 0], [1 / 0.3, -1 / 0.3, 0], atol=0.02)
    np.testing.assert_allclose(found.harmonics[0, 1], [127 / 128, -1, 0], atol=0.3)
    with pytest.raises(ValueError, match=r"a coordinate is 600000; expected at most 524287\.9"):
        encode_spz(SpzGaussians(np.array([[6e5, 0, 0]]), *(getattr(extreme, n) for n in list(vars(extreme))[1:])))


def test_harmonics_that_are_zero_are_not_stored() -> None:
    some = gaussians(degree=3)
    some.harmonics[:, 4:] = 0
    assert decode_spz(encode_spz(some), "g.spz").harmonics.shape == (200, 4, 3)
    some.harmonics[:, 1:] = 0
    assert decode_spz(encode_spz(some), "g.spz").harmonics.shape == (200, 1, 3)


def test_starting_points_are_those_of_the_ply_that_other_tools_write(tmp_path: Path) -> None:
    wanted = gaussians()
    (tmp_path / "g.SPZ").write_bytes(encode_spz(wanted))
    found = read_points(tmp_path / "g.SPZ", 3, "srgb")
    assert found.deviations is not None and found.quats is not None and found.alphas is not None
    np.testing.assert_allclose(found.means, wanted.means * [1, -1, -1], atol=1e-6)
    np.testing.assert_allclose(found.deviations, np.exp(wanted.log_scales), rtol=0.04)
    sides = np.diag([1.0, -1, -1]) @ Rotation.from_quat(wanted.quats[:, [1, 2, 3, 0]]).as_matrix()
    read = Rotation.from_quat(found.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(np.abs((read * sides).sum(1)), 1, atol=1e-4)  # the same axes, maybe reversed
    np.testing.assert_allclose(found.alphas, wanted.opacities, atol=0.003)


HEADER = struct.Struct("<IIIBBBBI12x")


def changed(**fields: int) -> bytes:
    data = encode_spz(gaussians())
    names = ("magic", "version", "count", "degree", "bits", "flags", "streams", "table")
    values = dict(zip(names, HEADER.unpack_from(data), strict=True)) | fields
    return HEADER.pack(*values.values()) + data[HEADER.size :]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", r"0 bytes; expected the header of an SPZ file"),
        (b"ply\n" + bytes(40), r"starts with b'ply\\n'; expected an SPZ file"),
        (changed(version=5), r"version 5, spherical harmonics of degree 3, 20 fraction bits; expected version 4"),
        (changed(degree=5), r"version 4, spherical harmonics of degree 5, .*; expected version 4, at most degree 4"),
        (changed(bits=25), r"version 4, .*, 25 fraction bits; expected"),
        (changed(count=2**32 - 1), r"the header claims 4294967295 Gaussians in a file of \d+ bytes; expected at most"),
        (changed(count=201), r"stream 0 has \d+ bytes at 128 for 1800; expected 1809, inside the file"),
        (changed(streams=5), r"5 streams, listed at byte 32 of \d+; expected 6 streams and their list inside the file"),
        (changed(table=8), r"6 streams, listed at byte 8 "),
        (changed(table=2**32 - 1), r"6 streams, listed at byte 4294967295 "),
        (encode_spz(gaussians())[:-9], r"stream 5 has \d+ bytes at \d+ for 9000; expected 9000, inside the file"),
        (legacy(2, [bytes(18)]), r"18 bytes of attributes; expected 19 for 1 Gaussians"),
        (legacy(4, [bytes(40)]), r"version 4, .*; expected version 1 or 2 or 3"),
        (legacy(3, [bytes(40)], count=10**9), r"the header claims 1000000000 Gaussians"),
        (legacy(3, [bytes(20)])[:-9], r"the gzip stream has \d+ bytes, and then no end; expected a complete SPZ file"),
        (gzip.compress(bytes(4), mtime=0), r"the gzip stream has 4 bytes; expected a complete SPZ file"),
        (b"\x1f\x8b" + bytes(30), r"the gzip stream is damaged"),
    ],
    ids=lambda value: value if isinstance(value, str) else "file",
)  # fmt: skip
def test_damaged_files_are_one_line(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "g.spz").write_bytes(data)
    with pytest.raises(DataError, match=rf"g\.spz: {message}"):
        read_points(tmp_path / "g.spz", 3, "srgb")


def test_a_small_file_cannot_fill_the_memory(tmp_path: Path) -> None:
    """Streams that expand to far more than the header says, and a header that says more than a file can hold."""
    bomb = zstandard.ZstdCompressor(level=19).compress(bytes(2**30))
    good = zstandard.ZstdCompressor().compress(bytes(4))
    sizes = [9, 1, 3, 3, 4]
    table = b"".join(struct.pack("<QQ", len(bomb if i == 0 else good), size) for i, size in enumerate(sizes))
    (tmp_path / "g.spz").write_bytes(HEADER.pack(0x5053474E, 4, 1, 0, 12, 0, 5, 32) + table + bomb + 4 * good)
    zeros = gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 10**7, 0, 12, 0, 0) + bytes(2 * 10**8))
    (tmp_path / "old.spz").write_bytes(zeros)
    tracemalloc.start()
    with pytest.raises(DataError, match="stream 0 expands to another size than 9"):
        read_spz(tmp_path / "g.spz")
    with pytest.raises(DataError, match="and then no end; expected a complete SPZ file with at most"):
        read_spz(tmp_path / "old.spz")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 * 2**20

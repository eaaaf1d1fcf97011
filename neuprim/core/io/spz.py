"""Read and write SPZ, Niantic's compressed format of 3D Gaussians (github.com/nianticlabs/spz).

Versions 1 to 3 are one gzip stream; version 4 has one zstd stream per attribute. Version 4 is written. A file that
expands to more than :data:`_MOST_EXPANSION` times its size is refused, whatever the header claims.

By convention, tools that convert a PLY file of Gaussians to SPZ negate y and z (:data:`SPZ_FROM_DATA`): the axes of SPZ
files are RUB (x right, y up, z back), those of PLY files from COLMAP data are RDF (y down, z forward).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard

from neuprim.core.errors import DataError

SPZ_FROM_DATA = np.diag([1.0, -1.0, -1.0, 1.0])
"""(4, 4) half turn around x, from the axes of a PLY file to those of an SPZ file and back."""

_MAGIC = 0x5053474E
_HEADER, _OLD_HEADER, _ENTRY = struct.Struct("<IIIBBBBI12x"), struct.Struct("<IIIBBBB"), struct.Struct("<QQ")
_COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16, 4: 25}  # spherical harmonics of each degree
_MOST_EXPANSION = 30  # usual files expand by less than 10
_FRACTION_BITS = range(4, 24)  # that the reference implementation writes
_LARGEST = 2**23 - 1  # of the 24 bits of a coordinate
_SCALE_STEPS, _SMALLEST_LOG = 16.0, -10.0
_COLOR_SCALE = 0.15 * 255.0
_QUATERNION_STEPS = 511.0
_LEVEL = 12  # of zstd, as in the reference implementation


@dataclass(frozen=True)
class SpzGaussians:
    """N Gaussians as in a file; float64 arrays.

    Attributes:
        means: (N, 3) centres.
        log_scales: (N, 3) natural logarithms of the standard deviations.
        quats: (N, 4) unit quaternions wxyz of the axes.
        opacities: (N,) alpha at the centre, 0..1.
        harmonics: (N, B, 3) RGB coefficients of spherical harmonics of degrees 0 to 0, 1, 2, 3 or 4, in the convention
            of 3D Gaussian splatting.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quats: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray


def encode_spz(gaussians: SpzGaussians) -> bytes:
    """Return the bytes of an SPZ file, version 4, with as many bits after the point as the coordinates allow.

    Sizes, colours and harmonics outside the format's ranges are limited to these ranges. Harmonics whose higher degrees
    are 0 are stored with a lower degree.

    Raises:
        ValueError: coordinates are too large for the format.
    """
    count, harmonics = len(gaussians.means), gaussians.harmonics
    used = np.flatnonzero(np.abs(harmonics).max((0, 2), initial=0.0))
    degree = next(d for d, bands in _COEFFICIENTS.items() if bands > used.max(initial=0))
    farthest = float(np.abs(gaussians.means).max(initial=0.0))
    fitting = [bits for bits in _FRACTION_BITS if round(farthest * 2**bits) <= _LARGEST]
    if not fitting:
        raise ValueError(f"a coordinate is {farthest:.7g}; expected at most {_LARGEST / 2 ** _FRACTION_BITS[0]:.7g}")
    fixed = np.round(gaussians.means * 2.0 ** fitting[-1]).astype("<i4")
    streams = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],
        _round_bytes(gaussians.opacities * 255.0),
        _round_bytes(harmonics[:, 0] * _COLOR_SCALE + 127.5),
        _round_bytes((gaussians.log_scales - _SMALLEST_LOG) * _SCALE_STEPS),
        _pack_quaternions(gaussians.quats),
    ]
    if degree:
        streams.append(_round_bytes(harmonics[:, 1 : _COEFFICIENTS[degree]] * 128.0 + 128.0))
    plain = [np.ascontiguousarray(stream).tobytes() for stream in streams]
    packed = [zstandard.ZstdCompressor(level=_LEVEL).compress(stream) for stream in plain]
    sizes = b"".join(_ENTRY.pack(len(short), len(full)) for short, full in zip(packed, plain, strict=True))
    header = _HEADER.pack(_MAGIC, 4, count, degree, fitting[-1], 0, len(streams), _HEADER.size)
    return header + sizes + b"".join(packed)


def _round_bytes(values: np.ndarray) -> np.ndarray:
    rounded: np.ndarray = np.clip(np.round(values), 0, 255).astype(np.uint8)
    return rounded


def _pack_quaternions(quats: np.ndarray) -> np.ndarray:
    """Return (N,) uint32: the index of the largest component of xyzw, and 10 bits for each of the others."""
    xyzw = quats[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1.0, 1.0)
    steps = np.minimum(np.round(np.abs(xyzw) * 2**0.5 * _QUATERNION_STEPS), _QUATERNION_STEPS).astype(np.uint32)
    packed = np.zeros(len(quats), np.uint32)
    for axis in range(4):
        own = (packed << 10) | (np.signbit(xyzw[:, axis]).astype(np.uint32) << 9) | steps[:, axis]
        packed = np.where(largest == axis, packed, own)
    return (packed | (largest.astype(np.uint32) << 30)).astype("<u4")


def read_spz(path: Path, degree: int = 4) -> SpzGaussians:
    """Read an SPZ file of version 1 to 4; spherical harmonics above ``degree`` are left out.

    Raises:
        DataError: the file cannot be read, is damaged, or expands too much.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}); expected an SPZ file") from None
    return decode_spz(data, str(path), degree)


def decode_spz(data: bytes, where: str, most_degree: int = 4) -> SpzGaussians:
    """Return the Gaussians in the bytes of an SPZ file; see :func:`read_spz`. ``where`` names the file in errors."""
    most = max(_MOST_EXPANSION * len(data), 2**16)
    old = data[:2] == b"\x1f\x8b"
    if old:
        unzip = zlib.decompressobj(31)
        try:
            body = unzip.decompress(data, most + 1)
        except zlib.error as error:
            raise DataError(f"{where}: the gzip stream is damaged ({error}); expected an SPZ file") from None
        if not unzip.eof or len(body) < _OLD_HEADER.size:
            found = f"the gzip stream has {len(body)} bytes" + ("" if unzip.eof else ", and then no end")
            raise DataError(f"{where}: {found}; expected a complete SPZ file with at most {most} bytes")
        magic, version, count, degree, bits, _, _ = _OLD_HEADER.unpack_from(body)
    elif len(data) < _HEADER.size:
        raise DataError(f"{where}: {len(data)} bytes; expected the header of an SPZ file")
    else:
        magic, version, count, degree, bits, _, streams, table = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise DataError(f"{where}: starts with {data[:4]!r}; expected an SPZ file")
    versions = (1, 2, 3) if old else (4,)
    if version not in versions or degree not in _COEFFICIENTS or bits > 24:
        found = f"version {version}, spherical harmonics of degree {degree}, {bits} fraction bits"
        expected = f"version {' or '.join(map(str, versions))}, at most degree 4 and 24 bits"
        raise DataError(f"{where}: {found}; expected {expected}")
    widths = [6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * (_COEFFICIENTS[degree] - 1)]
    if count * sum(widths) > most:
        found = f"the header claims {count} Gaussians in a file of {len(data)} bytes"
        raise DataError(f"{where}: {found}; expected at most {most // sum(widths)}")
    if old:
        parts = _split_gzip_body(body[_OLD_HEADER.size :], count, widths, where)
    else:
        parts = _read_zstd_streams(data, [width for width in widths if width], (count, streams, table), where)
    return _unpack_gaussians(parts, version, bits, min(degree, most_degree))


def _split_gzip_body(body: bytes, count: int, widths: list[int], where: str) -> list[np.ndarray]:
    """Return the (N, width) bytes of each attribute from the decompressed bytes of versions 1 to 3."""
    if len(body) < count * sum(widths):  # more is an extension
        found = f"{len(body)} bytes of attributes"
        raise DataError(f"{where}: {found}; expected {count * sum(widths)} for {count} Gaussians")
    ends = np.cumsum([count * width for width in widths])
    plain = np.split(np.frombuffer(body, np.uint8), ends)
    return [part.reshape(count, width) for part, width in zip(plain, widths, strict=False) if width]


def _read_zstd_streams(data: bytes, widths: list[int], header: tuple[int, int, int], where: str) -> list[np.ndarray]:
    """Return the (N, width) bytes of each attribute of version 4; ``header`` is N, number of streams and table."""
    count, streams, table = header
    if streams != len(widths) or not _HEADER.size <= table <= len(data) - streams * _ENTRY.size:
        found = f"{streams} streams, listed at byte {table} of {len(data)}"
        raise DataError(f"{where}: {found}; expected {len(widths)} streams and their list inside the file")
    parts, at = list[np.ndarray](), table + streams * _ENTRY.size
    for i, width in enumerate(widths):
        short, full = _ENTRY.unpack_from(data, table + i * _ENTRY.size)
        if full != count * width or short > len(data) - at:
            found = f"stream {i} has {short} bytes at {at} for {full}"
            raise DataError(f"{where}: {found}; expected {count * width}, inside the file of {len(data)} bytes")
        try:
            with zstandard.ZstdDecompressor().stream_reader(data[at : at + short]) as reader:
                plain = reader.read(full + 1)
        except zstandard.ZstdError as error:
            raise DataError(f"{where}: stream {i} is damaged ({error}); expected zstd data") from None
        if len(plain) != full:
            raise DataError(f"{where}: stream {i} expands to another size than {full}; expected an undamaged file")
        parts.append(np.frombuffer(plain, np.uint8).reshape(count, width))
        at += short
    return parts


def _unpack_gaussians(parts: list[np.ndarray], version: int, bits: int, degree: int) -> SpzGaussians:
    places, opacities, colours, scales, quats = parts[:5]
    if version == 1:
        means = np.ascontiguousarray(places).view("<f2").astype(np.float64)
    else:
        padded = np.zeros((places.size // 3, 4), np.uint8)
        padded[:, 1:] = places.reshape(-1, 3)  # the sign is in the highest byte
        means = (padded.view("<i4")[:, 0] >> 8).reshape(-1, 3) / 2.0**bits
    harmonics = [(colours[:, None] - 127.5) / _COLOR_SCALE]
    if degree:
        stored = parts[5].reshape(len(means), -1, 3)[:, : _COEFFICIENTS[degree] - 1]
        harmonics.append((stored - 128.0) / 128.0)
    return SpzGaussians(
        means,
        scales / _SCALE_STEPS + _SMALLEST_LOG,
        _unpack_quaternions(quats) if version >= 3 else _unpack_old_quaternions(quats),
        opacities[:, 0] / 255.0,
        np.concatenate(harmonics, 1),
    )


def _unpack_quaternions(packed: np.ndarray) -> np.ndarray:
    """Return (N, 4) quaternions wxyz, the inverse of :func:`_pack_quaternions`."""
    bits = np.ascontiguousarray(packed).view("<u4")[:, 0]
    largest, xyzw = bits >> 30, np.zeros((len(bits), 4))
    for axis in (3, 2, 1, 0):
        steps = (bits & 511) * np.where(bits & 512, -1.0, 1.0)
        stored = largest != axis
        xyzw[:, axis] = np.where(stored, steps / (2**0.5 * _QUATERNION_STEPS), 0.0)
        bits = np.where(stored, bits >> 10, bits)
    rest = np.sqrt(np.maximum(1.0 - np.square(xyzw).sum(1), 0.0))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), rest[:, None], 1)
    return xyzw[:, [3, 0, 1, 2]]


def _unpack_old_quaternions(packed: np.ndarray) -> np.ndarray:
    """Return (N, 4) quaternions wxyz of versions 1 and 2, which store x, y and z."""
    xyz = packed / 127.5 - 1.0
    return np.concatenate([np.sqrt(np.maximum(1.0 - np.square(xyz).sum(1, keepdims=True), 0.0)), xyz], 1)

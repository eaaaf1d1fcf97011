"""The file byte by byte: as the documentation says, and refused by name where it is anything else."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from neuprim.core import checkpoint
from neuprim.core.compression.file import CONFIG, is_compressed, write_compressed
from neuprim.core.compression.quantizers import LEVELS
from neuprim.core.compression.sections import CompressedSection
from neuprim.core.errors import CheckpointError
from neuprim.tasks.static import TASK
from tests.compressing import FIELDS, example
from tests.systems import posix

CONFIG_TEXT = "task: static\nnote: naïve\n"


def refused(path: Path, *words: str) -> str:
    """The message with which a file is refused, of one line; within a second of computing, whatever else the machine
    does."""
    start = time.thread_time()
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load_model_checkpoint(path, TASK)
    assert time.thread_time() - start < 1.0
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    assert all(word in message for word in words), message
    return message


# ---------------------------------------------------------------- another reader, and another writer, from
# docs/data_formats.md alone


def table_rows(table: bytes, sections: int) -> list[dict[str, Any]]:
    rows, at = [], 0
    for _ in range(sections):
        length = table[at]
        name = table[at + 1 : at + 1 + length].decode()
        at += 1 + length
        coding, packing, dimensions = table[at : at + 3]
        shape = struct.unpack_from(f"<{dimensions}I", table, at + 3)
        at += 3 + 4 * dimensions
        numbers = (coding, packing, shape, *struct.unpack_from("<QQI", table, at))
        at += 20
        keys = ("name", "coding", "packing", "shape", "planes", "size", "crc")
        rows.append(dict(zip(keys, (name, *numbers), strict=True)))
    assert at == len(table)
    return rows


def read_by_the_book(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    assert data[:8] == bytes.fromhex("894E45555052494D")
    version, sections, count, header_size, table_size, crc = struct.unpack_from("<IIQIII", data, 8)
    body = 36 + header_size
    assert version == 1 and crc == zlib.crc32(data[8:32] + data[36 : body + table_size])
    header, at, text = json.loads(data[36:body]), body + table_size, ""
    found: dict[str, np.ndarray] = {}
    masks: list[list[int]] = []
    for row in table_rows(data[body:at], sections):
        part, at = data[at : at + row["size"]], at + row["size"]
        assert zlib.crc32(part) == row["crc"]
        columns = math.prod(row["shape"])
        split = {0: 0, 1: 9 * columns, 2: 27, 3: 1, 4: 0, 5: 11 * columns}[row["coding"]]
        head, packed = part[:split], part[split:]
        content = zstandard.ZstdDecompressor().decompress(packed) if row["packing"] else packed
        assert len(content) == row["planes"]
        if row["coding"] == 0:
            text = content.decode()
            continue
        if row["coding"] == 4:
            width = -(-count // 8)
            for k in range(columns):
                mask = content[k * width : (k + 1) * width]
                masks.append([n for n in range(count) if mask[n // 8] >> n % 8 & 1])
            continue
        stream = io.BytesIO(content)

        def codes(bits: int, rows: int = count, stream: io.BytesIO = stream) -> np.ndarray:
            planes = [np.frombuffer(stream.read(rows), np.uint8).astype(object) for _ in range(-(-bits // 8))]
            return sum(plane * 256**i for i, plane in enumerate(planes))  # type: ignore[return-value]

        if row["coding"] == 3:
            h = 2 ** (head[0] - 1) - 1
            g, *others = (codes(b) for b in (2, head[0], head[0], head[0]))
            values = np.zeros((count, 4))
            for n in range(count):
                u = [int(c[n]) - h for c in others]
                q = [x / math.sqrt(2 * h * h) for x in u]
                q.insert(int(g[n]), math.sqrt(max(2 * h * h - sum(x * x for x in u), 0)) / math.sqrt(2 * h * h))
                values[n] = q
        else:
            records = [struct.unpack_from("<Bff", head, 9 * i) for i in range(columns)]
            mask_of = struct.unpack_from(f"<{columns}H", head, 9 * columns) if row["coding"] == 5 else [0] * columns
            own = [masks[k - 1] if k else list(range(count)) for k in mask_of]
            if row["coding"] == 2:
                b = records[0][0]
                keys = np.cumsum(codes(3 * b))
                bits = [(i, 1 << i) for i in range(b)]
                cells = [
                    np.array([sum(bit for i, bit in bits if int(k) >> 3 * i + a & 1) for k in keys]) for a in range(3)
                ]
            else:
                cells = [codes(b, len(rows)) for (b, _, _), rows in zip(records, own, strict=True)]
            values = np.zeros((count, columns))
            for j, (b, low, high) in enumerate(records):
                m = 2**b - 1
                values[own[j], j] = [(low * (m - int(c)) + high * int(c)) / m for c in cells[j]]
        found[row["name"]] = values.astype(np.float32).reshape(count, *row["shape"])
    assert at == len(data)
    return header, found, text


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", FIELDS)
def test_the_documentation_is_all_that_a_reader_needs(tmp_path: Path, name: str, level: int) -> None:
    task, model = example(name, 25)
    checkpoint.save_compressed(tmp_path / "m", model, task.name, {"note": "naïve"}, LEVELS[level], CONFIG_TEXT)
    header, found, text = read_by_the_book((tmp_path / "m").read_bytes())
    again, wanted = checkpoint.load_model_checkpoint(tmp_path / "m", task)
    assert header == wanted and text == CONFIG_TEXT == checkpoint.checkpoint_config(tmp_path / "m")
    assert found.keys() == again.params.keys()
    for key, value in again.params.items():
        assert found[key].tobytes() == value.numpy().tobytes(), key


def by_hand(**changes: Any) -> bytes:
    """A model of two primitives without neurons, written from the page: see the comments."""
    # means: 2 bits; codes (0, 1, 2) and (3, 3, 3): key 0 has bit 1 (y) and bit 5 (z, second), 34; key 1 all six, 63;
    # steps 34, 29
    record = lambda bits, low, high: struct.pack("<Bff", bits, low, high)  # noqa: E731
    constant = record(1, 0.5, 0.5)
    sections = {
        "means": (2, (3,), record(2, -1, 2) * 3, bytes([34, 29])),
        "log_scales": (1, (3,), record(8, -2.0, -1.0) + record(4, -3.0, 0.0) + constant, bytes([0, 255, 5, 15, 0, 1])),
        "quats": (
            3,
            (4,),
            bytes([3]),
            bytes([0, 3, 3, 6, 3, 3, 3, 0]),
        ),  # h = 3: no turn; u = (3, 0, -3) before z, which is 0
        "W1": (1, (0, 3), b"", b""),
        "b1": (1, (0,), b"", b""),
        "w2": (1, (0,), b"", b""),
        "b2": (1, (1,), record(12, 0.0, 4095.0), bytes([0x02, 0xFF, 0x01, 0x0F])),  # 258 and 4095
        "sh_dc": (1, (3,), constant * 3, bytes(6)),
        **changes.pop("sections", {}),
    }
    sections = {**changes.pop("first", {}), **sections}
    header = {
        "format": 1, "kind": "model", "task": "static", "primitives": 2,
        "density": {"class": "CosineDensity", "settings": {"neurons": 0}},
        "colour": {"class": "SphericalHarmonics", "settings": {"degree": 0, "channels": 3}},
        **changes.pop("header", {}),
    }  # fmt: skip
    return assembled(json.dumps(header).encode(), sections, **changes)


def assembled(
    text: bytes,
    sections: dict[str, tuple[int, tuple[int, ...], bytes, bytes]],
    version: int = 1,
    count: int = 2,
    packing: int = 0,
    **table: Any,
) -> bytes:
    """A file of these parts, whose check sums are right, whatever else is not."""
    rows, parts = [], []
    for name, (coding, shape, head, planes) in sections.items():
        part = head + planes
        sizes = {"planes": len(planes), "size": len(part), "crc": zlib.crc32(part), "packing": packing}
        sizes |= {"label": name.encode(), "part": part, **table.get(name, {})}
        row = bytes([len(sizes["label"]), *sizes["label"], coding, sizes["packing"], len(shape)])
        row += struct.pack(f"<{len(shape)}I", *shape)
        rows.append(row + struct.pack("<QQI", sizes["planes"], sizes["size"], sizes["crc"]))
        parts.append(sizes["part"])
    start = struct.pack("<IIQII", version, table.get("number", len(rows)), count, len(text), len(b"".join(rows)))
    check = struct.pack("<I", zlib.crc32(start + text + b"".join(rows)))
    return b"\x89NEUPRIM" + start + check + text + b"".join(rows + parts)


def test_a_file_by_hand_is_read_as_the_page_says(tmp_path: Path) -> None:
    path = tmp_path / "any name"
    path.write_bytes(by_hand())
    model, header = checkpoint.load_model_checkpoint(path, TASK)
    p = model.params
    assert p["means"].tolist() == [[-1.0, 0.0, 1.0], [2.0, 2.0, 2.0]]
    assert p["log_scales"].tolist() == [[-2.0, -2.0, 0.5], [-1.0, 0.0, 0.5]]
    assert p["quats"][0].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert p["quats"][1].tolist() == pytest.approx([0.5**0.5, 0.0, -(0.5**0.5), 0.0])
    assert p["b2"].tolist() == [[258.0], [4095.0]] and p["sh_dc"].tolist() == [[0.5] * 3] * 2
    assert p["W1"].shape == (2, 0, 3)
    assert header["task"] == "static" and checkpoint.checkpoint_config(path) is None and is_compressed(path)
    assert checkpoint.read_header(path, "model") == header
    low, high = np.float32([-0.1, 0.3]).astype(float)
    column = (1, (1,), struct.pack("<Bff", 8, low, high), bytes([100, 255]))
    path.write_bytes(by_hand(sections={"b2": column, CONFIG: (0, (), b"", CONFIG_TEXT.encode())}))
    found = checkpoint.load_model_checkpoint(path, TASK)[0].params["b2"]
    assert found.flatten().tolist() == np.float32([(155 * low + 100 * high) / 255, high]).tolist()
    assert checkpoint.checkpoint_config(path) == CONFIG_TEXT
    with pytest.raises(CheckpointError, match="header states kind 'model'; expected 'checkpoint'"):
        checkpoint.read_header(path, "checkpoint")


# ---------------------------------------------------------------- what is damaged


def sparse(mask_of: int, codes: bytes) -> tuple[int, tuple[int, ...], bytes, bytes]:
    """A section of one sparse column: 8 bits from 0 to 255."""
    return 5, (1,), struct.pack("<BffH", 8, 0.0, 255.0, mask_of), codes


def test_sparse_columns_by_hand(tmp_path: Path) -> None:
    """The second of two primitives has a number, then both, then neither."""
    rows = {"rows|": (4, (3,), b"", bytes([0b10, 0b11, 0b00]))}
    for mask_of, codes, wanted in (
        (1, b"\x07", [0.0, 7.0]),
        (2, b"\x05\x06", [5.0, 6.0]),
        (3, b"", [0.0, 0.0]),
        (0, b"\x01\x02", [1.0, 2.0]),
    ):
        (tmp_path / "m").write_bytes(by_hand(first=rows, sections={"b2": sparse(mask_of, codes)}))
        assert checkpoint.load_model_checkpoint(tmp_path / "m", TASK)[0].params["b2"].flatten().tolist() == wanted


def zstd(data: bytes, **options: Any) -> bytes:
    return zstandard.ZstdCompressor(**options).compress(data)


BOMB = zstd(bytes(200_000_000), level=1)
RECORD = struct.pack("<Bff", 8, 0.0, 1.0)
DAMAGE: dict[str, tuple[Callable[[], bytes], tuple[str, ...]]] = {
    "version": (lambda: by_hand(version=2), ("format version is 2", "reads 1")),
    "count": (lambda: by_hand(count=3), ("header says 2 primitives; expected 3",)),
    "both counts": (lambda: by_hand(count=3, header={"primitives": 3}), ("section 'means'", "2 bytes; expected 3")),
    "no count": (lambda: by_hand(count=2**63), ("claims 9223372036854775808 primitives",)),
    "count in the header": (lambda: by_hand(header={"primitives": 3}), ("header says 3 primitives; expected 2",)),
    "sections": (lambda: by_hand(number=2**32 - 1), ("claims 4294967295 sections; expected at most 4096",)),
    "more rows": (lambda: by_hand(number=9), ("row 8 of the table of 9 sections",)),
    "fewer rows": (lambda: by_hand(number=7), ("more rows than its 7 sections",)),
    "header not JSON": (lambda: assembled(b"{", {}), ("header is not valid JSON",)),
    "header nested": (lambda: assembled(b"[" * 200_000, {}), ("header is not valid JSON",)),
    "header a list": (lambda: assembled(b"[]", {}), ("header is a list",)),
    "kind": (lambda: by_hand(header={"kind": "checkpoint"}), ("header states kind 'checkpoint'; expected 'model'",)),
    "field": (lambda: by_hand(header={"density": {"class": "os.system", "settings": {}}}), ("unknown density field",)),
    "twice": (lambda: by_hand(b1={"label": b"W1"}), ("section 'W1' is stored twice",)),
    "name": (lambda: by_hand(b2={"label": b"\xff\xfe"}), ("row 6",)),
    "missing": (lambda: by_hand(b2={"label": b"b3"}), ("b3",)),
    "coding": (lambda: by_hand(sections={"b2": (6, (1,), RECORD, b"ab")}), ("section 'b2' has coding 6",)),
    "rows of another name": (lambda: by_hand(sections={"b2": (4, (1,), b"", b"a")}),
        ("section 'b2' of rows", "'rows|'")),
    "rows without a mask": (lambda: by_hand(first={"rows|": (4, (0,), b"", b"")}),
        ("section 'rows|' of rows has shape (0,)",)),
    "rows beyond": (lambda: by_hand(first={"rows|": (4, (1,), b"", b"\x07")}), ("bits set after its 2 primitives",)),
    "no rows": (lambda: by_hand(sections={"b2": sparse(1, b"a")}),
        ("section 'b2' is damaged: a column refers to mask 1; expected at most 0",)),
    "more than the mask has": (
        lambda: by_hand(first={"rows|": (4, (1,), b"", b"\x01")}, sections={"b2": sparse(1, b"ab")}),
        ("section 'b2' is damaged: its planes have 2 bytes; expected 1",),
    ),
    "packing": (lambda: by_hand(b2={"packing": 2}), ("section 'b2' has packing 2",)),
    "text": (lambda: by_hand(sections={"b2": (0, (), b"", b"ab")}), ("section 'b2' has coding text",)),
    "config": (lambda: by_hand(sections={CONFIG: (1, (), RECORD, b"ab")}),
        ("section 'config.yaml' has coding columns",)),
    "config too long": (lambda: by_hand(sections={CONFIG: (0, (), b"", bytes(2**20 + 1))}),
        ("1048577 bytes; expected at most 1048576",)),
    "shape": (lambda: by_hand(sections={"W1": (1, (2**32 - 1, 0), b"", b"")}), ("expected at most 1048576 numbers",)),
    "positions' shape": (lambda: by_hand(sections={"means": (2, (4,), RECORD * 4, b"ab")}),
        ("shape (4,); coding positions expects (3,)",)),
    "positions' bits": (
        lambda: by_hand(sections={"means": (2, (3,), RECORD * 2 + struct.pack("<Bff", 9, 0.0, 1.0), bytes(6))}),
        ("three columns with the same number of bits",),
    ),
    "bits": (lambda: by_hand(sections={"b2": (1, (1,), struct.pack("<Bff", 21, 0, 1), bytes(6))}),
        ("column 0 has 21 bits",)),
    "ends": (lambda: by_hand(sections={"b2": (1, (1,), struct.pack("<Bff", 8, 1, 0), b"ab")}),
        ("has the range 1.0 to 0.0",)),
    "NaN": (lambda: by_hand(sections={"b2": (1, (1,), struct.pack("<Bff", 8, math.nan, 0), b"ab")}),
        ("has the range nan",)),
    "code": (lambda: by_hand(sections={"b2": (1, (1,), struct.pack("<Bff", 7, 0, 1), bytes([128, 0]))}),
        ("7 bits is outside of 0 to 127",)),
    "key": (lambda: by_hand(sections={"means": (2, (3,), struct.pack("<Bff", 2, 0, 1) * 3, bytes([34, 30]))}),
        ("position code does not fit 6 bits",)),
    "wide key": (
        lambda: by_hand(sections={"means": (2, (3,), struct.pack("<Bff", 20, 0, 1) * 3, bytes([255] * 16))}),
        ("a code of 60 bits",),
    ),
    "largest": (lambda: by_hand(sections={"quats": (3, (4,), bytes([3]), bytes([4] + [0] * 7))}),
        ("outside of 0 to 3",)),
    "rotation code": (lambda: by_hand(sections={"quats": (3, (4,), bytes([3]), bytes([0] * 7 + [7]))}),
        ("outside of 0 to 6",)),
    "planes": (lambda: by_hand(b2={"planes": 3, "size": 12, "part": RECORD + b"abc"}), ("section 'b2' is damaged",)),
    "too many planes": (lambda: by_hand(b2={"planes": 2**60}),
        ("planes of 1152921504606846976 bytes; expected at most 6",)),
    "size": (lambda: by_hand(b2={"size": 2**60}), ("stored in 1152921504606846976 bytes",)),
    "check sum": (lambda: by_hand(b2={"crc": 0}), ("section 'b2' is damaged: its check sum is", "expected 00000000")),
    "no zstd": (lambda: by_hand(packing=1), ("section 'means' is damaged: zstd",)),
    "zstd states more": (
        lambda: by_hand(sections={"b2": (1, (1,), RECORD, BOMB)}, b2={"packing": 1, "planes": 2}),
        ("its zstd frame states 200000000 bytes; expected 2",),
    ),
    "two zstd frames": (
        lambda: by_hand(sections={"b2": (1, (1,), RECORD, zstd(b"ab") * 2)}, b2={"packing": 1, "planes": 2}),
        ("section 'b2' is damaged: zstd",),
    ),
    "a bomb of primitives": (
        lambda: assembled(
            json.dumps({"primitives": 60_000_000}).encode(),
            {"b2": (1, (1,), RECORD, zstd(bytes(60_000_000), level=1))}, count=60_000_000,
            b2={"packing": 1, "planes": 60_000_000},
        ),
        ("expected float32 data of at most 64 times the file size",),
    ),
}  # fmt: skip
"""Name -> a file with right check sums, and what the message says."""


@pytest.mark.parametrize("name", DAMAGE)
def test_lies_are_named(tmp_path: Path, name: str) -> None:
    make, words = DAMAGE[name]
    path = tmp_path / "m"
    path.write_bytes(make())
    refused(path, *words)


MEMORY = """
import resource, sys
from pathlib import Path
from neuprim.core import checkpoint
from neuprim.core.errors import CheckpointError
from neuprim.tasks.static import TASK
checkpoint.load_model_checkpoint(Path(sys.argv[1]), TASK)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for name in sys.argv[2:]:
    try:
        checkpoint.load_model_checkpoint(Path(name), TASK)
        raise SystemExit(f"{name} was read")
    except CheckpointError:
        pass
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@posix
def test_lies_take_no_memory(tmp_path: Path) -> None:
    """All together less than one of the bombs would."""
    names = [tmp_path / "good", *(tmp_path / str(i) for i in range(len(DAMAGE)))]
    for path, data in zip(names, [by_hand(), *(make() for make, _ in DAMAGE.values())], strict=True):
        path.write_bytes(data)
    done = subprocess.run([sys.executable, "-c", MEMORY, *map(str, names)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    grown = int(done.stdout) / (2**20 if sys.platform == "darwin" else 2**10)
    assert grown < 40, f"{grown} MiB"


# ---------------------------------------------------------------- writing


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m"
    path.write_bytes(by_hand())

    def full(*places: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("neuprim.core.io.files.os.replace", full)
    with pytest.raises(CheckpointError, match=r"could not write the model: .*No space left on device") as caught:
        checkpoint.save_compressed(path, example("static", 9)[1], "static", {}, LEVELS[3])
    monkeypatch.undo()
    assert str(path) in str(caught.value)
    assert path.read_bytes() == by_hand() and [p.name for p in tmp_path.iterdir()] == ["m"]


@pytest.mark.parametrize("shape", [(1, 1, 1, 1, 1), (2**20 + 1,), (2**10, 2**11)])
def test_parameters_that_no_reader_would_take(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(CheckpointError, match=r"parameter 'p' of shape .* cannot be stored; expected at most"):
        write_compressed(tmp_path / "m", {}, 0, [CompressedSection("p", 1, shape)])
    with pytest.raises(CheckpointError, match="cannot be stored; expected at most 255 bytes of name"):
        write_compressed(tmp_path / "m", {}, 0, [CompressedSection("ü" * 128, 1, (1,))])
    assert list(tmp_path.iterdir()) == []

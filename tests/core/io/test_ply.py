"""PLY files: what is written comes back, what is damaged is refused, and nothing a header claims costs memory."""

from __future__ import annotations

import struct
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest

from neuprim.core.errors import DataError
from neuprim.core.io.ply import PlyVertices, read_ply, read_ply_elements, write_ply

ROWS = np.array(
    [(1.5, -2, 250, 1e-300), (np.float32(0.1), 7, 3, 2.5)],
    [("x", "<f4"), ("count", "<i2"), ("red", "|u1"), ("mass", "<f8")],
)


def test_every_type_comes_back_to_the_bit(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", ROWS, ["made here", "  two blanks"])
    found = read_ply(tmp_path / "a.ply")
    assert found.comments == ("made here", "  two blanks") and found.names == ("x", "count", "red", "mass")
    assert found.rows.tobytes() == ROWS.tobytes()


@pytest.mark.parametrize(
    ("kind", "values", "white", "warned"),
    [
        ("|u1", [0, 1], 255, False),
        ("|i1", [0, 100], 127, False),
        ("<u2", [0, 60000], 65535, False),
        ("<u2", [0, 200], 255, True),
        ("<i4", [9, 255], 255, True),
        ("<f4", [0, 1.5], 1, False),
        ("<f4", [0, 200], 255, True),
    ],
)
def test_what_counts_as_white(kind: str, values: list[float], white: float, warned: bool, tmp_path: Path) -> None:
    rows = np.zeros(2, [("red", kind)])
    rows["red"] = values
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        assert PlyVertices(rows).white(["red"], tmp_path / "a.ply") == white
    assert [str(w.message).endswith("read as colours of 0 to 255") for w in given] == [True] * warned


def test_other_programs_read_it(tmp_path: Path) -> None:
    import trimesh

    rows = np.zeros(4, [(n, "<f4") for n in "xyz"])
    rows["x"], rows["y"], rows["z"] = np.arange(4), np.arange(4) * 2, np.arange(4) - 5
    write_ply(tmp_path / "a.ply", rows, ['neuprim {"a": 1}'])
    cloud = trimesh.load(tmp_path / "a.ply")
    assert np.array_equal(np.asarray(cloud.vertices), np.stack([rows[n] for n in "xyz"], -1))


def test_ascii_big_endian_and_lists_after_the_vertices(tmp_path: Path) -> None:
    head = "element vertex 2\nproperty float x\nproperty uchar red\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text("ply\r\nformat ascii 1.0\r\ncomment hi\r\n" + head + "0.5 7\n-1e-3 255\n3 0 1 0\n")
    found = read_ply(tmp_path / "a.ply")
    assert found.rows["x"].tolist() == [0.5, np.float32(-1e-3)] and found.rows["red"].tolist() == [7, 255]
    assert found.comments == ("hi",)
    body = np.array([(0.5, 7), (-2, 255)], [("x", ">f4"), ("red", "u1")]).tobytes()
    (tmp_path / "b.ply").write_bytes(("ply\nformat binary_big_endian 1.0\n" + head).encode() + body + b"\x03rest")
    assert read_ply(tmp_path / "b.ply").rows["x"].tolist() == [0.5, -2.0]


@pytest.mark.parametrize("order", ["<", ">", ""])
def test_elements_in_any_order_with_lists_of_any_length(tmp_path: Path, order: str) -> None:
    """Lists of one length are read at once, of several row by row; both before what is wanted, and among it."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = (
        f"ply\r\nformat {name} 1.0\r\nelement face 2\r\nproperty uchar red\r\nproperty list uchar int "
        "vertex_indices\r\nelement vertex 2\r\n"
        "property double x\r\nproperty list short float more\r\nproperty uchar tag\r\nend_header\r\n"
    )
    for more in ([1.5, 2.5], [1.5]), ([], [1.0, 2.0, 3.0]):
        if order:
            body = struct.pack(f"{order}BB3iBB4i", 7, 3, 0, 1, 2, 8, 4, 3, 2, 1, 0)
            body += b"".join(
                struct.pack(f"{order}dh{len(m)}fB", 1e-300 + i, len(m), *m, 9 + i) for i, m in enumerate(more)
            )
        else:
            rows = "\n".join(" ".join(map(str, [1e-300 + i, len(m), *m, 9 + i])) for i, m in enumerate(more))
            body = f"7 3 0 1 2\n8 4 3 2 1 0\n{rows}\n".encode()
        path = tmp_path / "a.ply"
        path.write_bytes(head.encode() + body)
        found = read_ply(path)
        assert found.names == ("x", "tag") and found.rows["x"].tolist() == [1e-300, 1.0]
        assert found.rows["tag"].tolist() == [9, 10]
        with open(path, "rb") as file:
            both = read_ply_elements(file, path.stat().st_size, path, ("face", "vertex"))
        corners, numbers = both["face"].lists["vertex_indices"], both["vertex"].lists["more"]
        assert corners.sizes.tolist() == [3, 4] and corners.values.tolist() == [0, 1, 2, 3, 2, 1, 0]
        assert numbers.sizes.tolist() == [len(m) for m in more] and numbers.values.tolist() == [*more[0], *more[1]]
        path.write_bytes((head.encode() + body)[:-3])
        with pytest.raises(DataError, match=r"2 vertices|vertices are not numbers"):
            read_ply(path)


def test_rows_that_cost_nothing_are_not_counted_through(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    head = "ply\nformat binary_little_endian 1.0\nelement none 999999999999\n"
    path.write_text(head + "element vertex 1\nproperty uchar x\nend_header\n7")
    assert read_ply(path).rows["x"].tolist() == [ord("7")]


HEAD = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nend_header\n"
ONE = HEAD.format("ascii", 1)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "end_header"),
        ("obj\n", "expected a PLY file"),
        ("ply\n" + ("comment " + "x" * 100 + "\n") * 60_000, "end_header in"),
        (HEAD.format("binary_little_endian", 999_999_999_999), "bytes follow"),
        (HEAD.format("ascii", 999_999_999_999), "bytes follow"),
        (HEAD.format("ascii", -1), "as the count of vertex; expected a number"),
        (HEAD.format("ascii", "٣"), "as the count of vertex; expected a number"),
        (ONE + "nothing\n", "not numbers"),
        (HEAD.format("ascii", 2) + "1\n \n\n\n\n", "1 vertices"),
        (ONE + "1 2\n", "expected 1 rows of 1 numbers"),
        (HEAD.format("msdos", 1), "expected format"),
        ("ply\nelement vertex 1\nproperty float x\nend_header\n", "no format"),
        ("ply\nformat ascii 1.0\nend_header\n", "no element vertex"),
        (ONE.replace("float x", "list uchar x"), "as 'property float x' or"),
        (ONE.replace("float x", "list float int x"), "as 'property float x' or"),
        (ONE.replace("float x", "list uchar int x") + "3 1 2\n", "a list claims 3 numbers, but its line has only 3"),
        ("ply\nformat ascii 1.0\nelement a 1\nelement a 1\n", "element a twice"),
        (ONE.replace("float x", "float x\nproperty float x"), "twice"),
        (ONE.replace("float", "uchar") + "256\n", "outside the range of its type"),
        (ONE.replace("float", "uchar") + "nan\n", "outside the range of its type"),
    ],
)
def test_damage_is_named(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_text(text)
    tracemalloc.start()
    with pytest.raises(DataError) as caught:
        read_ply(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert reason in str(caught.value) and str(path) in str(caught.value)
    assert peak < 50e6 + 10 * path.stat().st_size


def test_a_missing_file_and_a_folder_are_no_bugs(tmp_path: Path) -> None:
    for path in (tmp_path / "none.ply", tmp_path):
        with pytest.raises(DataError):
            read_ply(path)

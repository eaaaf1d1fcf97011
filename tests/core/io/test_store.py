"""Folders and object stores as places of files: whole or not at all, found again, and never larger than what belongs
there."""

from __future__ import annotations

import sys
import threading
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuprim.core.errors import BackendUnavailable, ConfigError, DataError
from neuprim.core.io import store as stores
from neuprim.core.io.json_reader import read_npz_arrays
from neuprim.core.io.store import Store, open_store

Make = Callable[[], Store]


@pytest.fixture(params=["folder", "file://", "memory://"])
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Make]:
    """The same place, as another process would open it."""
    places = {"folder": f"{tmp_path}/s", "file://": f"file://{tmp_path}/s", "memory://": "memory://neuprim-tests/s"}
    address = places[request.param]
    copies = iter(range(100))
    yield lambda: open_store(address, tmp_path / f"copies-{next(copies)}").at("volumes", "key")
    if request.param == "memory://":
        import fsspec

        fsspec.filesystem("memory").rm("/neuprim-tests", recursive=True)


def two(folder: Path) -> None:
    (folder / "a").write_text("first")
    (folder / "last").write_text("second")


def test_a_folder_is_there_when_its_last_file_is(make: Make) -> None:
    store = make()
    store.prepare()
    assert store.complete_folders("last") == set() and not store.has_file("x/last")
    store.write_folder("x", two, "last")
    other = make()
    assert other.complete_folders("last") == {"x"} and other.has_file("x/a")
    assert other.fetch_file("x/a", 100).read_text() == "first" and not other.fetch_file("x/none", 100).exists()
    store.write_folder("x", two, "last")
    store.write_file("note", lambda path: path.write_text("n") and None)
    assert make().fetch_file("note", 1).read_text() == "n" and other.complete_folders("last") == {"x"}


def test_what_fails_half_way_leaves_nothing(make: Make) -> None:
    store = make()
    store.prepare()

    def fails(folder: Path) -> None:
        (folder / "last").write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        store.write_folder("x", fails, "last")
    assert make().complete_folders("last") == set()
    if store.is_local:
        assert list(store.path.iterdir()) == []


def test_a_file_larger_than_what_belongs_there_is_not_read(make: Make) -> None:
    store = make()
    store.prepare()
    store.write_file("big", lambda path: path.write_bytes(bytes(1000)) and None)
    with pytest.raises(DataError, match=r"big: the file has 1,000 bytes; expected at most 999$"):
        make().fetch_file("big", 999)


def test_a_folder_without_its_last_file_is_made_anew(tmp_path: Path) -> None:
    store = Store.local(tmp_path)
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "rest").touch()
    (tmp_path / ".x-killed").mkdir()
    assert store.complete_folders("last") == set()
    store.write_folder("x", two, "last")
    assert sorted(f.name for f in tmp_path.rglob("*")) == ["a", "last", "x"]


def test_errors_of_a_client_are_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_store("memory://neuprim-tests/x", tmp_path)
    assert not store.is_local

    class Broken:
        def __getattr__(self, name: str) -> Any:
            raise RuntimeError("no\ncredentials")

    monkeypatch.setattr(store, "_system", Broken())
    for call in (lambda: store.complete_folders("a"), lambda: store.has_file("a"), lambda: store.fetch_file("a", 1)):
        with pytest.raises(DataError, match=r"^memory://neuprim-tests/x: cannot be read \(no credentials\)$"):
            call()
    with pytest.raises(DataError, match=r"cannot be written \(no credentials\)"):
        store.write_folder("x", two, "last")


def test_no_bucket_is_made(tmp_path: Path) -> None:
    """A typing error would make one."""
    Store("s3://bukcet/x", tmp_path, object(), "bukcet/x").prepare()
    with pytest.raises(DataError, match="cannot be written"):
        Store("sftp://host/x", tmp_path, object(), "x").prepare()


def test_addresses_that_nothing_can_be_made_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for address in ("nonsense://x", "ftp://user:pw@127.0.0.1:1/x", "github://a:b@c"):
        with pytest.raises(
            ConfigError, match=rf"^{address}: unsupported protocol .*; expected a folder, or a URL of file, local"
        ):
            open_store(address, tmp_path)
    for address in ("simplecache::s3://x", "zip://x::https://y", "memory::x"):
        with pytest.raises(ConfigError, match=rf"^{address}: chained protocols \(::\)"):
            open_store(address, tmp_path)
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(BackendUnavailable, match=r"^s3://bucket: s3:// needs a package .*: pip install 'neuprim\[s3"):
        open_store("s3://bucket", tmp_path)


def test_a_moments_absence_is_survived_and_other_errors_are_not_tried_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "POLL_INTERVAL", 0.01)
    store, calls = Store.local(tmp_path / "s"), []
    store.prepare()

    def away() -> str:
        calls.append("away")
        if len(calls) == 1:
            raise FileNotFoundError(2, "No such file or directory", str(store.path / "f"))
        if len(calls) == 2:
            (tmp_path / "s").rename(tmp_path / "t")
            threading.Timer(0.1, (tmp_path / "t").rename, (tmp_path / "s",)).start()
            raise DataError(f"{store.path}: cannot be written")
        return "done"

    said: list[str] = []
    assert store.retry(away, said.append) == "done" and len(calls) == 3
    assert said == [f"waiting for {store.path}, which is gone"]

    def full() -> None:
        calls.append("full")
        raise OSError(28, "No space left on device", str(store.path / "f"))

    with pytest.raises(OSError, match="No space left"):
        store.retry(full, said.append)
    assert calls.count("full") == 1


def test_what_a_faster_process_stored_is_not_written_again(tmp_path: Path) -> None:
    store, calls = Store.local(tmp_path / "s"), []
    store.prepare()

    def fill(draft: Path) -> None:
        calls.append(draft)
        (draft / "last").write_text("mine")
        if len(calls) == 1:  # meanwhile another process does the same, and removes drafts
            store.write_folder("f", fill, "last")
            raise FileNotFoundError(2, "No such file or directory", str(draft / "more"))

    store.retry(lambda: store.write_folder("f", fill, "last"), pytest.fail)
    assert len(calls) == 2 and [path.name for path in store.path.iterdir()] == ["f"]


WANTED = {"a": (np.float32, (None, 3)), "b": (np.float64, ())}


def test_arrays_are_read_back(tmp_path: Path) -> None:
    a = np.arange(6, dtype=np.float32).reshape(2, 3)
    np.savez(tmp_path / "f.npz", a=a, b=np.float64(2), more=np.array(["text"]))
    found = read_npz_arrays(tmp_path / "f.npz", WANTED)
    assert found.keys() == {"a", "b"} and np.array_equal(found["a"], a) and float(found["b"]) == 2


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"a": np.zeros((2, 3), np.float32)}, r"no array 'b'"),
        ({"a": np.zeros((2, 3)), "b": np.float64(1)}, r"a is float64 of shape \(2, 3\); expected float32 of \(N, 3\)"),
        ({"a": np.zeros((2, 4), np.float32), "b": np.float64(1)}, r"a is float32 of shape \(2, 4\)"),
        ({"a": np.array([[{}] * 3]), "b": np.float64(1)}, r"a is object"),
    ],
)
def test_arrays_of_another_form_are_refused(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    np.savez(tmp_path / "f.npz", **arrays)
    with pytest.raises(DataError, match=rf"f\.npz: damaged \({message}"):
        read_npz_arrays(tmp_path / "f.npz", WANTED)


def test_a_header_that_claims_more_than_there_is(tmp_path: Path) -> None:
    file = tmp_path / "f.npz"
    np.savez(file, a=np.zeros((2, 3), np.float32), b=np.float64(1))
    data = file.read_bytes()
    assert data.count(b"(2, 3), }                       ") == 1
    with zipfile.ZipFile(file) as archive:
        array = archive.read("a.npy").replace(b"(2, 3), }           ", b"(9000000000, 3), }  ")
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.npy", array)
    with pytest.raises(DataError, match=r"a claims shape \(9000000000, 3\), but has only \d+ bytes"):
        read_npz_arrays(file, {"a": WANTED["a"]})
    stored = bytearray(file.read_bytes())
    at = stored.index(b"PK\x01\x02") + 24  # the size in the archive's list of files
    stored[at : at + 4] = (4_000_000_000).to_bytes(4, "little")
    file.write_bytes(stored)
    with pytest.raises(DataError, match=r"a claims 4000000000 bytes of a file of"):
        read_npz_arrays(file, {"a": WANTED["a"]})
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", array + bytes(10**7))
    with pytest.raises(DataError, match=r"a claims 10,?\d+ bytes of a file of"):
        read_npz_arrays(file, {"a": WANTED["a"]})
    file.write_bytes(data[:100])
    with pytest.raises(DataError, match=r"f\.npz: damaged"):
        read_npz_arrays(file, WANTED)
    with pytest.raises(DataError, match=r"none\.npz: damaged \(.*No such file"):
        read_npz_arrays(tmp_path / "none.npz", WANTED)

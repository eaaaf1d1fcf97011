"""Folders that appear whole or not at all."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from neuprim.core.io.files import publish_folder, write_text
from tests.systems import posix


def write(folder: Path) -> None:
    (folder / "a").write_text("new")


def complete(folder: Path) -> bool:
    return (folder / "a").is_file()


def test_a_folder_is_written_once(tmp_path: Path) -> None:
    final = tmp_path / "below" / "data"
    publish_folder(final, write, complete)
    assert [p.name for p in final.parent.iterdir()] == ["data"]
    assert sys.platform == "win32" or final.stat().st_mode & 0o777 == 0o755
    (final / "a").write_text("kept")
    publish_folder(final, write, complete)
    assert (final / "a").read_text() == "kept"


def test_an_incomplete_folder_is_replaced(tmp_path: Path) -> None:
    final = tmp_path / "data"
    final.mkdir()
    (final / "b").write_text("left over")
    publish_folder(final, write, complete)
    assert [p.name for p in final.iterdir()] == ["a"]


def test_of_two_at_once_the_first_wins(tmp_path: Path) -> None:
    final = tmp_path / "data"

    def beaten(folder: Path) -> None:
        write(folder)
        final.mkdir()
        (final / "a").write_text("first")

    publish_folder(final, beaten, complete)
    assert (final / "a").read_text() == "first" and [p.name for p in tmp_path.iterdir()] == ["data"]


def test_a_failure_leaves_nothing(tmp_path: Path) -> None:
    def fail(folder: Path) -> None:
        write(folder)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        publish_folder(tmp_path / "data", fail, complete)
    assert list(tmp_path.iterdir()) == []


@posix
def test_what_is_flushed_may_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows refuses to flush a file that was opened for reading; asked here, where systems tell how a file was
    opened."""
    import fcntl

    flushed = []

    def fsync(descriptor: int) -> None:
        flushed.append(fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE)

    monkeypatch.setattr(os, "fsync", fsync)
    write_text(tmp_path / "a", "content")
    assert (tmp_path / "a").read_text() == "content"
    assert flushed == [os.O_RDWR]

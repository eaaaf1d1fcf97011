"""Files and folders that appear complete or not at all."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.files import publish_folder, refuse_existing, staged_output, write_text
from tests.systems import posix


def tree(folder: Path) -> dict[str, str]:
    return {p.relative_to(folder).as_posix(): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


# ---------------------------------------------------------------- folders


def write(folder: Path) -> None:
    (folder / "a").write_text("new")


def complete(folder: Path) -> bool:
    return (folder / "a").is_file()


def test_a_folder_is_written_once_and_replaced_only_if_incomplete(tmp_path: Path) -> None:
    final = tmp_path / "below" / "data"
    final.mkdir(parents=True)
    (final / "b").write_text("left over")
    publish_folder(final, write, complete)
    assert os.listdir(final.parent) == ["data"] and tree(final) == {"a": "new"}
    assert sys.platform == "win32" or final.stat().st_mode & 0o777 == 0o755
    (final / "a").write_text("kept")
    publish_folder(final, write, complete)
    assert tree(final) == {"a": "kept"}


def test_the_first_of_two_writers_wins_and_a_failure_leaves_nothing(tmp_path: Path) -> None:
    def write_second(folder: Path) -> None:
        write(folder)
        (tmp_path / "data").mkdir()
        (tmp_path / "data" / "a").write_text("first")

    def fail(folder: Path) -> None:
        write(folder)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        publish_folder(tmp_path / "data", fail, complete)
    assert tree(tmp_path) == {}
    publish_folder(tmp_path / "data", write_second, complete)
    assert tree(tmp_path) == {"data/a": "first"} and os.listdir(tmp_path) == ["data"]


@posix
def test_files_are_flushed_through_a_writable_descriptor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows refuses to flush a file that was opened for reading."""
    import fcntl

    flags = []
    monkeypatch.setattr(os, "fsync", lambda fd: flags.append(fcntl.fcntl(fd, fcntl.F_GETFL) & os.O_ACCMODE))
    write_text(tmp_path / "a", "content")
    assert (tmp_path / "a").read_text() == "content" and flags == [os.O_RDWR]


# ---------------------------------------------------------------- staged output


def test_a_staged_file_and_its_companions_are_published_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with staged_output(tmp_path / "new" / "a.obj", False) as output:
        output.out.write_text("mesh")
        (output.out.parent / "a.mtl").write_text("look")
        assert tree(tmp_path / "new") == {} and output.out.name == "a.obj"
        assert output.final_path(output.out) == tmp_path / "new" / "a.obj"
        assert output.final_path(tmp_path / "else") is None
        text = output.final_text(f"{output.out.parent}/a.mtl of {output.out}")
        assert text == f"{tmp_path}/new/a.mtl of {tmp_path}/new/a.obj"
        output.publish()
    assert tree(tmp_path) == {"new/a.mtl": "look", "new/a.obj": "mesh"} and os.listdir(tmp_path) == ["new"]
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    with staged_output(Path("."), False) as output:
        output.out.mkdir()
        (output.out / "x").write_text("new")
        output.publish()
    assert tree(tmp_path / "empty") == {"x": "new"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_staged_folder_joins_an_existing_one(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "frames" / "deep").mkdir(parents=True)
    for name in ("0", "other", "deep/1"):
        (tmp_path / "frames" / name).write_text("old")
    before = tree(tmp_path)
    with staged_output(tmp_path / "frames", overwrite) as output:
        (output.out / "deep").mkdir(parents=True)
        for name in ("0", "deep/1", "deep/2"):
            (output.out / name).write_text("new")
        if not overwrite:
            with pytest.raises(ConfigError, match=r"frames/0: already exists; pass --force to replace it"):
                output.publish()
            assert {k: v for k, v in tree(tmp_path).items() if k in before} == before
        else:
            output.publish()
            assert tree(tmp_path / "frames") == {"0": "new", "other": "old", "deep/1": "new", "deep/2": "new"}
    assert sorted(os.listdir(tmp_path / "frames")) == ["0", "deep", "other"]


@pytest.mark.parametrize(("name", "folder"), [("taken", False), ("folder", False), ("file", True)])
def test_what_is_in_the_way_of_staged_output_stays(tmp_path: Path, name: str, folder: bool) -> None:
    (tmp_path / "folder").mkdir()
    for file in ("file", "taken", "companion"):
        (tmp_path / file).write_text("old")
    with pytest.raises(ConfigError, match=r"companion: already exists|is a folder|is a file"):
        with staged_output(tmp_path / (name if name != "taken" else "new"), name != "taken") as output:
            if folder:
                output.out.mkdir()
            (output.out / "x" if folder else output.out).write_text("new")
            if name == "taken":
                (output.out.parent / "companion").write_text("new")
            output.publish()
    assert tree(tmp_path) == {"file": "old", "taken": "old", "companion": "old"}


@pytest.mark.parametrize("failure", [DataError, ZeroDivisionError, KeyboardInterrupt])
def test_failed_staging_leaves_nothing_and_names_final_paths(tmp_path: Path, failure: type[BaseException]) -> None:
    (tmp_path / "a").write_text("old")
    with pytest.raises(failure) as caught, staged_output(tmp_path / "a", True) as output:
        output.out.write_text("half")
        raise failure(f"{output.out}: no")
    assert tree(tmp_path) == {"a": "old"} and os.listdir(tmp_path) == ["a"]
    assert failure is not DataError or str(caught.value) == f"{tmp_path}/a: no"
    with pytest.raises(PermissionError) as refused, staged_output(tmp_path / "a", True) as output:
        raise PermissionError(13, "Permission denied", str(output.out))
    assert refused.value.filename == str(tmp_path / "a")
    with pytest.raises(NotADirectoryError) as impossible, staged_output(tmp_path / "a" / "x.ply", False):
        pass
    assert impossible.value.filename == str(tmp_path / "a" / "x.ply")


def test_existing_files_and_full_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for name in ("empty", "nothing"):
        refuse_existing(tmp_path / name, False)
    for name in ("full", "full/x", "dangling"):
        with pytest.raises(ConfigError, match="--force"):
            refuse_existing(tmp_path / name, False)
        refuse_existing(tmp_path / name, True)

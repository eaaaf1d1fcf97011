"""Files written by others get their place when all is done, or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.drafts import drafted, refuse_taken


def tree(folder: Path) -> dict[str, str]:
    return {p.relative_to(folder).as_posix(): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_file_and_what_was_put_beside_it(tmp_path: Path) -> None:
    with drafted(tmp_path / "new" / "a.obj", False) as draft:
        draft.out.write_text("mesh")
        (draft.out.parent / "a.mtl").write_text("look")
        assert tree(tmp_path / "new") == {} and draft.out.name == "a.obj"
        assert draft.place(draft.out) == tmp_path / "new" / "a.obj" and draft.place(tmp_path / "else") is None
        assert (
            draft.words(f"{draft.out.parent}/a.mtl of {draft.out}") == f"{tmp_path}/new/a.mtl of {tmp_path}/new/a.obj"
        )
        draft.publish()
    assert tree(tmp_path) == {"new/a.mtl": "look", "new/a.obj": "mesh"} and os.listdir(tmp_path) == ["new"]


def test_a_folder_joins_one_that_is_there(tmp_path: Path) -> None:
    (tmp_path / "frames" / "deep").mkdir(parents=True)
    for name in ("0", "other", "deep/1"):
        (tmp_path / "frames" / name).write_text("old")

    def write(overwrite: bool) -> None:
        with drafted(tmp_path / "frames", overwrite) as draft:
            (draft.out / "deep").mkdir(parents=True)
            for name in ("0", "deep/1", "deep/2"):
                (draft.out / name).write_text("new")
            draft.publish()

    with pytest.raises(ConfigError, match=r"frames/0: exists; --force replaces it"):
        write(False)
    assert set(tree(tmp_path).values()) == {"old"} and len(tree(tmp_path)) == 3
    write(True)
    assert tree(tmp_path / "frames") == {"0": "new", "other": "old", "deep/1": "new", "deep/2": "new"}
    assert sorted(os.listdir(tmp_path / "frames")) == ["0", "deep", "other"]


def test_a_clash_beside_the_file_moves_nothing(tmp_path: Path) -> None:
    (tmp_path / "b").write_text("old")
    with pytest.raises(ConfigError, match="b: exists"), drafted(tmp_path / "a", False) as draft:
        draft.out.write_text("new")
        (draft.out.parent / "b").write_text("new")
        draft.publish()
    assert tree(tmp_path) == {"b": "old"}


@pytest.mark.parametrize("failure", [DataError, ZeroDivisionError, KeyboardInterrupt])
def test_a_failure_leaves_no_trace_and_says_where(tmp_path: Path, failure: type[BaseException]) -> None:
    (tmp_path / "a").write_text("old")
    with pytest.raises(failure) as caught, drafted(tmp_path / "a", True) as draft:
        draft.out.write_text("half")
        raise failure(f"{draft.out}: no")
    assert tree(tmp_path) == {"a": "old"} and os.listdir(tmp_path) == ["a"]
    if failure is DataError:
        assert str(caught.value) == f"{tmp_path}/a: no"
    with pytest.raises(PermissionError) as refused, drafted(tmp_path / "a", True) as draft:
        raise PermissionError(13, "Permission denied", str(draft.out))
    assert refused.value.filename == str(tmp_path / "a")


def test_files_and_folders_do_not_replace_each_other(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("old")
    with (
        pytest.raises(ConfigError, match="folder: is a folder; expected a file"),
        drafted(tmp_path / "folder", True) as draft,
    ):
        draft.out.write_text("new")
        draft.publish()
    with (
        pytest.raises(ConfigError, match="file: is a file; expected a folder"),
        drafted(tmp_path / "file", True) as draft,
    ):
        draft.out.mkdir()
        (draft.out / "x").write_text("new")
        draft.publish()
    assert tree(tmp_path) == {"file": "old"}


def test_what_is_taken(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for name in ("empty", "nothing"):
        refuse_taken(tmp_path / name, False)
    for name, text in (("full", "not empty"), ("full/x", "exists; --force"), ("dangling", "exists; --force")):
        with pytest.raises(ConfigError, match=text):
            refuse_taken(tmp_path / name, False)
        refuse_taken(tmp_path / name, True)


def test_the_working_folder_can_be_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with drafted(Path("."), False) as draft:
        draft.out.mkdir()
        (draft.out / "x").write_text("new")
        draft.publish()
    assert tree(tmp_path) == {"x": "new"}


def test_a_place_that_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError) as caught, drafted(tmp_path / "file" / "x.ply", False):
        pass
    assert caught.value.filename == str(tmp_path / "file" / "x.ply")

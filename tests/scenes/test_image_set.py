"""Generated scenes in the cache: complete or absent, drawn in threads, under a key of every setting."""

from __future__ import annotations

import dataclasses
import json
import os
import stat
import threading
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from neuprim.scenes.image_set import SceneImageSet, draw_in_parallel
from neuprim.scenes.lit import LitSettings
from neuprim.scenes.room import RoomSettings
from neuprim.scenes.solids import SolidsSettings


def quiet(text: str, fraction: float) -> None:
    pass


def numbers(engine: str = "embree", **changes: Any) -> SceneImageSet[int]:
    """A "scene" whose images are the squares of their numbers."""

    def draw(scene: Any, view: int, paths: Sequence[Path]) -> None:
        for path in paths:
            path.write_text(f"{path.name} {scene.power**view}")

    given = {
        "name": "numbers",
        "key": "abc",
        "size": 7,
        "splits": {"train": [1, 2, 3], "test": [4]},
        "lens": {"camera_angle_x": 0.5, "camera_near": 1.0},
        "build": lambda: SimpleNamespace(engine=engine, power=2),
        "frame": lambda split, view: {"file_path": f"./{split}/{view}", "other": view},
        "files": lambda view: [f"{view}.txt", f"{view}_again.txt"],
        "draw": draw,
    }
    return SceneImageSet(**{**given, **changes})  # type: ignore[arg-type]


def contents(folder: Path) -> dict[str, str]:
    return {p.relative_to(folder).as_posix(): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_files_and_transforms(tmp_path: Path) -> None:
    folder = numbers().generate(tmp_path / "new" / "cache", quiet)
    assert folder == tmp_path / "new" / "cache" / "numbers-abc"
    files = contents(folder)
    assert files.pop("transforms_test.json") == json.dumps(
        {"camera_angle_x": 0.5, "camera_near": 1.0, "frames": [{"file_path": "./test/4", "other": 4}]}, indent=1
    )
    assert [frame["other"] for frame in json.loads(files.pop("transforms_train.json"))["frames"]] == [1, 2, 3]
    expected = {}
    for split, view in (("train", 1), ("train", 2), ("train", 3), ("test", 4)):
        expected |= {f"{split}/{view}{end}": f"{view}{end} {2**view}" for end in (".txt", "_again.txt")}
    assert files == expected
    if os.name != "nt":
        assert stat.S_IMODE(folder.stat().st_mode) == 0o755


def test_what_is_complete_is_not_drawn_again_and_what_is_not_is(tmp_path: Path) -> None:
    folder = numbers().generate(tmp_path, quiet)
    whole = contents(folder)

    def never(*_: object) -> Any:
        raise AssertionError("drawn again")

    assert numbers(build=never, frame=never, draw=never).generate(tmp_path, never) == folder
    for gone in ("transforms_test.json", "train/2_again.txt"):
        (folder / gone).unlink()
        with pytest.raises(AssertionError, match="drawn again"):
            numbers(build=never).generate(tmp_path, quiet)
        assert numbers().generate(tmp_path, quiet) == folder and contents(folder) == whole
    assert os.listdir(tmp_path) == ["numbers-abc"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_what_ends_early_leaves_nothing(error: type[BaseException], tmp_path: Path) -> None:
    def draw(scene: Any, view: int, paths: Sequence[Path]) -> None:
        paths[0].touch()
        if view == 2:
            raise error

    with pytest.raises(error):
        numbers(draw=draw).generate(tmp_path, quiet)
    assert os.listdir(tmp_path) == []


def test_a_failure_cancels_what_has_not_begun() -> None:
    done = []

    def work(job: int) -> None:
        if job == 0:
            raise ValueError("first")
        threading.Event().wait(0.05)
        done.append(job)

    with pytest.raises(ValueError, match="first"):
        draw_in_parallel(work, range(200), lambda fraction: None)
    assert len(done) < 100


@pytest.mark.parametrize(
    ("settings", "key"),
    [(SolidsSettings, "326a24e0eb083720"), (LitSettings, "53a8804685091653"), (RoomSettings, "efc71f16459cf01b")],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_every_setting_is_in_the_key_and_existing_caches_stay_valid(settings: Any, key: str) -> None:
    default = settings()
    keys = {default.key()}
    for field in dataclasses.fields(settings):
        value = getattr(default, field.name)
        changed = not value if isinstance(value, bool) else value + 1
        keys.add(dataclasses.replace(default, **{field.name: changed}).key())
    assert len(keys) == 1 + len(dataclasses.fields(settings)) and default.key() == key

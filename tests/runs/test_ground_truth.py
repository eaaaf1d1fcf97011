"""Ground truth by launchers: the same bytes as by one process, whatever happens to those who make it."""

from __future__ import annotations

import errno
import hashlib
import os
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from neuprim.cli import main
from neuprim.config import RunConfig, compose
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.data.dataset import DatasetImages
from neuprim.core.errors import DataError
from neuprim.core.io import store as stores
from neuprim.core.io.vdb import write_vdb
from neuprim.runs import ground_truth
from neuprim.runs.fit import Event, Note, Preparing
from neuprim.runs.ground_truth import (
    launch_ground_truth_jobs,
    load_run_ground_truth,
    render_ground_truth_of_runs,
    split_frames_into_jobs,
)
from neuprim.runs.launch.jobs import JobStatus
from neuprim.tasks.dynamic.volume import capture
from tests.search import truth_jobs
from tests.systems import posix
from tests.tasks.dynamic.sequences import blob

FRAMES = 8
INLINE = LauncherSettings()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    for number in range(1, FRAMES + 1):
        write_vdb(folder / f"ball_{number}.vdb", blob(8.0 + number))
    return folder


def scene_words(files: Path, place: Path, *more: str) -> list[str]:
    scene = "task=dynamic scene=vdb scene.look=smoke_fire scene.size=16 scene.cameras=4 scene.samples=1".split()
    return [*scene, f"scene.vdb='{files}'", f"scene.cache='{place / 'cache'}'", *more]


def words(files: Path, place: Path, *more: str) -> list[str]:
    return scene_words(files, place, f"output_dir='{place / 'outputs' / 'run'}'", *more)


def config(files: Path, place: Path, *more: str) -> RunConfig:
    return compose(words(files, place, *more))


def contents(place: Path) -> dict[str, str]:
    """Name -> hash of every image and every frame's points."""
    found = (f for f in sorted((place / "cache" / "volumes").rglob("*")) if f.is_file())
    return {str(f.relative_to(place)): hashlib.sha256(f.read_bytes()).hexdigest() for f in found}


def made(config: RunConfig, settings: LauncherSettings = INLINE, heard: list[Event] | None = None) -> DatasetImages:
    truth = launch_ground_truth_jobs(config, settings, (heard if heard is not None else []).append)
    assert truth is not None and not truth.missing()
    return truth


@pytest.fixture(scope="module")
def alone(files: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What one process makes."""
    place = tmp_path_factory.mktemp("alone")
    made(config(files, place))
    found = contents(place)
    assert len(found) == FRAMES * 5 + 1
    return found


@posix
def test_a_killed_worker_loses_the_frame_it_was_at_and_a_slow_one_holds_up_nobody(
    files: Path, tmp_path: Path, alone: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 2)
    monkeypatch.setattr(ground_truth, "LaunchJob", truth_jobs.troubled(FRAMES))
    monkeypatch.setattr(
        ground_truth, "split_frames_into_jobs", lambda missing, workers: iter([[0], [1, 2, 3, 4], [5], [6], [7]])
    )
    heard: list[Event] = []
    made(config(files, tmp_path), LauncherSettings("processes", 2), heard)
    begun = [line.split() for line in (tmp_path / "cache" / "begun.txt").read_text().splitlines()]
    times = Counter(int(number) for number, _ in begun)
    assert times == Counter([*range(1, FRAMES + 1), truth_jobs.FATAL]), (
        "what its job had finished before was not made again"
    )
    slow = next(pid for number, pid in begun if int(number) == truth_jobs.SLOW)
    assert next(number for number, pid in begun if pid == slow) == str(truth_jobs.SLOW), (
        "the others did all that was left meanwhile"
    )
    assert contents(tmp_path) == alone, "the same bytes, and nothing half made"
    assert ["its worker died" in e.text for e in heard if isinstance(e, Note)] == [True]
    assert [e.fraction for e in heard if isinstance(e, Preparing)][-1] == 1.0
    assert [f.name for f in tmp_path.iterdir()] == ["cache"]


def test_what_is_there_is_not_made_again(
    files: Path, tmp_path: Path, alone: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import shutil

    truth = made(config(files, tmp_path))
    before = {f: f.stat().st_ino for f in Path(truth.place).rglob("*.exr")}
    shutil.rmtree(Path(truth.place) / "frame_00003")
    calls: list[int] = []
    genuine = capture.Capture.render
    monkeypatch.setattr(
        capture.Capture, "render", lambda self, frame, to: calls.append(frame.number) or genuine(self, frame, to)
    )
    made(config(files, tmp_path))
    assert calls == [3] and contents(tmp_path) == alone
    assert all(f.stat().st_ino == inode for f, inode in before.items() if f.parent.name != "frame_00003")
    made(config(files, tmp_path))
    assert calls == [3]


def test_two_makers_at_once_and_a_job_that_is_done_twice(files: Path, tmp_path: Path, alone: dict[str, str]) -> None:
    there, errors = config(files, tmp_path), []
    first = load_run_ground_truth(there)
    assert first is not None
    first.begin()
    data = {"config": there.to_dict(), "known": dict(first.known), "key": first.key, "frames": list(range(FRAMES))}

    def work() -> None:
        try:
            assert ground_truth.render_frames_job(data, 0, lambda event: None) == FRAMES
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    ground_truth._loaded.clear()
    first.write(0, lambda text: None)  # type: ignore[attr-defined]  # as one that has not seen that it is there
    assert errors == []
    first.complete()
    assert contents(tmp_path) == alone


def test_a_full_disk_is_one_line_and_leaves_nothing_half_made(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    genuine = capture.write_exr

    def write(path: Path, *args: Any, **more: Any) -> None:
        if "frame_00003" in str(path) and path.name == "cam_02.exr":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        genuine(path, *args, **more)

    monkeypatch.setattr(capture, "write_exr", write)
    with pytest.raises(DataError) as caught:
        made(config(files, tmp_path, "scene.frames='1:4'"))
    place = next((tmp_path / "cache" / "volumes").iterdir())
    why = "No space left on device; finished frames are kept (2 of 4 frames are missing)"
    assert str(caught.value) == f"cannot write the rendered images to {place}: {why}"
    assert sorted(f.name for f in place.iterdir()) == ["frame_00001", "frame_00002"]
    assert [f.name for f in tmp_path.iterdir()] == ["cache"]


def vanishing(monkeypatch: pytest.MonkeyPatch, cache: Path, away: Path, back: bool) -> None:
    """The cache is renamed away in the middle of a frame, and back or not."""
    genuine, gone = capture.write_exr, list[threading.Timer]()

    def write(path: Path, *args: Any, **more: Any) -> None:
        if "frame_00003" in str(path) and path.name == "cam_02.exr" and not gone:
            cache.rename(away)
            gone.append(threading.Timer(0.4 if back else 1e6, away.rename, (cache,)))
            gone[0].daemon = True
            gone[0].start()
        genuine(path, *args, **more)

    monkeypatch.setattr(capture, "write_exr", write)
    monkeypatch.setattr(stores, "POLL_INTERVAL", 0.05)
    monkeypatch.setattr(stores, "MAX_WAIT", 30.0 if back else 0.5)


@posix
def test_a_shared_folder_that_vanishes_and_comes_back(
    files: Path, tmp_path: Path, alone: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    vanishing(monkeypatch, tmp_path / "cache", tmp_path / "away", back=True)
    heard: list[Event] = []
    made(config(files, tmp_path), heard=heard)
    assert contents(tmp_path) == alone
    said = [event.text for event in heard if isinstance(event, Note)]
    assert said and said[0].startswith("waiting for ") and said[0].endswith(", which is gone")


@posix
def test_a_shared_folder_that_vanishes_for_good(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cache, away = tmp_path / "cache", tmp_path / "away"
    vanishing(monkeypatch, cache, away, back=False)
    assert main(["truth", *scene_words(files, tmp_path)]) == 2
    (place,) = (away / "volumes").iterdir()
    line = capsys.readouterr().err.splitlines()[-1]
    gone = f"neuprim: error: {cache / 'volumes' / place.name}: the folder disappeared and was missing for 0 s"
    assert line.startswith(gone) and not cache.exists(), "nothing is written in its place"
    assert sorted(f.name for f in place.glob("frame*")) == ["frame_00001", "frame_00002"]


def test_jobs_get_smaller_towards_the_end() -> None:
    parts = list(split_frames_into_jobs(range(1000), 2))
    assert [n for part in parts for n in part] == list(range(1000))
    sizes = [len(part) for part in parts]
    assert sizes == sorted(sizes, reverse=True) and sizes[0] == 16 and sizes[-7:] == [1] * 7
    assert [len(part) for part in split_frames_into_jobs([4, 9], 8)] == [1, 1] and list(
        split_frames_into_jobs([], 2)
    ) == []


def test_other_files_where_a_worker_is_are_refused(files: Path, tmp_path: Path) -> None:
    there = config(files, tmp_path)
    truth = load_run_ground_truth(there)
    assert truth is not None
    with pytest.raises(DataError, match=r"a worker has other scene files than the launcher"):
        ground_truth.render_frames_job(
            {"config": there.to_dict(), "known": truth.known, "key": "0" * 16, "frames": [0]}, 0, lambda event: None
        )
    ground_truth._loaded.clear()


def test_runs_that_share_a_scene_wait_for_it_together_and_a_broken_one_holds_up_none(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[RunConfig] = []

    def make(config: RunConfig, settings: LauncherSettings, events: Any) -> None:
        asked.append(config)
        events(Preparing("rendering", 0.5))
        if config.scene["size"] == 24:
            raise DataError("broken")

    monkeypatch.setattr(ground_truth, "launch_ground_truth_jobs", make)
    configs = [
        config(files, tmp_path, f"scene.size={size}", f"model.primitives={n}") for size in (24, 16) for n in (10, 20)
    ]
    heard: list[tuple[int, JobStatus]] = []
    render_ground_truth_of_runs(
        configs, LauncherSettings("processes"), lambda number, status: heard.append((number, status))
    )
    assert [c.scene["size"] for c in asked] == [24, 16] and [n for n, _ in heard] == [0, 1, 2, 3]
    assert {s for _, s in heard} == {JobStatus("waiting", "rendering, 50%", progress=0.5)}
    render_ground_truth_of_runs(configs, INLINE, lambda number, status: pytest.fail("left to the runs"))


def test_the_command_says_where_it_is_or_why_not(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["truth", *scene_words(files, tmp_path, "scene.frames='1:2'")]) == 0
    out = capsys.readouterr().out.strip()
    assert sorted(f.name for f in Path(out).iterdir()) == ["frame_00001", "frame_00002", "scene.json"]
    assert main(["truth", "-m", *scene_words(files, tmp_path, "scene.frames='1:1','2:2'")]) == 0
    assert len(capsys.readouterr().out.split()) == 2
    assert main(["truth", "task=static", "scene=solids"]) == 2
    assert "scene=solids: its images are not rendered frame by frame" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("launcher", [["launcher=ray"], ["launcher=slurm", "launcher.address=local"]])
def test_on_a_cluster(files: Path, tmp_path: Path, alone: dict[str, str], launcher: list[str]) -> None:
    pytest.importorskip("ray" if launcher[0].endswith("ray") else "submitit")
    begun = time.monotonic()
    assert main(["truth", *scene_words(files, tmp_path), *launcher, "launcher.workers=2", "launcher.threads=1"]) == 0
    assert contents(tmp_path) == alone and time.monotonic() - begun < 250

"""One process at a time in a directory, and nothing to clear up after a kill."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from neuprim.core.errors import ConfigError
from neuprim.runs.open import LOCK_FILE, lock_run_directory
from tests.runs.launching import wait_for
from tests.systems import posix

HOLD = (
    "import sys, time; from pathlib import Path; from neuprim.runs.open import lock_run_directory\nwith "
    "lock_run_directory(Path(sys.argv[1])): time.sleep(600)"
)


def test_a_second_one_is_refused_by_name_and_the_first_is_left_alone(tmp_path: Path) -> None:
    with lock_run_directory(tmp_path / "run"):
        for _ in range(2):
            with pytest.raises(ConfigError) as error, lock_run_directory(tmp_path / "run", "sweep"):
                pytest.fail("two at once")
            found = f"{tmp_path / 'run'}: process {os.getpid()} on {socket.gethostname()} (since "
            assert str(error.value).startswith(found) and "is using this sweep; wait until it ends" in str(error.value)
        refused: list[str] = []

        def other() -> None:
            try:
                with lock_run_directory(tmp_path / "run"):
                    pass
            except ConfigError as error:
                refused.append(str(error))

        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        assert len(refused) == 1 and (tmp_path / "run" / LOCK_FILE).exists()
    assert not (tmp_path / "run").exists(), "nothing was put into it"


def test_what_was_there_stays(tmp_path: Path) -> None:
    with lock_run_directory(tmp_path / "run"):
        (tmp_path / "run" / "x").touch()
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["x"]
    (tmp_path / "empty").mkdir()
    with lock_run_directory(tmp_path / "empty"):
        pass
    assert (tmp_path / "empty").is_dir()


@posix
def test_a_killed_process_lets_go(tmp_path: Path) -> None:
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)])
    try:
        wait_for(tmp_path / LOCK_FILE)
        while not (tmp_path / LOCK_FILE).read_text():
            pass
        with pytest.raises(ConfigError, match=f"process {other.pid} on"), lock_run_directory(tmp_path):
            pass
    finally:
        other.kill()
        other.wait()
    with lock_run_directory(tmp_path):
        assert f'"pid": {os.getpid()}' in (tmp_path / LOCK_FILE).read_text()


@posix
def test_what_killed_writers_left_is_gone_and_what_others_write_stays(tmp_path: Path) -> None:
    writer = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    run = tmp_path / "run"
    (run / "renders").mkdir(parents=True)
    dead = [run / f".model.safetensors.{ended.pid}.abcd1234.tmp", run / f"renders/.a.png.{ended.pid}.abcd1234.tmp"]
    kept = [run / f".b.npz.{writer.pid}.abcd1234.tmp", run / "model.safetensors", run / ".hidden", run / ".notes.tmp"]
    draft = run / f".neuprim.{ended.pid}.abcd1234"
    draft.mkdir()
    for path in (draft / "out", *dead, *kept):
        path.touch()
    try:
        with lock_run_directory(run):
            assert all(path.exists() for path in kept) and not any(path.exists() for path in (draft, *dead))
    finally:
        writer.kill()
        writer.wait()

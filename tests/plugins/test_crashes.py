"""One mechanism tells the crashes of every kind of plugin: what its guards have in common, and in what they differ."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from neuprim.core.errors import ConfigError
from neuprim.plugins import blame, crashes
from neuprim.plugins.blame import Suspects, blamed, reported
from neuprim.plugins.mechanism import PluginError, PluginInfo
from neuprim.plugins.registry import EXPORTERS
from neuprim.version import __version__

THEIRS = PluginInfo("x", "fake-x", "0.1", "a_package_of_theirs:X")


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    monkeypatch.setattr(blame, "origin_of", lambda group, word: THEIRS)
    return folder


def guard(kind: str, folder: Path | None = None) -> blamed:
    return (
        blamed(THEIRS, "exporter 'x'", folder)
        if kind == "call"
        else reported(EXPORTERS, "x", [] if folder is None else [folder])
    )


def crash(kind: str, error: BaseException, folder: Path | None = None) -> str:
    def theirs() -> None:
        raise error

    with pytest.raises(PluginError) as caught, guard(kind, folder):
        theirs()
    return str(caught.value)


@pytest.mark.parametrize("kind", ["call", "work"])
def test_the_file_is_the_same_whoever_crashed(kind: str, temporary: Path) -> None:
    message = crash(kind, ValueError("a\n  b"))
    path = Path(message.rpartition(" ")[2])
    assert path.parent == temporary and f"; traceback{':' if kind == 'call' else ' in'} {path}" in message
    assert path.name.startswith("fake-x-exporter_x-2" if kind == "call" else "exporter-x-2")
    first, empty, then = path.read_text().splitlines()[:3]
    python = ".".join(map(str, sys.version_info[:3]))
    assert first == f"exporter 'x' of fake-x 0.1 (a_package_of_theirs:X), neuprim {__version__}, Python {python}"
    assert (empty, then) == ("", "Traceback (most recent call last):")


@pytest.mark.parametrize("kind", ["call", "work"])
def test_no_folder_is_made_in_a_directory_that_holds_nothing(kind: str, temporary: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    assert str(temporary) in crash(kind, ValueError(), run / "logs") and not any(run.iterdir())
    (run / "config.yaml").touch()
    assert str(run / "logs") in crash(kind, ValueError(), run / "logs")


def test_a_disk_is_the_exporters_excuse_and_not_the_loaders(tmp_path: Path) -> None:
    full = OSError(28, "No space left on device", "file")
    assert crash("call", full).startswith(
        "exporter 'x' of fake-x 0.1: OSError: [Errno 28] No space left on device: 'file'; traceback: "
    )
    with pytest.raises(OSError, match="No space"), guard("work"):
        raise full
    assert "crashed: OSError: [Errno 9]" in crash("work", OSError(9, "Bad file descriptor")), (
        "which is no disk's refusal"
    )


@pytest.mark.parametrize("kind", ["call", "work"])
def test_what_neuprim_lends_a_plugin_is_not_its_fault(kind: str, temporary: Path) -> None:
    from neuprim.core.io.files import write_json

    with pytest.raises(TypeError, match="not JSON serializable"), guard(kind):
        write_json(temporary / "x.json", object())
    assert not any(p.suffix == ".txt" for p in temporary.iterdir())


@pytest.mark.parametrize("kind", ["call", "work"])
def test_a_guard_may_be_entered_again(kind: str, temporary: Path) -> None:
    again = guard(kind)
    for _ in range(2):
        with pytest.raises(PluginError), again:
            (lambda: 1 / 0)()
    with pytest.raises(ConfigError, match=r"^mine$"), again:
        raise ConfigError("mine")
    assert len(list(temporary.iterdir())) == 2


def test_where_nothing_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crashes, "written", lambda *_: None)
    line = r"^exporter 'x' of fake-x 0\.1: ZeroDivisionError: division by zero; its traceback could not be written anywhere$"
    with pytest.raises(PluginError, match=line), guard("call"):
        (lambda: 1 / 0)()
    with pytest.raises(ZeroDivisionError), guard("work"):
        (lambda: 1 / 0)()
    suspects = Suspects("static", "solids", None)
    suspects.task.modules.add(__name__.partition(".")[0])
    with pytest.raises(
        PluginError,
        match=re.escape("task 'static' of fake-x 0.1: ZeroDivisionError: division by zero (test_crashes.py line"),
    ):
        with suspects.watch():
            (lambda: 1 / 0)()

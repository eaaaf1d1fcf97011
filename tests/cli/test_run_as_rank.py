"""What a rank does before and around its training: where it writes, on which cores and card, and who speaks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.cli import main
from neuprim.cli.ranks import _choose_card, _composed, run_as_rank
from neuprim.config import compose
from neuprim.core.compute import threads
from neuprim.core.errors import BackendUnavailable, ConfigError, RankError
from neuprim.core.train.distributed import wire
from neuprim.core.train.distributed.group import Group
from neuprim.core.train.distributed.place import Place
from tests.ranks import Threads, done, together

WORDS = ["task=static", "scene=solids"]
ALL = {
    "RANK": "0",
    "WORLD_SIZE": "2",
    "LOCAL_RANK": "0",
    "LOCAL_WORLD_SIZE": "2",
    "MASTER_ADDR": "here",
    "MASTER_PORT": "1",
}


def test_all_ranks_write_where_the_first_one_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its directory is the next free name; another that looked later would take the one after it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs" / "static-solids").mkdir(parents=True)

    def work(group: Group) -> Path:
        if group.first:
            config = _composed(WORDS, False, group)
            return config.output_dir
        (tmp_path / "outputs" / "static-solids-2").mkdir()
        return _composed(WORDS, False, group).output_dir

    places = done(together(2, work))
    assert places[0] == places[1]


@pytest.mark.parametrize(
    "words",
    [
        [*WORDS, "target.psnr=30", "budget=10m"],
        [*WORDS, "launcher=processes"],
        [*WORDS, "viewer=true"],
        [*WORDS, "output_dir=taken"],
    ],
)
def test_what_the_first_rank_refuses_the_others_do_not_repeat(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").touch()
    first, second = together(2, lambda group: _composed(words, False, group))
    assert isinstance(first, ConfigError) and isinstance(second, RankError) and second.told


def test_one_run_alone_is_shared(tmp_path: Path) -> None:
    first, _ = together(2, lambda group: _composed(WORDS, True, group))
    assert isinstance(first, ConfigError)
    assert (
        str(first)
        == "2 processes of torchrun fit one scene together; expected neither -m, --config, --cfg, a target, a launcher, nor a viewer"
    )


@pytest.mark.parametrize(
    ("cards", "device", "wrong"),
    [(0, "auto", False), (1, "cpu", False), (2, "auto", False), (1, "auto", True), (1, "cuda", True)],
)
def test_a_card_for_each_rank(cards: int, device: str, wrong: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[int] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cards > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: cards)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    config = compose(WORDS, check_output=False)
    config = replace(config, renderer=replace(config.renderer, device=device))
    if wrong:
        with pytest.raises(
            BackendUnavailable,
            match=rf"renderer\.device={device}: 1 cards? for 2 ranks of this machine; expected a card for each",
        ):
            _choose_card(config, Place(1, 2, 1, 2, ""))
    else:
        _choose_card(config, Place(1, 2, 1, 2, ""))
    assert chosen == ([1] if cards == 2 else [])


class _Lonely:
    """A wire whose other end says what this one does."""

    hosted = False

    def __init__(self, place: Place, environment: Any) -> None:
        self.store = Threads(1).store

    def swap(self, rows: torch.Tensor, found: torch.Tensor) -> None:
        found.copy_(rows)

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("machine", "ranks", "own"), [(8, 2, 4), (5, 2, 2), (1, 2, 1)])
def test_cores_are_shared_out(
    machine: int, ranks: int, own: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from neuprim.cli import ranks as module

    found: list[int] = []
    monkeypatch.setattr(threads, "machine_cores", lambda: machine)
    monkeypatch.setattr(wire, "Wire", _Lonely)
    monkeypatch.setattr(module, "_fit", lambda *_: found.append(threads.core_count()) or False)
    assert run_as_rank(Place(0, ranks, 0, ranks, ""), [*WORDS, f"output_dir={tmp_path / 'out'}"], False) == 0
    assert found == [own] and threads.core_count() == machine


def test_a_bug_keeps_its_traceback_and_names_the_rank(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from neuprim.cli import ranks as module

    def broken(*_: Any) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(wire, "Wire", _Lonely)
    monkeypatch.setattr(module, "_fit", broken)
    with pytest.raises(ZeroDivisionError):
        run_as_rank(Place(0, 2, 0, 2, ""), [*WORDS, f"output_dir={tmp_path / 'out'}"], False)
    assert "neuprim: rank 0 failed:" in capsys.readouterr().err


def test_half_an_environment_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ALL:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert main(["run", *WORDS]) == 2
    assert capsys.readouterr().err == (
        "neuprim: error: environment: WORLD_SIZE without RANK, LOCAL_RANK, LOCAL_WORLD_SIZE, MASTER_ADDR, MASTER_PORT; "
        "expected all that torchrun sets, or none\n"
    )


def test_nobody_to_meet_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from datetime import timedelta

    monkeypatch.setattr(wire, "MEETING", timedelta(seconds=1))
    for name, value in {**ALL, "RANK": "1", "LOCAL_RANK": "1", "MASTER_ADDR": "localhost"}.items():
        monkeypatch.setenv(name, value)
    assert main(["run", *WORDS]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("neuprim")]
    assert line.startswith("neuprim: error: rank 1 of 2 cannot meet the others at localhost:1 (")

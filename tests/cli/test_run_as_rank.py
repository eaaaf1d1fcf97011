"""What a rank does before and around its training: where it writes, on which cores and GPU, and who reports errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist

from neuprim.cli import main
from neuprim.cli.run_commands import _compose_rank_arguments, _select_rank_gpu, run_command_as_rank
from neuprim.config import compose
from neuprim.core.compute import threads
from neuprim.core.errors import BackendUnavailable, ConfigError, RankError
from neuprim.core.train import process_group
from neuprim.core.train.process_group import ProcessGroup, TorchrunRank
from tests.ranks import ThreadGroup, results, run_ranks

WORDS = ["task=static", "scene=solids"]
SECOND = {"RANK": "1", "LOCAL_RANK": "1", "MASTER_ADDR": "localhost", "MASTER_PORT": "1"}
SECOND |= {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2"}


def test_all_ranks_write_where_the_first_one_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its directory is the next free name; another that looked later would take the one after it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs" / "static-solids").mkdir(parents=True)

    def work(group: ProcessGroup) -> Path:
        if group.is_first:
            config = _compose_rank_arguments(WORDS, False, group)
            return config.output_dir
        (tmp_path / "outputs" / "static-solids-2").mkdir()
        return _compose_rank_arguments(WORDS, False, group).output_dir

    places = results(run_ranks(2, work))
    assert places[0] == places[1]


@pytest.mark.parametrize(
    "words", ["target.psnr=30 budget=10m", "launcher=processes", "viewer=true", "output_dir=taken"]
)
def test_what_the_first_rank_refuses_the_others_do_not_repeat(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").touch()
    first, second = run_ranks(2, lambda group: _compose_rank_arguments([*WORDS, *words.split()], False, group))
    assert isinstance(first, ConfigError) and isinstance(second, RankError) and second.reported


def test_one_run_alone_is_shared(tmp_path: Path) -> None:
    first, _ = run_ranks(2, lambda group: _compose_rank_arguments(WORDS, True, group))
    assert isinstance(first, ConfigError)
    assert str(first).startswith("the 2 processes of torchrun train one run together; leave out -m, --config")


@pytest.mark.parametrize(
    ("gpus", "device", "wrong"),
    [(0, "auto", False), (1, "cpu", False), (2, "auto", False), (1, "auto", True), (1, "cuda", True)],
)
def test_a_gpu_for_each_rank(gpus: int, device: str, wrong: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[int] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    config = compose(WORDS, check_output=False)
    config = replace(config, renderer=replace(config.renderer, device=device))
    if wrong:
        with pytest.raises(
            BackendUnavailable, match=rf"renderer\.device={device}: this machine has 1 GPUs for 2 ranks"
        ):
            _select_rank_gpu(config, TorchrunRank(1, 2, 1, 2, ""))
    else:
        _select_rank_gpu(config, TorchrunRank(1, 2, 1, 2, ""))
    assert chosen == ([1] if gpus == 2 else [])


class _Lonely(ThreadGroup):
    """Rank 0, whose messages come back as those of all."""

    def __init__(self, place: TorchrunRank, environment: Any) -> None:
        self.place, self.rank, self.size, self.store = place, place.rank, place.size, dist.HashStore()

    def gather(self, value: Any) -> list[Any]:
        return [value] * self.size

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("machine", "ranks", "own"), [(5, 2, 2), (1, 2, 1)])
def test_cores_are_shared_out(
    machine: int, ranks: int, own: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found: list[int] = []
    monkeypatch.setattr(threads, "machine_cores", lambda: machine)
    monkeypatch.setattr(process_group, "ProcessGroup", _Lonely)
    monkeypatch.setattr(
        "neuprim.cli.run_commands._fit_with_rank_progress", lambda *_: found.append(threads.core_count())
    )
    assert (
        run_command_as_rank(TorchrunRank(0, ranks, 0, ranks, ""), [*WORDS, f"output_dir={tmp_path / 'out'}"], False)
        == 0
    )
    assert found == [own] and threads.core_count() == machine


def test_a_bug_keeps_its_traceback_and_names_the_rank(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: Any) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(process_group, "ProcessGroup", _Lonely)
    monkeypatch.setattr("neuprim.cli.run_commands._fit_with_rank_progress", broken)
    with pytest.raises(ZeroDivisionError):
        run_command_as_rank(TorchrunRank(0, 2, 0, 2, ""), [*WORDS, f"output_dir={tmp_path / 'out'}"], False)
    assert "neuprim: rank 0 failed:" in capsys.readouterr().err


def test_nobody_to_meet_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from datetime import timedelta

    monkeypatch.setattr(process_group, "MEETING", timedelta(seconds=1))
    for name, value in SECOND.items():
        monkeypatch.setenv(name, value)
    assert main(["run", *WORDS]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("neuprim")]
    assert line.startswith(
        "neuprim: error: rank 1 of 2 cannot connect to the other ranks at MASTER_ADDR:MASTER_PORT=localhost:1 ("
    )

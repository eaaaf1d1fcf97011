"""A card whose memory is full is one line, whatever the command; other faults are not taken for it."""

from __future__ import annotations

import pytest
import torch

from neuprim import cli


def test_it_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def full(words: list[str]) -> int:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")

    monkeypatch.setattr(cli, "_dispatch", full)
    assert cli.main(["render", "run"]) == 2
    line = capsys.readouterr().err
    assert (
        line.startswith("neuprim: error: the card's memory is full; expected a smaller image or grid")
        and line.count("\n") == 1
    )


def test_another_fault_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(words: list[str]) -> int:
        raise RuntimeError("out of luck")

    monkeypatch.setattr(cli, "_dispatch", broken)
    with pytest.raises(RuntimeError, match="out of luck"):
        cli.main(["render", "run"])

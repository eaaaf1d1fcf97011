"""What a hit costs is counted from what a disassembler lists, and stands in the documentation as it was recorded."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

BENCHMARKS = Path(__file__).parents[4] / "benchmarks"
LISTING = """
.text.kernel:
        /*0000*/                   MOV R1, c[0x0][0x28] ;
.L_x_1:
        /*0010*/                   LDG.E R4, desc[UR6][R4.64] ;
.L_x_2:
        /*0020*/              @!P0 BRA `(.L_x_3) ;
        /*0030*/                   FFMA.FTZ R5, R4, R4, R5 ;
        /*0040*/              @P1  FMUL.FTZ R5, R5, R4 ;
        /*0050*/                   FADD.FTZ R5, R5, R4 ;
.L_x_3:
        /*0060*/              @P0  BRA `(.L_x_2) ;
        /*0070*/                   FADD.FTZ R6, R5, R4 ;
        /*0080*/              @P2  BRA `(.L_x_1) ;
        /*0090*/                   EXIT ;
"""


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/gpu_hits.py"""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return importlib.import_module("gpu_hits")


def test_the_innermost_loop_is_counted(script: ModuleType) -> None:
    sass = importlib.import_module("shared.sass")
    loop, whole = sass.hot_loop(LISTING, "FFMA")
    assert whole == 10 and dict(loop) == {"BRA": 2, "FFMA": 1, "FMUL": 1, "FADD": 1} and sass.flops(loop) == 4
    with pytest.raises(ValueError, match="no loop with MUFU"):
        sass.hot_loop(LISTING, "MUFU")


def test_a_missing_disassembler_is_one_line(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["gpu_hits.py"])
    monkeypatch.setattr(script, "find_nvdisasm", lambda: None)
    assert script.main() == 1
    assert (
        capsys.readouterr().err
        == "nvdisasm is missing: pip install nvidia-cuda-nvdisasm, or name one with --nvdisasm\n"
    )


def test_lanes_are_those_of_a_frame(script: ModuleType) -> None:
    """Of a small one: pixels that hit are some of the slots, and no warp is fuller than full."""
    seen = script.lanes(300, 48, 2)
    assert 0 < seen.hits <= seen.slots and seen.hits <= 32 * seen.steps and seen.hits <= 32 * seen.patches
    assert seen.patches <= 8 * seen.pairs and seen.steps >= seen.slots / 32 * 0.5
    share, ms = script.predicted("forward", {"instructions": 100}, seen)
    assert share == pytest.approx(seen.hits / (32 * seen.patches)) and ms == pytest.approx(
        1e3 * 3200 * seen.patches / script.RATE
    )


def test_the_page_has_what_was_recorded(script: ModuleType) -> None:
    """And a hit costs no more than it was planned to: the study's, and forward what pairs in float64 and faint chords
    add."""
    record = json.loads(script.RESULTS.read_text(encoding="utf-8"))
    page = script.PAGE.read_text(encoding="utf-8")
    assert f"<!-- gpu-hits -->\n{script.document(record)}\n<!-- /gpu-hits -->" in page
    paper = {row["kernel"]: row for row in record["rows"] if row["neurons"] == 8}
    assert (
        paper["pairs"]["instructions"] <= script.STUDY["pairs"]
        and paper["forward"]["instructions"] <= 1.05 * script.STUDY["forward"]
    )
    scene = record["scene"]
    assert (8 * scene["slots"] + 36 * scene["pairs"]) / scene["hits"] < 14.0  # bytes a hit; whole tiles would take 50
    for row in record["rows"]:
        assert row["measured_ms"] is None or row["full_issue_ms"] < row["measured_ms"], row

"""The benchmark of static scenes and relighting: rows are measured once, published figures stand beside them."""

from __future__ import annotations

import importlib
import json
import sys
from argparse import Namespace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.docs.pages import ROOT


@pytest.fixture
def quality(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return importlib.import_module("quality")


def make_run(scene: str, size: str, **more: Any) -> dict[str, Any]:
    """A recorded row of 2,000 bytes a primitive."""
    row = {"scene": scene, "size": size, "settings": "", "budget": "240 s", "cpu_seconds": 240.0, "primitives": 100}
    return row | {"model_bytes": 200_000, "psnr": 30.0, "ssim_3dgs": 0.95, "frame_ms": 12.34} | more


def test_published_rows_are_those_of_the_scene_and_its_size(quality: ModuleType) -> None:
    rows = {row["method"]: row["psnr"] for row in quality.published_rows("mic_800,scene.hold_out=8", "800×800")}
    assert rows["the paper, 5k"] == 34.01 and rows["3DGS nolimit"] == 35.36 and rows["HAC++, small"] == 35.21
    peer = list(quality.published_rows("chair_200", "200×200"))
    assert {row["method"] for row in peer} == {"OpenSplat 1.2"} and len(peer) == 2
    assert not list(quality.published_rows("mic", "400×400")) and not list(quality.published_rows("solids", "800×800"))


def test_tables(quality: ModuleType) -> None:
    runs = [make_run("mic_800", "800×800", psnr=psnr) for psnr in (30.0, 31.0)]
    runs.append(make_run("mic_800", "800×800", settings="model.primitives=100", cpu_seconds=1.0))
    lines = quality.table({"cpu": "a CPU", "trials": runs}).splitlines()
    assert lines[2].startswith(
        "| mic_800, 800×800 | neuprim, `model.primitives=100` | 240 s | 100 | 200,000 | – | 30.00 |"
    )
    assert "| 30.50 ± 0.50 | – | – | 0.9500 ± 0.0000 | – | 12.3 |" in lines[3]
    assert any("the paper, 5k | – | – | – | – | 34.01 |" in line for line in lines)


@pytest.mark.parametrize("tune", [True, False])
def test_rows_are_measured_once(
    quality: ModuleType, tune: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tiny budget in seconds of the CPU; a second call has nothing left to do."""
    scene = "solids,scene.size=24,scene.train_views=16,scene.test_views=2,scene.supersampling=1"
    args = Namespace(
        scenes=[scene], seconds=[0.2], steps=[], seeds=1, set=["model.primitives=30"], tune=tune, lpips=None
    )
    (trial,) = quality.plan(args)
    monkeypatch.setattr(quality, "COMPRESS_SECONDS", 0.0)
    row = quality.measure_row((trial, tmp_path / "runs"), 0, lambda event: None)
    assert (row["budget"], row["size"], row["settings"]) == ("0.2 s", "24×24", "model.primitives=30")
    assert 0.2 <= row["cpu_seconds"] < 1.0 and row["iterations"] > 1
    assert row["frame_ms"] > 0 and row["psnr"] > 10
    if tune:  # looks at no test view, and compression would
        assert "compressed_bytes" not in row and "psnr_compressed" not in row
    else:
        assert row["compressed_bytes"] < row["model_bytes"] and row["psnr_compressed"] > 10
    record = tmp_path / "static.json"
    record.write_text(json.dumps({"cpu": "a CPU", "trials": [row]}), encoding="utf-8")
    words = ["--seconds", "0.2", "--seeds", "1", "--set", "model.primitives=30", "--record", str(record)]
    monkeypatch.setattr(sys, "argv", ["quality.py", scene, *words, *(["--tune"] if tune else [])])
    monkeypatch.setattr(quality, "measure_row", None)
    quality.main()
    assert json.loads(record.read_text(encoding="utf-8"))["trials"] == [row]
    assert record.with_suffix(".md").read_text(encoding="utf-8").count("24×24") == 1

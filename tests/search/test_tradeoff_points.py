"""Records of trade-offs: round trip, table, and damaged files."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from neuprim.core.errors import DataError
from neuprim.search.tradeoff_record import (
    COMBINED,
    REFERENCE,
    LeftOutPoint,
    TradeoffPoint,
    TradeoffRecord,
    read_tradeoff_record,
    write_tradeoff_csv,
)


def drawn(*words: str, psnr: float = 30.0, ratio: float = 1.0, size: int = 100) -> TradeoffPoint:
    quality = {"psnr": psnr, "ssim": 0.9, "ssim_3dgs": 0.91, "psnr_exact": float("inf"), "lpips_3dgs": 0.2}
    return TradeoffPoint(COMBINED if words else REFERENCE, words, quality, size, [10 * ratio] * 3, [ratio] * 3)


def trained(name: str, psnr: float, seconds: float = 2.0) -> TradeoffPoint:
    point = drawn(f"model.neurons={name}", psnr=psnr)
    point.turned, point.run_dir, point.primitives, point.steps, point.seconds = (
        (f"model.neurons={name}",),
        "trials/a",
        40,
        20,
        seconds,
    )
    point.centre_ms, point.seeds = 20.0, (psnr, psnr + 1)
    return point


@pytest.mark.parametrize("points", [[drawn(), drawn("renderer.sort=entry", psnr=29, ratio=0.5)], [trained("1", 20.0)]])
def test_what_is_written_is_read(points: list[TradeoffPoint], tmp_path: Path) -> None:
    record = TradeoffRecord({"views": ["a"]}, {"task": "static"}, points, [LeftOutPoint("a", ("b=1",), "why")])
    record.find_fronts(lambda p: True, lambda p: p is points[0])
    record.write(tmp_path / "tradeoff.json")
    assert (
        read_tradeoff_record(tmp_path / "tradeoff.json") == record
        and read_tradeoff_record(tmp_path / "none.json") is None
    )
    assert record.size == [0] and record.speed == list(range(len(points)))


def test_derived_numbers() -> None:
    point = drawn()
    point.ratios = [1.0, 2.0, 3.0, 4.0, 5.0]
    assert point.ratio == 3.0 and point.spread == 1.0 and point.doubt == pytest.approx(3.14 / 5**0.5)
    model = trained("2", 20.0)
    assert model.name == "neurons=2" and model.time == 20.0 and model.ms_per_step == 100.0
    assert model.seed_spread == pytest.approx(0.5**0.5)


def test_the_table_has_the_columns_of_the_survey(tmp_path: Path) -> None:
    record = TradeoffRecord(
        {"lpips": "vgg"}, {}, [drawn(), drawn("renderer.sort=entry", ratio=0.5)], speed=[1], size=[0]
    )
    write_tradeoff_csv(tmp_path / "a.csv", record, 40)
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert rows[0]["Submethod"] == "as the run draws" and rows[1]["Submethod"] == "sort=entry"
    assert (
        [row["#Gaussians"] for row in rows] == ["40", "40"] and rows[0]["LPIPS"] == "0.2" and rows[0]["SSIM"] == "0.91"
    )
    assert rows[1]["time ratio"] == "0.5000" and rows[1]["speed front"] == "1" and rows[1]["size front"] == "0"
    record.same["lpips"] = "alex"
    write_tradeoff_csv(tmp_path / "a.csv", TradeoffRecord({}, {}, [trained("1", 20.0)]))
    (row,) = csv.DictReader((tmp_path / "a.csv").open())
    assert row["command"] == "neuprim run model.neurons=1" and row["LPIPS"] == "" and row["training steps"] == "20"


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data.pop("points"),
        lambda data: data.update(format=7),
        lambda data: data["front"].update(speed=[5]),
        lambda data: data["front"].update(size=["x"]),
        lambda data: data["points"][0].update(ms=[-1.0]),
        lambda data: data["points"][0].update(words="abc"),
        lambda data: data["points"][0].pop("quality"),
        lambda data: data.update(points=[]),
        lambda data: data.update(left_out=[{"knob": 1}]),
    ],
)
def test_damaged_records_are_refused(change: Any, tmp_path: Path) -> None:
    path = tmp_path / "tradeoff.json"
    TradeoffRecord({}, {}, [drawn()], speed=[0], size=[0]).write(path)
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(DataError, match=r"tradeoff\.json: .*delete it to measure anew"):
        read_tradeoff_record(path)

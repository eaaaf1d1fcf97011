"""Trade-offs: records, damaged files, Pareto fronts against brute force, and combinations of changes."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuprim.core.errors import DataError
from neuprim.search.tradeoff_record import (
    COMBINED,
    REFERENCE,
    LeftOutPoint,
    Objectives,
    ParetoStep,
    TradeoffPoint,
    TradeoffRecord,
    chain_pareto_steps,
    combine_pareto_steps,
    pareto_front,
    read_tradeoff_record,
    thin_pareto_chain,
)


def drawn(*words: str, psnr: float = 30.0, ratio: float = 1.0, size: int = 100) -> TradeoffPoint:
    quality = {"psnr": psnr, "ssim": 0.9, "ssim_3dgs": 0.91, "lpips_3dgs": 0.2}
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
    point.centre_ms = 20.0
    return point


@pytest.mark.parametrize("points", [[drawn(), drawn("renderer.sort=entry", psnr=29, ratio=0.5)], [trained("1", 20.0)]])
def test_what_is_written_is_read(points: list[TradeoffPoint], tmp_path: Path) -> None:
    record = TradeoffRecord({"views": ["a"]}, {"task": "static"}, points, [LeftOutPoint("a", ("b=1",), "why")])
    record.find_fronts(lambda p: p is points[0])
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


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data.pop("points"),
        lambda data: data["front"].update(speed=[5]),
        lambda data: data["points"][0].update(ms=[-1.0]),
        lambda data: data.update(points=[]),
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


# ---------------------------------------------------------------- Pareto fronts

VALUES = st.integers(0, 6).map(float)
POINTS = st.lists(st.tuples(VALUES, VALUES).map(lambda pair: Objectives(*pair)), max_size=12)


@given(POINTS)
def test_the_front_is_that_of_brute_force(points: list[Objectives]) -> None:
    front = pareto_front(points, lambda p: p)
    for p in points:
        better = any(o.cost <= p.cost and o.quality >= p.quality and o[:2] != p[:2] for o in points)
        assert (p[:2] in [f[:2] for f in front]) != better
    assert [f.quality for f in front] == sorted({f.quality for f in front}, reverse=True)


def test_differences_within_the_doubt_do_not_count() -> None:
    points = [Objectives(1.0, 30.0, 0.05), Objectives(0.95, 29.0, 0.05), Objectives(0.8, 28.0, 0.05)]
    assert pareto_front(points, lambda p: p) == [points[0], points[2]]
    assert pareto_front([*points, Objectives(math.nan, 50.0)], lambda p: p) == [points[0], points[2]]


def test_chains_take_the_least_loss_per_gain_first() -> None:
    steps = [
        ParetoStep("a", "a=1", 0.5, 0.1),
        ParetoStep("a", "a=2", 1.0, 1.0),
        ParetoStep("b", "b=1", 0.4, 0.2),
        ParetoStep("c", "c=1", 0.0, 0.0),
    ]
    assert chain_pareto_steps(steps) == [("a=1", "b=1"), ("a=2", "b=1")]
    assert chain_pareto_steps(steps[:2]) == []


def test_combinations_are_new_and_alternate_between_directions() -> None:
    faster = [ParetoStep(name, f"{name}=1", gain, 0.1) for name, gain in (("a", 0.4), ("b", 0.3), ("c", 0.2))]
    smaller = [ParetoStep(name, f"{name}=1", gain, 0.1) for name, gain in (("x", 0.4), ("y", 0.3))]
    assert combine_pareto_steps((faster, smaller), [("b=1", "a=1")], 5) == [("a=1", "b=1", "c=1"), ("x=1", "y=1")]
    assert combine_pareto_steps((faster, smaller), [], 2) == [("a=1", "b=1"), ("x=1", "y=1")]
    assert thin_pareto_chain(list(range(10)), 4) == [0, 3, 6, 9] and thin_pareto_chain([1, 2], 0) == []

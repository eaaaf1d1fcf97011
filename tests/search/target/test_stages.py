"""Which full run becomes the result."""

from __future__ import annotations

from neuprim.config.target import Target
from neuprim.search.target.stages import chosen
from tests.search.target_records import attempt, judge


def test_the_smallest_that_meets_the_target_with_room_for_few_bits_is_chosen() -> None:
    runs = [attempt(n, 800, psnr, "full") for n, psnr in ((100, 24.5), (120, 25.01), (140, 25.2), (300, 26.0))]
    assert chosen(judge(Target(psnr=25), *runs)).primitives == 140
    assert chosen(judge(Target(psnr=25), *runs[:2])).primitives == 120
    assert chosen(judge(Target(psnr=27), *runs)).primitives == 300


def test_limits_come_before_quality() -> None:
    runs = [attempt(n, 800, psnr, "full", ms=n / 10) for n, psnr in ((100, 24.0), (300, 26.0))]
    assert chosen(judge(Target(psnr=25, fps=60), *runs)).primitives == 100
    assert chosen(judge(Target(megabytes=0.01), *runs)).primitives == 300
    assert chosen(judge(Target(megabytes=0.004), *runs)).primitives == 100

"""Records of searches that nobody made."""

from __future__ import annotations

from typing import Any

from neuprim.config.target import Target
from neuprim.search.target.judge import Judge
from neuprim.search.target.record import Attempt, Purpose, Record, Turn


def attempt(
    count: int,
    steps: int,
    psnr: float,
    purpose: Purpose = "size",
    words: dict[str, int] | None = None,
    ms: float = 10.0,
) -> Attempt:
    outcome: dict[str, Any] = {
        "psnr": psnr,
        "ssim": 0.9,
        "primitives": count,
        "steps": steps,
        "bytes": 1,
        "ms_per_frame": ms,
    }
    return Attempt(purpose, words or {}, count, steps, outcome=outcome, packed=1000 + 20 * count)


def judge(target: Target, *attempts: Attempt, turns: list[Turn] | None = None) -> Judge:
    return Judge(target, Record({}, {}, length=200, attempts=list(attempts), turns=turns or []), lambda n: 800.0)

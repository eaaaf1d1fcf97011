"""The words of a target: taken out of a command line, and refused in one line where they make no sense."""

from __future__ import annotations

import pytest

from neuprim.config.target import Target, parse_duration, take_target
from neuprim.core.errors import ConfigError


def test_words_are_taken_out_of_the_others() -> None:
    found, rest = take_target(
        ["task=static", "target.psnr=30", "model.primitives=100", "+target.megabytes=1.5", "budget=10m"]
    )
    assert found == (Target(psnr=30, megabytes=1.5), 600.0)
    assert rest == ["task=static", "model.primitives=100"]
    assert str(found[0]) == "target.psnr=30 target.megabytes=1.5" and found[0].quality == {"psnr": 30}


def test_other_words_are_left_alone() -> None:
    assert take_target(["model.primitives=1,2", "scene.path='a,b'"]) == (
        None,
        ["model.primitives=1,2", "scene.path='a,b'"],
    )


def test_the_last_of_equal_words_counts() -> None:
    assert take_target(["target.fps=30", "budget=1h", "target.fps=60", "budget=1.5m"])[0] == (Target(fps=60), 90.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["target.psnr=30"], "target.psnr=30: expected a budget beside it"),
        (["budget=10m"], "budget=10m: no target; expected one of target.psnr=DB, target.ssim=S"),
        (["target.pnsr=30", "budget=10m"], "target.pnsr: no such target; did you mean 'psnr'"),
        (["target=30", "budget=10m"], "target=30: expected one of target.psnr=DB"),
        (["target.psnr=null", "budget=10m"], "target.psnr=null: expected one of"),
        (["target.psnr=-3", "budget=10m"], "target.psnr=-3: expected decibels, above 0"),
        (["target.psnr=much", "budget=10m"], "target.psnr=much: expected a finite number"),
        (["target.ssim=1", "budget=10m"], "target.ssim=1"),
        (["target.megabytes=0", "budget=10m"], "target.megabytes=0"),
        (["target.psnr=28,30", "budget=10m"], "target.psnr: several values; expected one"),
        (["target.psnr=30", "budget=600"], "budget=600: expected a time such as 90s"),
        (["target.psnr=30", "budget=0m"], "budget=0m: expected a time such as 90s"),
        (["target.psnr=30", "budget.minutes=3"], "budget.minutes=3: no such setting; did you mean 'budget'?"),
    ],
)
def test_what_makes_no_sense_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        take_target(words)
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_times_in_words() -> None:
    assert [parse_duration(text, text) for text in ("90s", "10m", "1.5h")] == [90.0, 600.0, 5400.0]
    with pytest.raises(ConfigError, match="--budget 5 m: expected a time"):
        parse_duration("5 m", "--budget 5 m")

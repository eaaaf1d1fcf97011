"""Overrides that are no part of a configuration: where runs work, the live viewer, and targets with their budget."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from neuprim.config.command_settings import (
    LOOPBACK,
    LauncherSettings,
    Target,
    ViewerSettings,
    parse_duration,
    take_launcher,
    take_target,
    take_viewer,
)
from neuprim.core.errors import ConfigError

Take = Callable[[list[str]], tuple[Any, list[str]]]
BUDGET = "budget=10m"
PROCESSES = "launcher=processes"


@pytest.mark.parametrize(
    ("take", "words", "expected"),
    [
        (take_launcher, [], LauncherSettings()),
        (take_launcher, [PROCESSES, "launcher.workers=4"], LauncherSettings("processes", workers=4)),
        (
            take_launcher,
            ["+launcher=ray", "launcher.options.num_gpus=1"],
            LauncherSettings("ray", options={"num_gpus": 1}),
        ),
        (take_viewer, [], None),
        (take_viewer, ["viewer=false", "viewer.port=1"], None),
        (take_viewer, ["viewer=true"], ViewerSettings(LOOPBACK, 8080)),
        (take_viewer, ["viewer.port=0"], ViewerSettings(LOOPBACK, 0)),
        (take_viewer, ["++viewer=true", "viewer.host=0.0.0.0"], ViewerSettings("0.0.0.0", 8080)),
        (take_target, [], None),
        (take_target, ["target.psnr=30", "target.megabytes=1.5", BUDGET], (Target(psnr=30, megabytes=1.5), 600.0)),
        (take_target, ["target.fps=30", "budget=1h", "target.fps=60", "budget=1.5m"], (Target(fps=60), 90.0)),
    ],
)
def test_a_group_is_taken_out_of_the_overrides(take: Take, words: list[str], expected: Any) -> None:
    assert take(["task=static", *words, "scene.path='a,b'"]) == (expected, ["task=static", "scene.path='a,b'"])


@pytest.mark.parametrize(
    ("take", "words", "message"),
    [
        (take_launcher, ["launcher=prosesses"], "launcher=prosesses: no such launcher; did you mean 'processes'?"),
        (take_launcher, ["launcher=ray,processes"], "launcher: several values; expected one"),
        (take_launcher, [PROCESSES, "launcher.worker=2"], "did you mean 'launcher.workers'"),
        (take_launcher, ["launcher.workers=2"], "launcher.workers: launcher=inline does not use it"),
        (take_launcher, [PROCESSES, "launcher.address=auto"], "launcher=processes does not use it; expected it with"),
        (take_launcher, [PROCESSES, "launcher.options.num_gpus=1"], "launcher.options: launcher=processes"),
        (take_launcher, ["launcher=ray", "launcher.options=3"], "launcher.options=3: expected entries"),
        (take_viewer, ["viewer=yes"], "viewer=yes: expected true or false"),
        (take_viewer, ["viewer.prot=80"], "viewer.prot: no such setting; did you mean 'viewer.port'"),
        (take_viewer, ["viewer.port=1,2"], "viewer.port: several values; expected one"),
        (take_target, ["target.psnr=30"], "target.psnr=30: expected a budget beside it"),
        (take_target, [BUDGET], "budget=10m: no target; expected one of target.psnr=DB, target.ssim=S"),
        (take_target, ["target.pnsr=30", BUDGET], "target.pnsr: no such setting; did you mean 'target.psnr'"),
        (take_target, ["target=30", BUDGET], "target=30: expected one of target.psnr=DB"),
        (take_target, ["target.psnr=null"], "target: no target; expected one of"),
        (take_target, ["target.psnr=-3", BUDGET], "target.psnr=-3: expected decibels, above 0"),
        (take_target, ["target.psnr=28,30", BUDGET], "target.psnr: several values; expected one"),
        (take_target, ["target.psnr=30", "budget=600"], "budget=600: expected a time such as 90s"),
        (take_target, ["target.psnr=30", "budget=0m"], "budget=0m: expected a time such as 90s"),
        (take_target, ["target.psnr=30", "budget.minutes=3"], "budget.minutes: no such setting"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(take: Take, words: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        take(words)
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_times_in_words() -> None:
    assert [parse_duration(text, text) for text in ("90s", "10m", "1.5h")] == [90.0, 600.0, 5400.0]
    with pytest.raises(ConfigError, match="--budget 5 m: expected a time"):
        parse_duration("5 m", "--budget 5 m")

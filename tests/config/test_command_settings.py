"""Overrides that are no part of a configuration: where runs work, the live viewer, and targets with their budget."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from neuprim.config.command_settings import (
    LOOPBACK,
    LauncherSettings,
    SearchTarget,
    ViewerSettings,
    parse_duration_setting,
    take_launcher_overrides,
    take_target_overrides,
    take_viewer_overrides,
)
from neuprim.core.errors import ConfigError

Take = Callable[[list[str]], tuple[Any, list[str]]]
BUDGET = "budget=10m"
PROCESSES = "launcher=processes"


@pytest.mark.parametrize(
    ("take", "words", "expected"),
    [
        (take_launcher_overrides, [], LauncherSettings()),
        (take_launcher_overrides, [PROCESSES, "launcher.workers=4"], LauncherSettings("processes", workers=4)),
        (
            take_launcher_overrides,
            ["+launcher=ray", "launcher.options.num_gpus=1"],
            LauncherSettings("ray", options={"num_gpus": 1}),
        ),
        (take_viewer_overrides, [], None),
        (take_viewer_overrides, ["viewer=false", "viewer.port=1"], None),
        (take_viewer_overrides, ["viewer=true"], ViewerSettings(LOOPBACK, 8080)),
        (take_viewer_overrides, ["viewer.port=0"], ViewerSettings(LOOPBACK, 0)),
        (take_viewer_overrides, ["++viewer=true", "viewer.host=0.0.0.0"], ViewerSettings("0.0.0.0", 8080)),
        (take_target_overrides, [], None),
        (
            take_target_overrides,
            ["target.psnr=30", "target.megabytes=1.5", BUDGET],
            (SearchTarget(psnr=30, megabytes=1.5), 600.0),
        ),
        (
            take_target_overrides,
            ["target.fps=30", "budget=1h", "target.fps=60", "budget=1.5m"],
            (SearchTarget(fps=60), 90.0),
        ),
    ],
)
def test_a_group_is_taken_out_of_the_overrides(take: Take, words: list[str], expected: Any) -> None:
    assert take(["task=static", *words, "scene.path='a,b'"]) == (expected, ["task=static", "scene.path='a,b'"])


@pytest.mark.parametrize(
    ("take", "words", "message"),
    [
        (
            take_launcher_overrides,
            ["launcher=prosesses"],
            "launcher=prosesses: no such launcher; did you mean 'processes'?",
        ),
        (
            take_launcher_overrides,
            ["launcher.workers=2"],
            "launcher.workers: launcher=inline does not use this setting",
        ),
        (take_viewer_overrides, ["viewer.prot=80"], "viewer.prot: no such setting; did you mean 'viewer.port'"),
        (
            take_target_overrides,
            ["target.psnr=30"],
            "target.psnr=30: expected a budget, the time for search and training",
        ),
        (take_target_overrides, [BUDGET], "budget=10m: no target given; expected one of target.psnr=DB, target.ssim=S"),
        (take_target_overrides, ["target=30", BUDGET], "target=30: expected one of target.psnr=DB"),
        (take_target_overrides, ["target.psnr=-3", BUDGET], "target.psnr=-3: expected decibels, above 0"),
        (take_target_overrides, ["target.psnr=28,30", BUDGET], "target.psnr: several values; expected one"),
        (take_target_overrides, ["target.psnr=30", "budget=600"], "budget=600: expected a time such as 90s"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(take: Take, words: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        take(words)
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_times_in_words() -> None:
    assert [parse_duration_setting(text, text) for text in ("90s", "10m", "1.5h")] == [90.0, 600.0, 5400.0]
    with pytest.raises(ConfigError, match="budget=5 m: expected a time"):
        parse_duration_setting("5 m", "budget=5 m")

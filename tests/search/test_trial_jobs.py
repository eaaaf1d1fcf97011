"""Trials in other processes are those of this one, and searches that launch them decide as those that do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from neuprim.config import compose
from neuprim.config.launcher import LauncherSettings
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.search.trial_jobs import TrialFailed, launched_trials, trial_of, words_of
from neuprim.search.trials import Outcome, Trial, run_trial
from tests.core import tiny
from tests.runs.launching import processes
from tests.short_runs import words
from tests.systems import posix


@posix
def test_the_same_outcomes_as_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 1)
    scene = tiny.write_blender(tmp_path / "two")
    # Folders' names are as long as each other: they are written in the file, whose bytes are compared.
    here = Trial(compose(words(scene, tmp_path / "in_1", 20)), views=2)
    there = Trial(compose(words(scene, tmp_path / "in_2", 20)), views=2)
    gone = replace(there, config=compose(words(tmp_path / "nowhere", tmp_path / "gone", 20)))
    assert trial_of(words_of(here)) == here
    told: list[float] = []
    first, second = launched_trials([[there], [gone]], processes(), tmp_path, told.append)
    expected = run_trial(here)
    assert isinstance(first, list) and (first[0].psnr, first[0].ssim, first[0].bytes) == (
        expected.psnr,
        expected.ssim,
        expected.bytes,
    )
    assert isinstance(second, TrialFailed) and "nowhere" in str(second)
    assert told == sorted(told) and told[-1] == 1.0
    assert isinstance(first[0], Outcome) and not (tmp_path / "launch").exists()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (LauncherSettings(), (1, 0)),
        (LauncherSettings(threads=3), (1, 3)),
        (LauncherSettings("processes"), (8, 1)),
        (LauncherSettings("processes", workers=2), (2, 4)),
        (LauncherSettings("ray"), (8, 1)),
        (LauncherSettings("slurm", workers=30, threads=4), (30, 4)),
        (LauncherSettings("slurm"), (8, 1)),
    ],
)
def test_how_many_a_search_counts_on(
    settings: LauncherSettings, expected: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 8)
    assert count_parallel_jobs(settings, 100) == expected

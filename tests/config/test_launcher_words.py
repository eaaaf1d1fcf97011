"""The words of a launcher are taken out of the others, and those that would do nothing are refused."""

from __future__ import annotations

import pytest

from neuprim.config.launcher import LauncherSettings, take_launcher
from neuprim.core.errors import ConfigError


def test_they_are_taken_out_and_the_others_stay() -> None:
    settings, rest = take_launcher(
        ["task=static", "launcher=slurm", "seed=1,2", "launcher.threads=4", "launcher.options.slurm_partition=gpu"]
    )
    assert settings == LauncherSettings("slurm", threads=4, options={"slurm_partition": "gpu"}) and rest == [
        "task=static",
        "seed=1,2",
    ]
    assert settings.given() == {"name": "slurm", "threads": 4, "options": {"slurm_partition": "gpu"}}
    assert take_launcher(["seed=1"]) == (LauncherSettings(), ["seed=1"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["launcher=prosesses"], "launcher=prosesses: no such launcher; did you mean 'processes'?"),
        (["launcher=ray,processes"], "launcher: several values; expected one"),
        (
            ["launcher=processes", "launcher.worker=2"],
            "launcher.worker=2: no such setting; did you mean 'launcher.workers'",
        ),
        (["launcher=processes", "launcher.workers=0"], "launcher.workers=0: expected a positive whole number"),
        (["launcher=processes", "launcher.workers=two"], "launcher.workers=two"),
        (["launcher=processes", "launcher.retries=-1"], "launcher.retries=-1: expected a whole number from 0 to 1000"),
        (
            ["launcher.workers=2"],
            "launcher.workers: launcher=inline has no use for it; expected it with launcher=processes",
        ),
        (
            ["launcher=processes", "launcher.address=auto"],
            "launcher.address: launcher=processes has no use for it; expected it with launcher=ray",
        ),
        (
            ["launcher=processes", "launcher.options.num_gpus=1"],
            "launcher.options: launcher=processes has no use for it",
        ),
        (["launcher=ray", "launcher.options=3"], "launcher.options=3: no such setting"),
    ],
)
def test_one_line_for_what_is_wrong(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        take_launcher(words)
    assert message in str(error.value) and "\n" not in str(error.value)

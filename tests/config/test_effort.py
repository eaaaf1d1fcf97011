"""``effort=1`` to ``9``: levels that a task's package freezes, below what is typed and above the preset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from neuprim.config import RunConfig, compose
from neuprim.config.task_files import LEVELS
from neuprim.conformance import ConformanceError, named_checks
from neuprim.core.errors import ConfigError
from neuprim.plugins.registry import load_task
from tests.plugins.fakes import site, toy

__all__ = ["site", "toy"]


def write(toy: Path, text: str) -> None:
    file = toy / "conf" / "effort" / "toy.yaml"
    file.parent.mkdir(exist_ok=True)
    file.write_text(text)


@pytest.fixture
def levels(toy: Path) -> Path:
    lines = [f"  {n}: {{model.primitives: {100 * n}, train.iterations: {10 * n}}}" for n in LEVELS]
    write(toy, "preset: long\nlevels:\n" + "\n".join(lines) + "\n")
    return toy


def run(*words: str) -> RunConfig:
    return compose(["task=toy", *words], check_output=False)


def test_a_level_lies_over_the_preset_that_it_was_measured_with(levels: Path) -> None:
    config = run("effort=3")
    model, train = {"model.primitives": (9, 300)}, {"train.iterations": (700, 30)}
    assert config.non_default == {"preset": ("quick", "long"), **model, **train} and config.renderer.near == 0.5
    assert config.overrides == ["task=toy", "effort=3"]
    assert run().preset == "quick", "without a level nothing changes"


def test_what_is_typed_lies_over_the_level(levels: Path) -> None:
    assert run("model.primitives=7", "effort=3").model.primitives == 7
    assert run("effort=3", "preset=long").train.iterations == 30
    timed = run("effort=3", "train.max_seconds=5").train
    assert (timed.iterations, timed.max_seconds) == (None, 5.0), "a budget in seconds is used up"


@pytest.mark.parametrize("word", ["0", "10", "best"])
def test_no_such_level(levels: Path, word: str) -> None:
    with pytest.raises(ConfigError, match=rf"^effort={word}: expected a level from 1 \(fast\) to 9 \(good\)$"):
        run(f"effort={word}")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("preset: [", r"cannot be read"),
        ("preset: quik\nlevels: {}", r"preset=quik: no such preset; did you mean 'quick'"),
        (
            "preset: quick\nlevels: {1: {model.primitives: 3}}",
            r"levels: found \[1\]; expected the keys 1 to 9, in this order",
        ),
    ],
)
def test_a_damaged_file_is_named(toy: Path, text: str, expected: str) -> None:
    write(toy, text)
    with pytest.raises(ConfigError, match=r"^task 'toy': effort/toy\.yaml.*" + expected):
        run("effort=1")


def test_a_damaged_level_is_named(toy: Path) -> None:
    write(toy, "preset: quick\nlevels:\n" + "".join(f"  {n}: {{seed: 3}}\n" for n in LEVELS))
    with pytest.raises(
        ConfigError, match=r"levels\.1: found \{'seed': 3\}; expected settings of model, train and rend"
    ):
        run("effort=1")


def test_conformance_holds_packages_to_their_levels(levels: Path) -> None:
    """A task that is static but for its files; the check of files names the level that cannot be composed."""
    task = replace(
        load_task("static"), name="toy", config_package="toytask.conf", scenes=load_task("toy").scenes, options={}
    )
    (levels / "conf" / "task" / "toy.yaml").write_text("scene: ball\n")
    check = named_checks(task)["description"]
    check()
    file = levels / "conf" / "effort" / "toy.yaml"
    file.write_text(file.read_text().replace("model.primitives: 400", "train.rates.glow: 0.1"))
    with pytest.raises(ConformanceError, match=r"effort 4: found .*train\.rates\.glow: no such parameter"):
        check()
    file.write_text(file.read_text().replace("train.rates.glow: 0.1", "model.primitives: 0"))
    with pytest.raises(ConformanceError, match=r"model\.primitives"):
        check()

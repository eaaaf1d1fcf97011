"""``--config FILE``: every setting of an earlier run, under what is typed beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from neuprim.cli import main
from neuprim.config import RunConfig, compose, compose_all, read_stored_config
from neuprim.core.errors import ConfigError

WORDS = [
    *(
        "task=static",
        "scene=solids",
        "scene.size=48",
        "preset=paper",
        "seed=7",
        "model.primitives=123",
        "train.rates={means: 1e-3}",
    ),
    *("model.density.edge=2", "train.iterations=50", "output_dir=first"),
]


@pytest.fixture
def stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunConfig:
    """Of a run that a preset of another day made, so that no word says all of it."""
    monkeypatch.chdir(tmp_path)
    config = compose(WORDS)
    config = replace(config, train=replace(config.train, log_every=17, rates={"means": 0.5}))
    Path("first").mkdir()
    Path("first/config.yaml").write_text(config.to_yaml())
    return read_stored_config(Path("first"))


def settings(config: RunConfig) -> dict[str, object]:
    return {k: v for k, v in config.to_dict().items() if k not in ("output_dir", "overrides", "non_default")}


def test_the_same_settings_in_a_directory_of_its_own(stored: RunConfig) -> None:
    again = compose([], stored=stored)
    assert settings(again) == settings(stored) and again.train.rates == {"means": 0.5} and again.train.log_every == 17
    assert again.output_dir == Path("outputs/static-solids") and again.overrides == [
        w for w in WORDS if not w.startswith("output_dir=")
    ]
    assert again.non_default["train.log_every"][1] == 17


def test_what_is_typed_comes_first(stored: RunConfig) -> None:
    other = compose(["model.primitives=5", "train.max_seconds=9", "train.rates.quats=1e-3"], stored=stored)
    assert (other.model.primitives, other.train.max_seconds, other.train.iterations) == (5, 9.0, None)
    assert other.train.rates == {"means": 0.5, "quats": 1e-3} and other.seed == 7
    assert compose(["model.density.form=gaussian"], stored=stored).model.density == {"form": "gaussian"}
    room = compose(["scene=room"], stored=stored)
    assert room.scene_name == "room" and "exposure" in room.scene and room.seed == 7
    assert [c.seed for c in compose_all(["seed=1,2"], stored=stored)] == [1, 2]


@pytest.mark.parametrize("word", ["task=dynamic", "preset=quick", "effort=3"])
def test_what_the_file_has_said_already_is_refused(stored: RunConfig, word: str) -> None:
    with pytest.raises(
        ConfigError, match=rf"{word}: the file of --config already includes .*; leave {word.partition('=')[0]}= out"
    ):
        compose([word], stored=stored)


def test_on_the_command_line(stored: RunConfig, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--config", "first/config.yaml", "--print-config", "model.primitives=9"]) == 0
    Path("shown.yaml").write_text(capsys.readouterr().out)
    assert RunConfig.from_yaml("shown.yaml").model.primitives == 9
    for word, text in (("nowhere.yaml", "no such file; expected RUN_DIR/config.yaml"), ("first", "not a run's config")):
        Path("first/config.yaml").write_text("- 1")
        assert main(["run", "--config", word]) == 2 and text in capsys.readouterr().err

"""``resume=true`` goes on with the run that is there."""

from __future__ import annotations

from pathlib import Path

import pytest

from neuprim.cli import main
from neuprim.config import RunConfig, compose, compose_all
from neuprim.core.errors import ConfigError

BEGUN = [
    "task=dynamic",
    "scene=vdb",
    "scene.vdb=/data/fire",
    "scene.size=24",
    "model.primitives=40",
    "train.iterations=30",
    "seed=5",
]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    Path("run/config.yaml").write_text(compose([*BEGUN, "output_dir=run"], check_output=False).to_yaml())
    return Path("run")


def resumed(*words: str) -> RunConfig:
    return compose([*words, "output_dir=run", "resume=true"])


def same(a: RunConfig, b: RunConfig) -> bool:
    left, right = ({k: v for k, v in c.to_dict().items() if k not in ("resume", "overrides")} for c in (a, b))
    return left == right


def test_its_own_configuration_with_and_without_its_words(run: Path) -> None:
    begun = RunConfig.from_yaml(run)
    assert same(resumed(), begun) and same(resumed(*BEGUN), begun) and resumed().resume
    Path("run/config.yaml").write_text(resumed().to_yaml())
    assert same(resumed(), begun), "and once more"


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (["task=static"], "task=static"),
        (["scene=smoke_fire"], "scene=smoke_fire"),
        (["preset=paper"], "preset=paper"),
        (["effort=4"], "model.primitives="),
        (["model.primitives=41"], "model.primitives=41"),
        (["model.density.edge=1"], "model.density.edge=1"),
        (["scene.size=25"], "scene.size=25"),
        (["scene.frames='1:2'"], "scene.frames=1:2"),
        (["seed=6"], "seed=6"),
    ],
)
def test_contradictions_are_refused_by_name(
    run: Path, words: list[str], key: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (run / "config.yaml").read_bytes()
    assert main(["run", *words, "--out", "run", "resume=true"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"neuprim: error: {key}") and "was started with" in error and error.count("\n") == 1
    assert (run / "config.yaml").read_bytes() == before


def test_what_may_change_does(run: Path) -> None:
    words = [
        "train.iterations=90",
        "renderer.threads=1",
        "renderer.backend=reference",
        "train.checkpoint_every_seconds=5",
        "scene.memory=99",
    ]
    config = resumed(*words, "scene.vdb=/moved/fire", "scene.cache=/cache", "train.rates={means: 1e-4}")
    assert (config.train.iterations, config.renderer.threads, config.renderer.backend) == (90, 1, "reference")
    assert (config.scene["vdb"], config.scene["size"], config.model.primitives, config.seed) == (
        "/moved/fire",
        24,
        40,
        5,
    )
    assert [w for w in config.overrides if w.startswith("train.iterations")] == ["train.iterations=90"]
    assert resumed("train.max_seconds=9").train.iterations is None


def test_nothing_begun_there_starts_only_what_is_said(run: Path) -> None:
    for place in ("nowhere", "."):
        with pytest.raises(ConfigError, match=rf"--out {place} resume=true: no run to continue"):
            compose([f"output_dir={place}", "resume=true"])
    assert compose(["task=static", "output_dir=nowhere", "resume=true"]).scene_name == "solids"


def test_runs_of_a_sweep_go_on_as_they_were_begun(run: Path) -> None:
    words = ["task=static", "seed=1,2", "model.primitives=9", "output_dir=sweep"]
    for config in compose_all(words):
        config.output_dir.mkdir(parents=True)
        config.output_dir.joinpath("config.yaml").write_text(config.to_yaml().replace("log_every: 20", "log_every: 7"))
    again = compose_all([*words, "resume=true"])
    assert [(c.seed, c.train.log_every, c.resume, str(c.output_dir)) for c in again] == [
        (1, 7, True, "sweep/seed-1"),
        (2, 7, True, "sweep/seed-2"),
    ]
    with pytest.raises(
        ConfigError, match=r"^model\.primitives=8: the run to resume was started with model\.primitives=9"
    ):
        compose_all([*words[:2], "model.primitives=8", "output_dir=sweep", "resume=true"])

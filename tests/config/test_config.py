from pathlib import Path

import pytest

from neuprim.config import RunConfig, compose, compose_all, expand_sweep_overrides
from neuprim.core.errors import CheckpointError, ConfigError, DataError
from neuprim.core.task import SceneContext
from neuprim.plugins.registry import load_task
from tests.plugins.fakes import site, toy

__all__ = ["site", "toy"]


def toys(*words: str) -> RunConfig:
    return compose(["task=toy", *words])


# ---------------------------------------------------------------- composing


def test_defaults(toy: Path) -> None:
    c = toys()
    assert (c.task, c.scene_name, c.preset) == ("toy", "ball", "quick")
    assert c.scene == {"size": 20, "smooth": False, "look": "auto", "ratio": 0.5, "steps": [1, 2]}
    assert c.train.iterations == 7
    assert c.train.rates == {"means": 1e-3}
    assert c.model.primitives == 2000
    assert c.options == {"gain": 1.0}
    assert c.output_dir == Path("outputs/toy-ball")
    assert c.non_default == {}


def test_user_wins_over_preset_over_defaults(toy: Path) -> None:
    c = toys("preset=long", "train.iterations=8")
    assert c.train.iterations == 8
    assert c.model.primitives == 9
    assert c.renderer.near == 0.5
    assert c.non_default == {"preset": ("quick", "long"), "train.iterations": (700, 8)}


def test_another_strategy_starts_with_all_primitives_unless_growth_is_typed() -> None:
    def grow_from(*words: str) -> float:
        return compose(["task=static", *words]).train.population.grow_from

    assert grow_from() == 0.5
    assert grow_from("train.population.strategy=fixed") == grow_from("train.population={strategy: fixed}") == 1.0
    assert grow_from("train.population.strategy=relocate") == 0.5
    with pytest.raises(ConfigError, match=r"grow_from=0\.5: strategy=fixed does not use this setting"):
        grow_from("train.population.strategy=fixed", "train.population.grow_from=0.5")


def test_free_dictionaries_need_no_plus(toy: Path) -> None:
    rates = ["train.rates.w2=1e-3", "+train.rates.b2=2", "train.rate_units.glow=extent"]
    c = toys(*rates, "model.init.mode=paper", "model.init.deep={a:[1,2]}", "task.options.gain=3")
    assert c.train.rates == {"means": 1e-3, "w2": 1e-3, "b2": 2.0}
    assert c.model.init == {"mode": "paper", "deep": {"a": [1, 2]}}
    assert (c.options, c.train.rate_units) == ({"gain": 3}, {"glow": "extent"})
    assert c.non_default["train.rates.w2"] == (None, 1e-3)


def test_typed_seconds_are_all_of_the_budget(toy: Path) -> None:
    c = toys("train.max_seconds=5")
    assert c.train.iterations is None, "or a fast machine would stop at the preset's steps before the seconds are over"
    assert c.non_default["train.iterations"] == (7, None)
    assert toys("train={max_seconds:5}").train.iterations is None
    assert toys("train.max_seconds=5", "train.iterations=9").train.iterations == 9
    assert toys("train={max_seconds:5,iterations:9}").train.iterations == 9
    assert toys("train.max_seconds=5", "train.max_seconds=null").train.iterations == 7
    with pytest.raises(
        ConfigError, match=r"train\.iterations and train\.max_seconds are both null; expected a number of steps"
    ):
        toys("train.iterations=null")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["train.iteratons=5"], "train.iteratons: no such setting; did you mean 'train.iterations'"),
        (["scene.sise=5"], "scene.sise: no such setting of scene 'ball'; did you mean 'scene.size'"),
        (["train..rates=3"], "expected KEY=VALUE"),
        (["scene@foo=ball"], "packages (@)"),
        (["task=ty"], "task=ty: no such task; did you mean 'toy'?"),
        (["scene=bal"], "scene=bal: task 'toy' has no such scene; did you mean 'ball'?"),
        (["scene=[1]"], "expected the name of a scene"),
        (["effort=true"], "effort=true: expected a level from 1 (fast) to 9 (good)"),
        (["preset=lng"], "preset=lng: task 'toy' has no such preset; did you mean 'long'?"),
        (["model=3"], "model is a group of settings"),
        (["scene.size=big"], "scene.size=big: expected a whole number"),
        (["scene=files"], "scene.path: required and not given; expected scene.path=PATH, a directory or file"),
        (["scene=files", "scene.path=[1]"], "expected a path"),
        (["seed=${nothing}"], "nothing"),
        (["~seed"], "cannot be deleted"),
        (["seed=1,2"], "several values; add -m"),
        (["output_dir=a=b"], "quote values that contain"),
        (["output_dir=''"], "expected a directory"),
    ],
)
def test_one_clear_line(toy: Path, words: list[str], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        toys(*words)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_paths_are_made_absolute_and_survive_any_character(toy: Path) -> None:
    strange = "a, b = c (d) é"
    c = toys("scene=files", f"scene.path='{strange}'", f"output_dir='out/{strange}'")
    assert c.scene["path"] == str(Path.cwd() / strange)
    assert c.output_dir == Path("out") / strange
    assert toys("scene=files", "scene.path=123").scene["path"] == str(Path.cwd() / "123")
    assert toys("scene=files", "scene.path=plain dir/x").scene["path"] == str(Path.cwd() / "plain dir/x")


@pytest.mark.parametrize(
    ("file", "content", "text"),
    [
        ("preset/toy/quick.yaml", "train: {iteratons: 3}", "preset/toy/quick.yaml: train.iteratons: no such setting"),
        ("preset/toy/quick.yaml", "seed: 3", "a preset may only set scene, model, train, renderer"),
        ("preset/toy/quick.yaml", "scene: {nope: 3}", "sets scene.nope, which scene=ball does not have"),
        ("task/toy.yaml", "scnee: ball", "task/toy.yaml: scnee: no such setting; did you mean 'scene'"),
        ("task/toy.yaml", "preset: lng", "no such preset; did you mean 'long'"),
        ("scene/toy/files.yaml", None, "task 'toy': toytask.conf has no scene/toy/files.yaml"),
        ("task/toy.yaml", "options: 3", "options=3: expected entries"),
        ("scene/toy/ball.yaml", "[1]", "scene/toy/ball.yaml: expected a mapping"),
        ("scene/toy/ball.yaml", "_paths_: [nope]", "may only list keys of the file"),
    ],
)
def test_a_plugins_broken_yaml_is_named(toy: Path, file: str, content: str | None, text: str) -> None:
    if content is None:
        (toy / "conf" / file).unlink()
    else:
        (toy / "conf" / file).write_text(content)
    with pytest.raises(ConfigError) as caught:
        toys()
    assert text in str(caught.value)


# ---------------------------------------------------------------- output directories


def test_default_directory_is_numbered(toy: Path) -> None:
    Path("outputs/toy-ball").mkdir(parents=True)
    Path("outputs/toy-ball-extra").mkdir()
    assert toys().output_dir == Path("outputs/toy-ball-2")
    Path("outputs/toy-ball-7").mkdir()
    assert toys().output_dir == Path("outputs/toy-ball-8")
    assert toys("resume=true").output_dir == Path("outputs/toy-ball-7")


def test_occupied_directory_is_refused(toy: Path) -> None:
    Path("full").mkdir()
    assert toys("output_dir=full").output_dir == Path("full")
    Path("full/x").write_text("precious")
    with pytest.raises(ConfigError, match=r"--out full: exists and is not empty.*resume=true"):
        toys("output_dir=full")
    assert toys("output_dir=full", "resume=true").output_dir == Path("full")
    with pytest.raises(ConfigError, match=r"--out full/x/y: .*full/x is a file; expected a directory"):
        toys("output_dir=full/x/y")
    with pytest.raises(ConfigError, match="is a file"):
        toys("output_dir=full/x")


# ---------------------------------------------------------------- sweeps


def test_expand_sweep() -> None:
    made = expand_sweep_overrides(["a=1,2", "b=3", "c=x,y"])
    assert made == [[a, "b=3", c] for a in ("a=1", "a=2") for c in ("c=x", "c=y")]
    assert expand_sweep_overrides(["a=range(1,4)"]) == [["a=1"], ["a=2"], ["a=3"]]
    assert expand_sweep_overrides(["a=choice(x,y)"]) == [["a=x"], ["a=y"]]
    assert expand_sweep_overrides(["a=[1,2]", "p='x,y=z w'"]) == [["a=[1,2]", "p='x,y=z w'"]]
    assert expand_sweep_overrides(["p='a,b','c=d e'"]) == [["p='a,b'"], ["p='c=d e'"]]
    assert expand_sweep_overrides([]) == [[]]


@pytest.mark.parametrize(
    ("word", "text"),
    [
        ("a=interval(0,1)", "cannot be swept"),
        ("a=glob(*)", "cannot be swept"),
        ("a=range(0,1000000)", "more than 10000 runs"),
        ("a=range(3,1)", "no values"),
        ("output_dir=a,b", "output_dir cannot be swept"),
        ("a=b=c", "cannot be read"),
    ],
)
def test_impossible_sweeps(word: str, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        expand_sweep_overrides([word])
    assert text in str(caught.value)


def test_sweep_directories(toy: Path) -> None:
    runs = compose_all(["task=toy", "model.primitives=200,1000", "train.rates={a:1},{b:2}"])
    assert [r.model.primitives for r in runs] == [200, 200, 1000, 1000]
    assert [r.output_dir.parent for r in runs] == [Path("outputs/toy-ball-sweep")] * 4
    names = [r.output_dir.name for r in runs]
    assert names[0] == "model.primitives-200_train.rates-_a_1"
    assert len(set(names)) == 4
    assert runs[2].overrides == ["task=toy", "model.primitives=1000", "train.rates={a:1}"]


# ---------------------------------------------------------------- on disk


def test_yaml_round_trip(toy: Path) -> None:
    words = ["scene.path='a: b, #c'", "train.rates.w2=1e-5", "train.max_seconds=3", "scene.downsample=2"]
    c = toys("scene=files", *words, "model.init={l:[1]}")
    Path("run").mkdir()
    Path("run/config.yaml").write_text(c.to_yaml())
    assert RunConfig.from_yaml("run") == RunConfig.from_yaml(Path("run/config.yaml")) == c


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("task: [", "line 1: damaged configuration"),
        ("", "expected a mapping, found NoneType"),
        ("!!python/object/apply:os.system ['touch hacked']", "damaged configuration"),
        ("[" * 500, "cannot be read"),
        ("# " + "x" * 1_000_001, "larger than"),
    ],
)
def test_damaged_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str, text: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text(content)
    with pytest.raises(CheckpointError, match=rf"config\.yaml.*{text}"):
        RunConfig.from_yaml("config.yaml")
    assert not Path("hacked").exists()


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("iterations: 7", "iteratons: 7", "train.iteratons: no such setting; did you mean 'train.iterations'"),
        ("preset: quick", "persett: quick", "persett: no such setting; did you mean 'preset'"),
        ("non_default: {}", "non_default: {a: 3}", "non_default.a=3: expected a list"),
        ("output_dir: outputs/toy-ball", "output_dir: null", "output_dir: missing"),
    ],
)
def test_impossible_settings_in_a_file(toy: Path, old: str, new: str, text: str) -> None:
    content = toys().to_yaml()
    assert old in content
    Path("config.yaml").write_text(content.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        RunConfig.from_yaml("config.yaml")
    assert str(caught.value).startswith("config.yaml: ") and text in str(caught.value)


# ---------------------------------------------------------------- the static task's files


def test_a_preset_starts_from_others(toy: Path) -> None:
    folder = toy / "conf" / "preset" / "toy"
    (folder / "longer.yaml").write_text("defaults: [long, _self_]\ntrain: {iterations: 800}\n")
    c = toys("preset=longer")
    assert (c.model.primitives, c.train.iterations) == (9, 800)
    for names, text in (("[longer]", "includes itself"), ("[nowhere]", "cannot be read"), ("3", "expected a list")):
        (folder / "longer.yaml").write_text(f"defaults: {names}\n")
        with pytest.raises(ConfigError, match=f"preset/toy/.*{text}"):
            toys("preset=longer")


@pytest.mark.parametrize("scene", ["mesh", "blender", "nerfstudio", "colmap"])
def test_static_loaders_know_every_key_of_their_yaml(tmp_path: Path, scene: str) -> None:
    c = compose([f"scene={scene}", f"scene.path='{tmp_path / 'absent'}'", f"output_dir='{tmp_path / 'out'}'"])
    with pytest.raises(DataError, match="absent"):  # the folder is looked for after the settings are accepted
        load_task("static").scene(scene).load(c.scene, SceneContext(0, tmp_path))

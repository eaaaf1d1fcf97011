"""Scenes, losses, exporters and inspectors of packages without a task, and what the broken ones leave alone."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from neuprim.cli import main
from neuprim.config import RunConfig, compose
from neuprim.core.errors import ConfigError
from neuprim.core.notices import NeuprimWarning
from neuprim.plugins import registry
from neuprim.plugins.registry import ALL, LOSSES, PluginError, find_scene, load_task
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import load_dataset
from neuprim.runs.run import run
from tests.plugins.extras import KINDS, LOSS, SCENE, add
from tests.plugins.fakes import install, site, toy

__all__ = ["site", "toy"]

# ---------------------------------------------------------------- what works


@pytest.mark.parametrize("kind", KINDS)
def test_listed_without_import_and_loaded_by_name(kind: str, site: Path) -> None:
    group, entry, _, cls = KINDS[kind]
    add(site, kind)
    info = next(info for info in group.listed() if info.name == entry)
    assert (info.origin, info.target) == ("fake-extra 0.3", "fake_extra:PLUGIN")
    assert "fake_extra" not in sys.modules
    assert type(group.load(entry)).__name__ == cls


def test_the_public_functions(site: Path) -> None:
    for i, kind in enumerate(("loss", "exporter", "inspector")):
        add(site, kind, package=f"fake_{i}")
    assert registry.load_loss("extra").summary == "mean squared error"
    assert registry.load_exporter("extra").options == {"size": (1, "of it")}
    assert registry.load_inspector("extra").summary == "nothing at all"
    for found in (registry.list_losses(), registry.list_exporters(), registry.list_inspectors()):
        assert "extra" in [info.name for info in found]


def test_a_scene_and_a_loss_of_other_packages_make_a_run(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add(site, "scene")
    add(site, "loss", package="fake_loss")
    monkeypatch.chdir(tmp_path)
    words = [
        "task=static",
        "scene=extra",
        "train.loss=extra",
        "+task.options.weight=5.0",
        "output_dir=r",
        "renderer.backend=reference",
    ]
    config = compose(
        [
            *words,
            "model.primitives=12",
            "model.neurons=2",
            "train.iterations=3",
            "train.log_every=1",
            "train.max_seconds=null",
        ]
    )
    assert (config.scene_name, config.scene, config.train.loss) == ("extra", {"wobble": 2.0}, "extra")
    assert config.non_default["train.loss"] == (None, "extra")
    run(config)
    assert '"mse"' in (tmp_path / "r" / "metrics.jsonl").read_text()
    again = RunConfig.from_yaml(tmp_path / "r")
    assert again.train.loss == "extra"
    assert load_dataset(again, load_task("static")).name == "two"
    assert evaluate_run(tmp_path / "r")["psnr"] > 5


def test_the_built_in_loss_serves_any_task() -> None:
    """Needs an installation of this version: the loss comes through its entry points."""
    assert registry.load_loss("photometric").make({"ssim_weight": 0.0}) is not None
    assert compose(["task=relight", "train.loss=photometric"], False).train.loss == "photometric"


def test_a_scene_cannot_replace_a_tasks_preset(site: Path) -> None:
    add(site, "scene")
    preset = site / "fake_extra/conf/preset/static/quick.yaml"
    preset.parent.mkdir(parents=True)
    preset.write_text("model: {primitives: 7}\n")
    assert compose(["task=static", "scene=extra"], False).model.primitives == 2800


def test_wrong_settings_of_an_added_scene(site: Path) -> None:
    add(site, "scene")
    with pytest.raises(
        ConfigError, match=r"scene.wobbel: no such setting of scene 'extra'; did you mean 'scene.wobble'"
    ):
        compose(["task=static", "scene=extra", "scene.wobbel=1"], False)
    with pytest.raises(ConfigError, match=r"did you mean 'extra'"):
        compose(["task=static", "scene=extar"], False)
    with pytest.raises(ConfigError, match=r"scene=extra: task 'relight' has no such scene"):
        compose(["task=relight", "scene=extra"], False)


def test_unknown_names_suggest(site: Path) -> None:
    for kind in ("loss", "exporter", "inspector"):
        add(site, kind, package=f"fake_{kind}")
    for load, text in (
        (registry.load_loss, "train.loss=extar: no such loss; did you mean 'extra'"),
        (registry.load_exporter, "--format extar: no such exporter; did you mean 'extra'"),
        (registry.load_inspector, "--show extar: no such inspector; did you mean 'extra'"),
    ):
        with pytest.raises(ConfigError, match=text):
            load("extar")
    with pytest.raises(ConfigError, match=r"train.loss=extar: no such loss"):
        compose(["task=static", "train.loss=extar"], False)


# ---------------------------------------------------------------- what is broken

FAULTS: list[tuple[str, str, str, str]] = [
    (
        "import error",
        "",
        "import a_module_that_is_not_there",
        "ModuleNotFoundError: No module named 'a_module_that_is_not_there'",
    ),
    ("exit", "", "import sys; sys.exit(3)", "cannot import fake_extra:PLUGIN: SystemExit: 3"),
    ("syntax", "", "def f(:", "SyntaxError"),
    ("nothing there", "", "x = 1", "AttributeError"),
    ("wrong type", "", "PLUGIN = 3", "is of type int; expected a neuprim.core."),
    ("older api", "api=1", "api=0", "written for plugin API 0, this neuprim has 1; upgrade fake-extra"),
    ("newer api", "api=1", "api=9", "written for plugin API 9, this neuprim has 1; upgrade neuprim"),
    ("no api", "api=1", "api=None", "written for plugin API None"),
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("old", "new", "text"), [f[1:] for f in FAULTS], ids=[f[0] for f in FAULTS])
def test_broken_plugins_say_why_and_stop_nothing_else(kind: str, old: str, new: str, text: str, site: Path) -> None:
    group, entry, source, _ = KINDS[kind]
    add(site, kind, source.replace(old, new, 1) if old else new)
    add(site, kind, source.replace("extra", "fine"), package="fake_fine", name=entry.replace("extra", "fine"))
    with pytest.raises(PluginError) as caught:
        group.load(entry)
    message = str(caught.value)
    assert message.startswith(f"{group.kind} '{entry}' of fake-extra 0.3: ")
    assert text in message and "\n" not in message
    assert group.load(entry.replace("extra", "fine")) is not None
    reports = {r.info.name: r for r in group.survey()}
    assert reports[entry].error == message
    assert reports[entry.replace("extra", "fine")].spec is not None


MEMBERS = [
    ("task", "build=lambda m, d: None", "build=3", "TaskSpec.build is of type int; expected a function"),
    ("task", 'summary="a toy"', 'summary=""', "TaskSpec.summary is ''; expected text"),
    (
        "task",
        'SceneSpec("ball", "one ball", lambda s, c: None)',
        '"ball"',
        "TaskSpec.scenes[0] is of type str; expected a SceneSpec",
    ),
    (
        "task",
        'SceneSpec("files", "from files", lambda s, c: None)',
        'SceneSpec("ball", "x", print)',
        "scenes has two of one name",
    ),
    (
        "task",
        "lambda t: []), ConditionSpec",
        "None), ConditionSpec",
        "TaskSpec.conditions[0].parse is of type NoneType; expected a function",
    ),
    (
        "task",
        '"1", (0.0, 1.0)',
        '"1", None',
        "TaskSpec.conditions[0].range is None; expected a lower and a higher number",
    ),
    (
        "task",
        '"m", (0.0, 1.0)',
        '"m", (1.0, 1.0)',
        "TaskSpec.conditions[1].range is (1.0, 1.0); expected a lower and a higher number",
    ),
    (
        "task",
        "loss=lambda s: None,",
        "loss=print, fields={'X': int},",
        "fields['X'] is <class 'int'>; expected a subclass",
    ),
    (
        "task",
        "loss=lambda s: None,",
        "loss=print, fields={'X': DensityField},",
        "fields['X'] lacks the methods density, lower",
    ),
    ("task", "loss=lambda s: None,", "loss=print, example=3,", "TaskSpec.example is of type int"),
    (
        "scene",
        '"two ellipsoids", load',
        '"two ellipsoids", None',
        "SceneExtension.scene.load is of type NoneType; expected a function",
    ),
    (
        "scene",
        'scene=SceneSpec("extra", "two ellipsoids", load)',
        "scene=None",
        "SceneExtension.scene is of type NoneType",
    ),
    (
        "scene",
        'task="static"',
        'task="dynamic"',
        "its SceneExtension is named 'dynamic.extra'; the entry point and the SceneExtension must agree",
    ),
    ("loss", "make=make", "make=None", "LossExtension.make is of type NoneType; expected a function"),
    ("loss", 'name="extra"', 'name="other"', "its LossExtension is named 'other'"),
    ("loss", ", make=make", "", "TypeError"),
    (
        "exporter",
        "write=lambda job: ExportReport((), False)",
        "write=0",
        "Exporter.write is of type int; expected a function",
    ),
    ("exporter", 'options={"size": (1, "of it")}', "options=3", "Exporter.options is of type int; expected a mapping"),
    (
        "exporter",
        'options={"size": (1, "of it")}',
        "options={'size': 1}",
        "options['size'] is 1; expected (default, one line of help)",
    ),
    (
        "exporter",
        'options={"size": (1, "of it")}',
        "default='../x'",
        "Exporter.default is '../x'; expected the name of a file or folder",
    ),
    (
        "exporter",
        'options={"size": (1, "of it")}',
        "suffixes='.json'",
        "Exporter.suffixes is '.json'; expected a tuple",
    ),
    (
        "exporter",
        'options={"size": (1, "of it")}',
        "suffixes=('.JSON',)",
        "expected a tuple of such as '.json', in lower case",
    ),
    ("inspector", "layers=lambda frame: []", "layers='x'", "Inspector.layers is of type str; expected a function"),
    (
        "inspector",
        "layers=lambda frame: []",
        "add=print",
        "Inspector.__init__() got an unexpected keyword argument 'add'",
    ),
    (
        "inspector",
        "layers=lambda frame: []",
        "layers=lambda plotter, frame: None",
        "Inspector.layers is a function of (plotter, frame); expected one of a frame alone, which returns layers",
    ),
]


@pytest.mark.parametrize(("kind", "old", "new", "text"), MEMBERS)
def test_missing_and_wrong_members(kind: str, old: str, new: str, text: str, site: Path) -> None:
    group, entry, source, _ = KINDS[kind]
    assert old in source
    add(site, kind, "from neuprim.core.model.fields import DensityField\n" + source.replace(old, new, 1))
    with pytest.raises(PluginError) as caught:
        group.load(entry)
    assert text in str(caught.value)


def test_a_member_that_vanished(site: Path) -> None:
    add(site, "loss", LOSS + "\nobject.__delattr__(PLUGIN, 'make')\n")
    with pytest.raises(PluginError, match=r"LossExtension.make is missing"):
        registry.load_loss("extra")


@pytest.mark.parametrize("kind", KINDS)
def test_a_clash_names_both(kind: str, site: Path) -> None:
    group, entry, _, _ = KINDS[kind]
    add(site, kind, "raise SystemExit", package="fake_one")
    add(site, kind, "raise SystemExit", package="fake_two")
    expected = rf"{group.kind} '{entry}' is registered by fake-one 0.3 \(fake_one:PLUGIN\) and fake-two 0.3 \(fake_two:PLUGIN\)"
    with pytest.raises(PluginError, match=expected):
        group.load(entry)
    assert "fake_one" not in sys.modules, "a clash is seen in metadata"


def test_a_scene_that_takes_the_name_of_a_tasks_own(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = SCENE.replace('"extra"', '"solids"')
    add(site, "scene", source, name="static.solids")
    task = load_task("static")
    (site / "fake_extra/conf/scene/static/solids.yaml").write_text("wobble: 2.0\n")
    told = r"scene 'solids' of fake-extra 0.3 \(fake_extra:PLUGIN\) has the name of one of task 'static' itself, which is used; "
    with pytest.warns(NeuprimWarning, match=told + "scene=fake-extra:solids chooses the other") as warned:
        assert find_scene(task, "solids").config_package == "neuprim.tasks.static.conf"
        assert find_scene(task, "solids").added_by is None
    assert len(warned) == 1 and "fake_extra" not in sys.modules
    assert find_scene(task, "Fake_Extra:solids").config_package == "fake_extra.conf"
    assert find_scene(task, "neuprim:solids").config_package == "neuprim.tasks.static.conf"
    assert find_scene(load_task("static"), "blender").config_package == "neuprim.tasks.static.conf"
    assert main(["tasks"]) == 0
    shown = "(fake-extra 0.3)  two ellipsoids  [hidden by the task's own; scene=fake-extra:solids chooses it]"
    assert shown in capsys.readouterr().out


def test_a_scene_without_its_yaml(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add(site, "scene")
    (site / "fake_extra/conf/scene/static/extra.yaml").unlink()
    text = "scene 'extra' of task 'static': fake_extra.conf has no scene/static/extra.yaml"
    with pytest.raises(ConfigError, match=text):
        compose(["task=static", "scene=extra"], False)
    assert main(["tasks"]) == 0
    assert f"extra       BROKEN  (fake-extra 0.3)  {text}" in capsys.readouterr().out
    assert compose(["task=static"], False).scene_name == "solids"


def test_a_scene_without_a_config_package(site: Path) -> None:
    add(site, "scene", SCENE.replace("fake_extra.conf", "fake_extra.nowhere"))
    with pytest.raises(
        ConfigError, match=r"scene 'extra' of task 'static': cannot open its config_package 'fake_extra.nowhere'"
    ):
        compose(["task=static", "scene=extra"], False)


def test_tasks_lists_everything_with_origin(toy: Path, site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add(site, "scene")
    add(site, "scene", SCENE.replace('"static"', '"elsewhere"'), package="fake_far", name="elsewhere.extra")
    add(site, "loss", package="fake_loss")
    add(site, "exporter", "raise RuntimeError('not today')", package="fake_exporter")
    add(site, "inspector", package="fake_inspector")
    assert main(["tasks"]) == 0
    out = capsys.readouterr().out
    assert "extra       (fake-extra 0.3)  two ellipsoids" in out
    assert "scenes of tasks that are not installed\n  elsewhere.extra  (fake-far 0.3)" in out
    assert (
        "extra        (fake-loss 0.3)  mean squared error" in out or "extra  (fake-loss 0.3)  mean squared error" in out
    )
    assert "BROKEN  (fake-exporter 0.3)  exporter 'extra' of fake-exporter 0.3: cannot import" in out
    assert "(fake-inspector 0.3)  nothing at all" in out
    assert "toy  (neuprim-toy 0.3)  a toy" in out


# ---------------------------------------------------------------- damaged installations


def test_a_damaged_distribution_does_not_take_the_others_along(toy: Path, site: Path) -> None:
    for i, text in enumerate(("[neuprim.tasks]\nno equals sign\n", "[neuprim.tasks]\nx = \n", "[neuprim.losses\n")):
        info = site / f"damaged{i}-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Name: damaged{i}\nVersion: 1\n")
        (info / "entry_points.txt").write_text(text)
    (site / "binary-1.dist-info").mkdir()
    (site / "binary-1.dist-info" / "METADATA").write_text("Name: binary\nVersion: 1\n")
    (site / "binary-1.dist-info" / "entry_points.txt").write_bytes(b"[neuprim.tasks]\n\xff\xfe = \x00\n")
    assert load_task("toy").name == "toy"
    for group in ALL:
        group.survey()


def test_a_distribution_without_metadata_still_counts(site: Path) -> None:
    add(site, "loss")
    (site / "fake_extra-0.3.dist-info" / "METADATA").unlink()
    info = next(i for i in registry.list_losses() if i.name == "extra")
    assert info.distribution == "unnamed distribution"
    assert registry.load_loss("extra").name == "extra"


def test_of_two_copies_of_a_distribution_the_first_counts(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an editable installation and an older one: no clash with itself."""
    add(site, "loss", "raise SystemExit")
    first = tmp_path / "first"
    install(
        first,
        "fake-extra",
        {"extra": "fake_newer:PLUGIN"},
        {"fake_newer.py": LOSS},
        version="0.4",
        group=LOSSES.entry_points,
    )
    monkeypatch.syspath_prepend(str(first))
    assert [i.origin for i in registry.list_losses() if i.name == "extra"] == ["fake-extra 0.4"]
    assert registry.load_loss("extra").summary == "mean squared error"
    sys.modules.pop("fake_newer", None)

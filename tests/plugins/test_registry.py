"""Finding and loading plugins by name, and what broken ones leave alone."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

from neuprim import __version__
from neuprim.cli import main
from neuprim.config import Job, RunConfig, compose, compose_all
from neuprim.core.errors import ConfigError, NeuprimWarning
from neuprim.plugins.registry import (
    EXPORTERS,
    INSPECTORS,
    LOSSES,
    PLUGIN_GROUPS,
    TASKS,
    PluginError,
    PluginGroup,
    find_registered_scene,
    load_task,
)
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import load_dataset
from neuprim.runs.run import run
from tests.plugins.extras import EXPORTER, INSPECTOR, KINDS, LOSS, SCENE, add
from tests.plugins.fakes import TOY, install, install_groups, site, toy

__all__ = ["site", "toy"]

TAKEN: dict[str, tuple[PluginGroup[Any], str, str]] = {
    "task": (TASKS, "static", TOY.replace('"toy"', '"static"').replace("TASK", "PLUGIN")),
    "loss": (LOSSES, "photometric", LOSS.replace('"extra"', '"photometric"')),
    "exporter": (EXPORTERS, "ply", EXPORTER.replace('"extra"', '"ply"')),
    "inspector": (INSPECTORS, "slices", INSPECTOR.replace('"extra"', '"slices"')),
}
"""Kind -> group, a name that a built-in plugin has, source of another package's plugin of that name."""


# ---------------------------------------------------------------- loading


@pytest.mark.parametrize("kind", KINDS)
def test_a_plugin_is_listed_without_import_and_loaded_by_name(kind: str, site: Path) -> None:
    group, entry, _, cls = KINDS[kind]
    add(site, kind)
    add(site, kind, "raise SystemExit", package="fake_other", name=entry.replace("extra", "other"))
    info = next(info for info in group.list_plugins() if info.name == entry)
    assert (info.origin, info.target) == ("fake-extra 0.3", "fake_extra:PLUGIN")
    assert "fake_extra" not in sys.modules
    assert type(group.load(entry)).__name__ == cls
    assert "fake_other" not in sys.modules
    with pytest.raises(ConfigError, match=rf"no such {kind}; did you mean '.*extra'"):
        group.load(entry.replace("extra", "extar"))


def test_a_scene_and_a_loss_of_other_packages_make_a_run(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add(site, "scene")
    add(site, "loss", package="fake_loss")
    monkeypatch.chdir(tmp_path)
    words = ["task=static", "scene=extra", "train.loss=extra", "+task.options.weight=5.0", "output_dir=r"]
    small = ["renderer.backend=reference", "model.primitives=12", "model.neurons=2", "train.iterations=3"]
    run(compose([*words, *small, "train.log_every=1", "train.max_seconds=null"]))
    assert '"mse"' in (tmp_path / "r" / "metrics.jsonl").read_text()
    again = RunConfig.from_yaml(tmp_path / "r")
    assert (again.scene, again.train.loss) == ({"wobble": 2.0}, "extra")
    assert load_dataset(Job(again, load_task("static"))).name == "two"
    assert evaluate_run(tmp_path / "r")["psnr"] > 5


def test_wrong_settings_of_an_added_scene(site: Path) -> None:
    add(site, "scene")
    with pytest.raises(ConfigError, match=r"scene.wobbel: no such setting of scene 'extra'; did you mean"):
        compose(["task=static", "scene=extra", "scene.wobbel=1"], False)
    with pytest.raises(ConfigError, match=r"scene=extra: task 'relight' has no such scene"):
        compose(["task=relight", "scene=extra"], False)
    (site / "fake_extra/conf/scene/static/extra.yaml").unlink()
    with pytest.raises(ConfigError, match=r"scene 'extra' of task 'static': fake_extra.conf has no scene/static/extra"):
        compose(["task=static", "scene=extra"], False)


# ---------------------------------------------------------------- broken plugins

FAULTS = [
    ("", "import a_module_that_is_not_there", "cannot import fake_extra:PLUGIN: ModuleNotFoundError: No module named"),
    ("", "raise GeneratorExit('odd')", "GeneratorExit: odd"),
    ("", "raise RuntimeError('first line\\nsecond')", "RuntimeError: first line second"),
    ("", "PLUGIN = 3", "is of type int; expected a neuprim.core."),
    ("api=1", "api=9", "written for plugin API 9, this neuprim has 1; upgrade neuprim"),
    ('"extra"', '"other"', "extra', as the entry point"),
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("old", "new", "text"), FAULTS)
def test_a_broken_plugin_says_why_and_affects_no_other(kind: str, old: str, new: str, text: str, site: Path) -> None:
    group, entry, source, _ = KINDS[kind]
    fine = entry.replace("extra", "fine")
    add(site, kind, source.replace(old, new, 1) if old else new)
    add(site, kind, source.replace("extra", "fine"), package="fake_fine", name=fine)
    with pytest.raises(PluginError) as caught:
        group.load(entry)
    message = str(caught.value)
    assert message.startswith(f"{group.kind} '{entry}' of fake-extra 0.3: ") and text in message
    assert "\n" not in message
    reports = {report.info.name: report for report in group.survey()}
    assert reports[entry].error == message and reports[fine].spec is group.load(fine)


def test_tasks_lists_everything_with_origin(toy: Path, site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add(site, "scene")
    add(site, "loss", package="fake_loss")
    add(site, "exporter", "raise RuntimeError('not today')", package="fake_exporter")
    _, name, source = TAKEN["inspector"]
    add(site, "inspector", source, package="fake_inspector", name=name)
    assert main(["tasks"]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert f"static (neuprim {__version__})" in " ".join(lines)
    assert "extra (fake-extra 0.3) two ellipsoids" in " ".join(lines)
    assert "extra (fake-loss 0.3) mean squared error" in lines
    assert any(line.startswith("extra (fake-exporter 0.3) BROKEN exporter 'extra' of fake-exporter") for line in lines)
    assert "fake-inspector:slices (fake-inspector 0.3) nothing at all" in lines, "as it is chosen"
    assert "toy (neuprim-toy 0.3) a toy" in lines


# ---------------------------------------------------------------- names that several packages have


@pytest.mark.parametrize("kind", TAKEN)
def test_a_built_in_plugin_wins_its_name(kind: str, site: Path) -> None:
    group, name, source = TAKEN[kind]
    own = group.load(name)
    install(site, "Greedy_Pkg", {name: "greedy:PLUGIN"}, {"greedy/__init__.py": source}, group=group.entry_points)
    with pytest.warns(NeuprimWarning) as warned:
        assert group.load(name) is own and group.load(name) is own
    choice = group.typed.format(f"greedy-pkg:{name}")
    text = str(warned[0].message)
    assert len(warned) == 1 and "same name: neuprim's own is used, not" in text and f"write {choice}" in text
    assert "greedy" not in sys.modules
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert group.load(f"neuprim:{name}") is own
        for package in ("Greedy_Pkg", "greedy-pkg", "GREEDY.pkg"):
            assert group.load(f"{package}:{name}") is sys.modules["greedy"].PLUGIN


def test_neither_a_similar_name_nor_a_second_copy_is_the_built_in(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = load_task("static")
    for i, name in enumerate(("neuprim-", "neuprim-static", "aneuprim")):
        install(site, name, {"static": f"like{i}:TASK"}, {})
    late = tmp_path / "late"
    files = {"late/__init__.py": "raise SystemExit"}
    install(late, "NEUPRIM", {"static": "late:TASK", "extra": "late:TASK"}, files, version="99")
    monkeypatch.setattr(sys, "path", [*sys.path, str(late)])
    with pytest.warns(NeuprimWarning) as warned:
        assert load_task("static") is own
    assert len(warned) == 3
    with pytest.raises(ConfigError, match="no such task"):
        load_task("extra")


@pytest.mark.parametrize("kind", KINDS)
def test_two_packages_with_one_name_are_both_named(kind: str, site: Path) -> None:
    group, entry, source, _ = KINDS[kind]
    for name in ("one", "two"):
        add(site, kind, source.replace("fake_extra", f"fake_{name}"), package=f"fake_{name}")
    with pytest.raises(PluginError) as caught:
        group.load(entry)
    choices = [group.choice(info) for info in group.list_plugins() if info.name == entry]
    assert f"fake-one 0.3 (fake_one:PLUGIN) and fake-two 0.3 (fake_two:PLUGIN); choose {choices[0]}" in str(
        caught.value
    )
    assert group.load(f"fake-two:{entry}") is sys.modules["fake_two"].PLUGIN
    assert "fake_one" not in sys.modules
    two = next(info for info in group.list_plugins() if info.distribution == "fake-two")
    assert group.typed.format(group.shortest_name(two)) == choices[1]


@pytest.mark.parametrize(
    ("word", "text"),
    [
        ("nobody:static", "task=nobody:static: no such task; nobody is not installed"),
        ("neuprim:statik", "task=neuprim:statik: no such task; did you mean 'static'?"),
    ],
)
def test_words_that_choose_nothing(word: str, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        TASKS.load(word)
    assert str(caught.value) == text


def test_a_scene_with_the_name_of_a_tasks_own(site: Path) -> None:
    add(site, "scene", SCENE.replace('"extra"', '"solids"'), name="static.solids")
    (site / "fake_extra/conf/scene/static/solids.yaml").write_text("wobble: 3.0\n")
    preset = site / "fake_extra/conf/preset/static/quick.yaml"
    preset.parent.mkdir(parents=True)
    preset.write_text("model: {primitives: 7}\n")
    task = load_task("static")
    with pytest.warns(
        NeuprimWarning,
        match="name: one of task 'static' itself is used, not .*; to use it, write scene=fake-extra:solids",
    ):
        assert find_registered_scene(task, "solids").added_by is None
    assert "fake_extra" not in sys.modules
    assert find_registered_scene(task, "neuprim:solids").config_package == "neuprim.tasks.static.conf"
    config = compose(["task=static", "scene=fake-extra:solids"], False)
    assert (config.scene_name, config.scene, config.model.auto_primitives) == ("solids", {"wobble": 3.0}, 250)
    for word in ("fake-extra:solid", "nobody:solids"):
        with pytest.raises(ConfigError, match=f"scene={word}: task 'static' has no such scene of"):
            find_registered_scene(task, word)


def test_a_task_of_a_taken_name_has_its_own_files(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    source = TOY.replace('"toy"', '"static"').replace("toytask", "other").replace('"ball"', '"solids"')
    files = {
        "other/__init__.py": source,
        "other/conf/__init__.py": "",
        "other/conf/task/static.yaml": "scene: solids\npreset: quick\noptions: {gain: 2.0}\n",
        "other/conf/scene/static/solids.yaml": "wobble: 1.0\n",
        "other/conf/scene/static/files.yaml": "_paths_: [path]\npath: ???\n",
        "other/conf/preset/static/quick.yaml": "train: {iterations: 7}\n",
    }
    install(site, "other-static", {"static": "other:TASK"}, files)
    theirs = compose(["task='Other_Static:static'", "scene=other-static:solids"])
    assert (theirs.task, theirs.scene, theirs.options) == ("static", {"wobble": 1.0}, {"gain": 2.0})
    assert theirs.train.iterations == 7
    assert str(theirs.output_dir) == "outputs/other-static-static-other-static-solids"
    configs = compose_all(["task=neuprim:static,other-static:static", "seed=1"])
    assert [str(c.output_dir) for c in configs] == [
        "outputs/sweep/task-neuprim_static",
        "outputs/sweep/task-other-static_static",
    ]
    assert [compose(c.overrides).scene == c.scene for c in configs] == [True, True]


# ---------------------------------------------------------------- damaged installations


def test_a_damaged_distribution_does_not_affect_the_others(toy: Path, site: Path) -> None:
    for i, text in enumerate(("[neuprim.tasks]\nno equals sign\n", "[neuprim.tasks]\nx = \n", "[neuprim.losses\n")):
        info = install_groups(site, f"damaged{i}", {}, {})
        (info / "entry_points.txt").write_text(text)
    (install_groups(site, "binary", {}, {}) / "entry_points.txt").write_bytes(b"[neuprim.tasks]\n\xff\xfe = \x00\n")
    assert load_task("toy").name == "toy"
    for group in PLUGIN_GROUPS:
        group.survey()

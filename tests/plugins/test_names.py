"""Names that several packages claim, ``PACKAGE:NAME``, packages that are imported half-way, and editable
installations."""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

from neuprim import __version__
from neuprim.cli import main
from neuprim.config import RunConfig, compose, compose_all
from neuprim.core.errors import ConfigError
from neuprim.core.notices import NeuprimWarning
from neuprim.plugins.registry import (
    ALL,
    EXPORTERS,
    INSPECTORS,
    LOSSES,
    SCENES,
    TASKS,
    Group,
    PluginError,
    find_scene,
    load_task,
)
from tests.plugins.extras import EXPORTER, INSPECTOR, LOSS, SCENE, add
from tests.plugins.fakes import TOY, TOY_FILES, install, install_groups, site, toy
from tests.plugins.marked import static_model, write_run
from tests.plugins.pages import layers_of

__all__ = ["site", "toy"]

TAKEN: dict[str, tuple[Group[Any], str, str]] = {
    "task": (TASKS, "static", TOY.replace('"toy"', '"static"').replace("TASK", "PLUGIN")),
    "loss": (LOSSES, "photometric", LOSS.replace('"extra"', '"photometric"')),
    "exporter": (EXPORTERS, "ply", EXPORTER.replace('"extra"', '"ply"')),
    "inspector": (INSPECTORS, "slices", INSPECTOR.replace('"extra"', '"slices"')),
}
"""Kind -> group, a name that a built-in has, source of somebody else's of that name."""


def everything_taken(site: Path, source: str = "raise SystemExit('imported')") -> None:
    """A package that claims a name of every kind."""
    groups = {group.entry_points: {name: "greedy:PLUGIN"} for group, name, _ in TAKEN.values()}
    install_groups(
        site,
        "Greedy_Pkg",
        {**groups, SCENES.entry_points: {"static.solids": "greedy:PLUGIN"}},
        {"greedy/__init__.py": source},
    )


# ---------------------------------------------------------------- the built-in wins


@pytest.mark.parametrize("kind", TAKEN)
def test_a_built_in_wins_and_the_other_is_named_once_and_not_imported(kind: str, site: Path) -> None:
    group, name, _ = TAKEN[kind]
    own = group.load(name)
    everything_taken(site)
    what = f"{kind} '{name}' of Greedy_Pkg 0.3 (greedy:PLUGIN) has the name of neuprim's own, which is used; "
    with pytest.warns(NeuprimWarning) as warned:
        assert group.load(name) is own and group.load(name) is own
    assert [str(w.message) for w in warned] == [what + group.typed.format(f"greedy-pkg:{name}") + " chooses the other"]
    assert "greedy" not in sys.modules


@pytest.mark.parametrize("kind", TAKEN)
def test_each_is_chosen_by_its_package(kind: str, site: Path) -> None:
    group, name, source = TAKEN[kind]
    own = group.load(name)
    install(site, "Greedy_Pkg", {name: "greedy:PLUGIN"}, {"greedy/__init__.py": source}, group=group.entry_points)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert group.load(f"neuprim:{name}") is own
        assert "greedy" not in sys.modules
        for package in ("Greedy_Pkg", "greedy-pkg", "GREEDY.pkg"):
            assert group.load(f"{package}:{name}") is sys.modules["greedy"].PLUGIN


def test_neither_a_similar_name_nor_a_second_copy_is_the_built_in(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = load_task("static")
    for i, name in enumerate(("neuprim-", "neuprim-static", "aneuprim")):
        install(site, name, {"static": f"like{i}:TASK"}, {})
    late = tmp_path / "late"
    install(
        late,
        "NEUPRIM",
        {"static": "late:TASK", "extra": "late:TASK"},
        {"late/__init__.py": "raise SystemExit"},
        version="99",
    )
    monkeypatch.setattr(sys, "path", [*sys.path, str(late)])
    with pytest.warns(NeuprimWarning) as warned:
        assert load_task("static") is own
    assert len(warned) == 3
    with pytest.raises(ConfigError, match="no such task"):
        load_task("extra")


def test_two_packages_that_are_not_built_in(site: Path) -> None:
    for name in ("one", "two"):
        add(site, "exporter", package=f"fake_{name}")
    with pytest.raises(PluginError) as caught:
        EXPORTERS.load("extra")
    assert str(caught.value) == (
        "exporter 'extra' is registered by fake-one 0.3 (fake_one:PLUGIN) and fake-two 0.3 (fake_two:PLUGIN); "
        "choose --format fake-one:extra or --format fake-two:extra"
    )
    assert EXPORTERS.load("fake-two:extra") is sys.modules["fake_two"].PLUGIN
    assert "fake_one" not in sys.modules


def test_an_old_run_stays_readable_beside_a_package_that_claims_everything(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run from before makers were recorded: its task is a bare name."""
    words = [
        "task=static",
        "scene=solids",
        "scene.size=16",
        "scene.train_views=4",
        "scene.test_views=1",
        "scene.supersampling=1",
    ]
    run = write_run(tmp_path / "run", static_model(), words)
    config = run / "config.yaml"
    text = config.read_text()
    config.write_text(text[: text.index("made_by:")])
    assert RunConfig.from_yaml(run).made_by is None
    everything_taken(site)
    cameras = tmp_path / "cameras.json"
    matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    cameras.write_text(json.dumps({"w": 8, "h": 8, "camera_angle_x": 0.8, "frames": [{"transform_matrix": matrix}]}))
    assert main(["render", str(run), "--camera", str(cameras), "--out", str(tmp_path / "x.png")]) == 0
    assert main(["export", str(run), "--format", "ply", "--json"]) == 0
    out, err = capsys.readouterr()
    record = json.loads(out[out.index("{") :])
    assert record["lossless"] is True and Path(record["files"][0]).is_file()
    assert [line for line in err.splitlines() if "warning" in line] == [
        f"neuprim: warning: {kind} '{name}' of Greedy_Pkg 0.3 (greedy:PLUGIN) has the name of neuprim's own, which is used; {word} chooses the other"
        for kind, name, word in (
            ("task", "static", "task=greedy-pkg:static"),
            ("exporter", "ply", "--format greedy-pkg:ply"),
        )
    ]
    assert main(["inspect", str(run), "--show", "slices", "--grid", "8", "--out", str(tmp_path / "x.html")]) == 0
    assert main(["eval", str(run)]) == 0
    assert "greedy" not in sys.modules
    assert "scene 'solids' of Greedy_Pkg 0.3" in capsys.readouterr().err


def test_what_is_listed_says_how_to_choose_it(site: Path, toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind, (group, name, source) in TAKEN.items():
        install(
            site,
            f"greedy-{kind}",
            {name: f"greedy_{kind}:PLUGIN"},
            {f"greedy_{kind}/__init__.py": source},
            group=group.entry_points,
        )
    files = {
        path.replace("toytask/", "greedy_task/").replace("toy", "static"): text for path, text in TOY_FILES.items()
    }
    for path, text in files.items():
        if path.endswith(".yaml") or "conf" in path:
            (site / path).parent.mkdir(parents=True, exist_ok=True)
            (site / path).write_text(text)
    (site / "greedy_task/__init__.py").write_text(TAKEN["task"][2].replace("toytask.conf", "greedy_task.conf"))
    for name in ("one", "two"):
        add(site, "loss", package=f"fake_{name}")
    assert main(["tasks"]) == 0
    out, err = capsys.readouterr()
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert any(line.startswith(f"static (neuprim {__version__})") and "[" not in line for line in lines)
    assert "static (greedy-task 0.3) a toy [hidden by the built-in task; task=greedy-task:static chooses it]" in lines
    assert (
        "ply (greedy-exporter 0.3) nothing at all [hidden by the built-in exporter; --format greedy-exporter:ply chooses it]"
        in lines
    )
    assert (
        "slices (greedy-inspector 0.3) nothing at all [hidden by the built-in inspector; --show greedy-inspector:slices chooses it]"
        in lines
    )
    assert (
        "extra (fake-one 0.3) mean squared error [also registered by fake-two 0.3; train.loss=fake-one:extra chooses this one]"
        in lines
    )
    assert "BROKEN" not in out and err == ""
    assert main(["run", "--help"]) == 0
    assert "  greedy-task:static  (greedy-task 0.3)" in capsys.readouterr().out


def test_a_page_keeps_anothers_view_apart_from_its_own(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, name, source = TAKEN["inspector"]
    other = source.replace("lambda frame: []", "lambda frame: [Text('of another')]")
    files = {"my_views/__init__.py": f"from neuprim.inspect.layers import Text\n{other}"}
    install(site, "my-views", {name: "my_views:PLUGIN"}, files, group=INSPECTORS.entry_points)
    run, page = str(write_run(tmp_path / "run", static_model(), ["task=static", "scene=solids"])), tmp_path / "x.html"
    assert main(["inspect", run, "--show", "volume,my-views:slices", "--grid", "8", "--out", str(page)]) == 0
    (frame,) = layers_of(page)["frames"]
    assert [layer["kind"] for layer in frame["layers"]["slices"]["model"]] == ["slices"]
    assert frame["layers"]["my-views:slices"]["model"] == [
        {"kind": "text", "text": "of another", "corner": "lower_right"}
    ]
    assert main(["inspect", run, "--show", "volume,slices", "--grid", "8", "--out", str(page), "--force"]) == 0
    assert "my-views:slices" not in page.read_text()
    assert "--show my-views:slices chooses the other" in capsys.readouterr().err


# ---------------------------------------------------------------- PACKAGE:NAME in the configuration


def other_static(site: Path) -> None:
    """A task ``static`` of another package, with a scene and presets of the built-in's names."""
    install(
        site,
        "other-static",
        {"static": "other:TASK"},
        {
            "other/__init__.py": TOY.replace('"toy"', '"static"')
            .replace("toytask", "other")
            .replace('"ball"', '"solids"'),
            "other/conf/__init__.py": "",
            "other/conf/task/static.yaml": "scene: solids\npreset: quick\noptions: {gain: 2.0}\n",
            "other/conf/scene/static/solids.yaml": "wobble: 1.0\n",
            "other/conf/scene/static/files.yaml": "_paths_: [path]\npath: ???\n",
            "other/conf/preset/static/quick.yaml": "train: {iterations: 7}\n",
            "other/conf/preset/static/paper.yaml": "train: {iterations: 11}\n",
        },
    )


def test_a_task_of_a_taken_name_has_its_own_files(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    built_in = compose(["task=neuprim:static"])
    other_static(site)
    with pytest.warns(NeuprimWarning, match="task=other-static:static chooses the other"):
        bare = compose(["task=static"])
    assert (bare.scene, bare.train, bare.options) == (built_in.scene, built_in.train, {})
    for word in ("task=other-static:static", "task='Other_Static:static'"):
        theirs = compose([word])
        assert (theirs.task, theirs.scene_name, theirs.scene, theirs.options) == (
            "static",
            "solids",
            {"wobble": 1.0},
            {"gain": 2.0},
        )
        assert theirs.train.iterations == 7
        assert compose([word, "preset=paper"]).train.iterations == 11
        assert compose([word, "scene=other-static:solids"]).scene == {"wobble": 1.0}
        with pytest.raises(ConfigError, match="scene=blender: task 'static' has no such scene"):
            compose([word, "scene=blender"])
        with pytest.raises(ConfigError, match="scene=neuprim:solids: task 'static' has no such scene"):
            compose([word, "scene=neuprim:solids"])
    assert (str(built_in.output_dir), str(bare.output_dir)) == (
        "outputs/neuprim-static-solids",
        "outputs/static-solids",
    )
    assert str(theirs.output_dir) == "outputs/other-static-static-solids"


def test_a_configuration_keeps_its_package_on_disk(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    other_static(site)
    add(site, "loss")
    config = compose(["task=other-static:static", "train.loss=Fake_Extra:extra"])
    (tmp_path / "config.yaml").write_text(config.to_yaml())
    again = RunConfig.from_yaml(tmp_path)
    assert again == config and again.train.loss == "Fake_Extra:extra"
    assert again.made_by is not None and again.made_by.loss is not None
    assert (again.made_by.task.origin, again.made_by.loss.origin) == ("other-static 0.3", "fake-extra 0.3")


def test_sweeps_name_their_folders_after_package_and_name(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    other_static(site)
    configs = compose_all(["task=neuprim:static,other-static:static", "seed=1"])
    assert [str(c.output_dir) for c in configs] == [
        "outputs/sweep/task-neuprim_static",
        "outputs/sweep/task-other-static_static",
    ]
    assert [c.made_by.task.package for c in configs if c.made_by] == ["neuprim", "other-static"]
    assert [compose(c.overrides).scene == c.scene for c in configs] == [True, True], (
        "the words of one run of a sweep can be typed again"
    )
    seeds = compose_all(["task=other-static:static", "seed=1,2"])
    assert str(seeds[0].output_dir) == "outputs/other-static-static-solids-sweep/seed-1"


def test_a_scene_of_a_taken_name_has_its_own_file_and_the_tasks_presets(site: Path) -> None:
    add(site, "scene", SCENE.replace('"extra"', '"solids"'), name="static.solids")
    (site / "fake_extra/conf/scene/static/solids.yaml").write_text("wobble: 3.0\n")
    preset = site / "fake_extra/conf/preset/static/quick.yaml"
    preset.parent.mkdir(parents=True)
    preset.write_text("model: {primitives: 7}\n")
    config = compose(["task=static", "scene=fake-extra:solids"], False)
    assert (config.scene_name, config.scene, config.model.primitives) == ("solids", {"wobble": 3.0}, 2800)
    assert (
        config.made_by is not None
        and config.made_by.scene is not None
        and config.made_by.scene.origin == "fake-extra 0.3"
    )
    own = compose(["task=static", "scene=neuprim:solids"], False)
    assert "wobble" not in own.scene and own.made_by is not None and own.made_by.scene is None
    with pytest.raises(
        ConfigError,
        match=r"scene=fake-extra:solid: task 'static' has no such scene of fake-extra; did you mean 'solids'",
    ):
        find_scene(load_task("static"), "fake-extra:solid")
    with pytest.raises(ConfigError, match=r"scene=nobody:solids: task 'static' has no such scene of nobody$"):
        find_scene(load_task("static"), "nobody:solids")


def test_two_scenes_of_one_name(site: Path) -> None:
    for name in ("one", "two"):
        add(site, "scene", SCENE.replace("fake_extra", f"fake_{name}"), package=f"fake_{name}")
    with pytest.raises(PluginError, match="choose scene=fake-one:extra or scene=fake-two:extra"):
        compose(["task=static", "scene=extra"], False)
    made_by = compose(["task=static", "scene=fake-two:extra"], False).made_by
    assert made_by is not None and made_by.scene is not None and made_by.scene.package == "fake-two"
    assert "fake_one" not in sys.modules


# ---------------------------------------------------------------- words that choose nothing


@pytest.mark.parametrize(
    ("word", "text"),
    [
        ("nobody:static", "task=nobody:static: no such task; nobody is not installed"),
        ("pytest:static", f"task=pytest:static: no such task; pytest {pytest.__version__} registers no task"),
        ("neuprim:statik", "task=neuprim:statik: no such task of neuprim; did you mean 'static'?"),
        (":static", "task=:static: no such task; expected NAME or PACKAGE:NAME of a task"),
        ("neuprim:", "task=neuprim:: no such task of neuprim; valid: dynamic, relight, static"),
    ],
)
def test_words_that_choose_nothing(word: str, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        TASKS.load(word)
    assert str(caught.value) == text


def test_names_that_cannot_be(site: Path) -> None:
    install(
        site,
        "colon",
        {"a:b": "colon:PLUGIN"},
        {"colon/__init__.py": LOSS.replace('"extra"', '"a:b"')},
        group=LOSSES.entry_points,
    )
    with pytest.raises(PluginError, match=r"loss 'a:b' of colon 0\.3: a name cannot hold ':'"):
        LOSSES.load("colon:a:b")
    info = install_groups(site, "stutter", {LOSSES.entry_points: {"same": "stutter:ONE"}}, {})
    (info / "entry_points.txt").write_text("[neuprim.losses]\nsame = stutter:ONE\nsame = stutter:TWO\n")
    text = r"loss 'same' is registered by stutter 0.3 \(stutter:ONE\) and stutter 0.3 \(stutter:TWO\); a package may register a name once"
    for word in ("same", "stutter:same"):
        with pytest.raises(PluginError, match=text):
            LOSSES.load(word)
    assert next(r.error for r in LOSSES.survey() if r.info.name == "same") is not None


# ---------------------------------------------------------------- half imported


def test_everything_of_a_package_that_fails_half_way_is_broken(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its modules are imported by then: the first plugin that is asked for fails, and Python would hand out the
    others."""
    sources = {
        "losses": LOSS,
        "exporters": EXPORTER,
        "inspectors": INSPECTOR,
        "scenes": SCENE,
        "tasks": TOY.replace("toy", "extra"),
    }
    names = {"losses": "extra", "exporters": "extra", "inspectors": "extra", "scenes": "static.extra", "tasks": "extra"}
    parts = {f"half/{name}/__init__.py": source.replace("TASK =", "PLUGIN =") for name, source in sources.items()}
    init = "\n".join(f"from half import {name}" for name in sources) + "\nraise RuntimeError('no licence found')\n"
    groups = {f"neuprim.{name}": {names[name]: f"half.{name}:PLUGIN"} for name in sources}
    install_groups(site, "half", groups, {**parts, "half/__init__.py": init})
    for _ in range(2):
        for group in ALL:
            report = next(r for r in group.survey() if r.info.distribution == "half")
            assert report.spec is None and "RuntimeError: no licence found" in (report.error or ""), group.kind
    assert main(["tasks"]) == 0
    out = capsys.readouterr().out
    assert out.count("BROKEN") == 5 and out.count("cannot import half.") == 5


def test_a_part_of_a_package_may_fail_alone(site: Path) -> None:
    files = {
        "half/__init__.py": "",
        "half/fine.py": LOSS,
        "half/bad/__init__.py": "from half.bad import good\nimport half.fine\nraise ValueError",
        "half/bad/good.py": LOSS,
    }
    install(
        site,
        "half",
        {"extra": "half.fine:PLUGIN", "bad": "half.bad:x", "good": "half.bad.good:PLUGIN"},
        files,
        group=LOSSES.entry_points,
    )
    fine = LOSSES.load("extra")
    for _ in range(2):
        for word in ("bad", "good"):
            with pytest.raises(PluginError, match="ValueError"):
                LOSSES.load(word)
    assert LOSSES.load("extra") is fine, "what was imported whole stays the same object"


def test_an_import_that_raises_what_is_no_exception(site: Path) -> None:
    add(site, "loss", "raise GeneratorExit('odd')")
    with pytest.raises(PluginError, match="cannot import fake_extra:PLUGIN: GeneratorExit: odd"):
        LOSSES.load("extra")


# ---------------------------------------------------------------- editable installations


def editable(site: Path, source: Path, pyproject: str, name: str = "glowing") -> None:
    source.mkdir()
    (source / "pyproject.toml").write_text(pyproject)
    info = install_groups(site, name, {}, {})
    (info / "direct_url.json").write_text(json.dumps({"url": source.as_uri(), "dir_info": {"editable": True}}))


def test_an_entry_point_that_an_editable_installation_lacks(site: Path, tmp_path: Path) -> None:
    source = tmp_path / "my package"
    editable(
        site,
        source,
        '[project.entry-points."neuprim.exporters"]\nglow = "g:E"\n[project.entry-points."neuprim.scenes"]\n"static.glow" = "g:S"\n'
        '[tool.poetry.plugins."neuprim.tasks"]\nglow = "g:T"\n',
    )
    again = f"; {source / 'pyproject.toml'} registers it, but was installed before it did: run pip install -e '{source}' again"
    for load, word in (
        (EXPORTERS.load, "glow"),
        (EXPORTERS.load, "glowing:glow"),
        (TASKS.load, "glow"),
        (lambda word: find_scene(load_task("static"), word), "glow"),
    ):
        with pytest.raises(ConfigError) as caught:
            load(word)
        assert str(caught.value).endswith(again), str(caught.value)
    for load, word in ((EXPORTERS.load, "glew"), (EXPORTERS.load, "neuprim:glow"), (LOSSES.load, "glow")):
        with pytest.raises(ConfigError) as caught:
            load(word)
        assert "again" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["not toml = = =", "project = 3", '[project.entry-points]\n"neuprim.losses" = 3', "\x00"]
)
def test_a_damaged_source_is_no_hint(text: str, site: Path, tmp_path: Path) -> None:
    editable(site, tmp_path / "source", text)
    (install_groups(site, "odd", {}, {}) / "direct_url.json").write_text("[]")
    with pytest.raises(
        ConfigError, match=r"train.loss=glow: no such loss; valid: compressed, l1, photometric, relative$"
    ):
        LOSSES.load("glow")

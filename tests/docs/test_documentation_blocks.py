"""What the documentation shows runs: Python blocks as they stand, commands as far as their words go."""

from __future__ import annotations

import json
import re
import shutil
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.cli import COMMANDS
from neuprim.cli.command import split_settings
from neuprim.config import compose, compose_all
from neuprim.config.command_settings import (
    take_budget_override,
    take_launcher_overrides,
    take_target_overrides,
    take_viewer_overrides,
)
from neuprim.config.overrides import drop_output_overrides
from neuprim.conformance import named_checks
from neuprim.core.cameras.camera_files import read_cameras
from neuprim.core.conditions import read_conditions, split_conditions
from neuprim.core.data.dataset_check import check_dataset_views
from neuprim.core.errors import NeuprimError
from neuprim.core.io.images import write_png
from neuprim.core.io.vdb import VdbGrid, vdb_scale_transform, write_vdb
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.task import SceneContext
from neuprim.plugins.new_task import write_plugin_package
from neuprim.plugins.registry import EXPORTERS, TASKS
from neuprim.runs.run import run
from tests import lpips_weights
from tests.docs.pages import PAGES, ROOT, Block, blocks, commands, name_of

NOT_RUN: dict[str, int] = {"docs/static.md": 1}
"""Page -> how many of its Python and shell blocks carry a comment ``<!-- not run: reason -->``."""

EVERY = [block for page in PAGES for block in blocks(page)]
PYTHON = [page for page in PAGES if any(b.language == "python" and b.skipped is None for b in blocks(page))]
SHELL = [block for block in EVERY if block.language == "sh" and block.skipped is None]
OF_THE_READER = {
    "docs/plugins.md": {"task=glow", "--dimmer", "0:1:60"},
    "docs/plugin_reference.md": {"scene=ball", "train.loss=charbonnier", "task.options.width=0.05"},
}
"""Page -> words of its commands that name what its reader writes; they are left out, the rest of the command is
checked."""

STAND_INS = {"DEG": "30", "N": "3", "F": "12", "WxH": "64x48"}
"""Placeholders whose values the command line reads as numbers."""

PLACEHOLDER = re.compile(r"[A-Z]{2,}")


def place(block: Block) -> str:
    return f"{name_of(block.page)}:{block.line}"


def test_every_block_runs_but_those_listed() -> None:
    skipped = [name_of(b.page) for b in EVERY if b.language in ("python", "sh") and b.skipped is not None]
    assert {page: skipped.count(page) for page in skipped} == NOT_RUN


# ---------------------------------------------------------------- Python


@pytest.fixture(scope="module")
def static_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny run of the built-in static scene."""
    out = tmp_path_factory.mktemp("documented") / "static-solids"
    small = ["scene.size=48", "scene.train_views=6", "scene.test_views=2", "model.primitives=50", "model.neurons=2"]
    budget = ["train.iterations=5", "train.max_seconds=null"]
    return run(compose(["task=static", "scene=solids", f"output_dir='{out}'", *small, *budget]))


def with_run(static_run: Path) -> None:
    shutil.copytree(static_run, Path("outputs/static-solids"))


def with_volumes(static_run: Path) -> None:
    values = torch.rand(10, 10, 10).numpy()
    grid = VdbGrid.from_dense("density", values, lower=(0, 0, 0), transform=vdb_scale_transform(0.1))
    Path("frames").mkdir()
    for path in ("smoke.vdb", "frames/smoke_001.vdb", "frames/smoke_002.vdb"):
        write_vdb(path, [grid])


def with_run_and_volumes(static_run: Path) -> None:
    with_run(static_run)
    with_volumes(static_run)


def with_plugin_package(static_run: Path) -> None:
    """Make the package of ``neuprim new-task glow`` importable."""
    folder = static_run.parent / "neuprim-glow"
    if not folder.exists():
        write_plugin_package("glow", folder)
        sys.path.insert(0, str(folder))


def with_run_and_plugin_package(static_run: Path) -> None:
    with_run(static_run)
    with_plugin_package(static_run)


def with_weights(static_run: Path) -> None:
    """Random weights of LPIPS."""
    Path("weights").mkdir()
    lpips_weights.written(Path("weights"), lpips_weights.weights("alex"))


def has_copy(names: dict[str, Any]) -> None:
    assert Path("copy.vdb").stat().st_size > 1000 and names["dense"].shape == (64, 64, 64) and len(names["frames"]) == 2


def has_frames(names: dict[str, Any]) -> None:
    assert names["frames"].rgb.shape == (2, 32, 48, 3) and names["frames"].alpha.max() > 0.1


def has_same_metrics(names: dict[str, Any]) -> None:
    assert names["metrics"]["psnr"] == names["again"]["psnr"] and len(names["files"]) == 3
    frame = names["frame"]
    assert frame.rgb.shape == (32, 32, 3) and frame.alpha.shape == frame.depth.shape == (32, 32)
    assert frame.alpha.max() > 0.1
    assert len(names["curve"]) > 1 and names["fitted"].trainer.step == 20


def has_a_loader_of_photographs(names: dict[str, Any]) -> None:
    data, folder = names["ball"](16, 9, 1), Path("capture")
    folder.mkdir()
    frames = []
    for i, camera in enumerate(data.train.cameras):
        write_png(folder / f"camera_{i:03d}.png", data.train.pixels(i).over(data.background))
        pose = torch.linalg.inv(camera.viewmat) * torch.tensor([1.0, -1.0, -1.0, 1.0])  # OpenGL axes
        frames.append({"fl_x": camera.fx, "w": 16, "h": 16, "transform_matrix": pose.tolist()})
    (folder / "cameras.json").write_text(json.dumps({"frames": frames}))
    read = names["photographs"]({"path": "capture"}, SceneContext(0, Path("cache")))
    check_dataset_views(read, ())
    assert (len(read.train), len(read.test), read.name, read.extent) == (7, 2, "capture", pytest.approx(4.4, rel=0.2))
    assert torch.allclose(read.train.view(0).camera.viewmat, data.train.cameras[1].viewmat.double(), atol=1e-5)
    assert torch.allclose(read.center, torch.zeros(3), atol=1e-4)
    assert 0 < len(read.initial_points(50, torch.Generator()).means) <= 50


def has_plugin_objects(names: dict[str, Any]) -> None:
    has_a_loader_of_photographs(names)
    made = import_module("neuprim_glow")
    waves = names["Waves"]
    fields = {"Waves": waves, "PlainColour": made.PlainColour}
    task = replace(made.TASK, build=lambda model, data: (waves(), made.PlainColour(data.channels)), fields=fields)
    for check in ("fields", "parameters", "integral", "scaling", "split"):
        named_checks(task)[check]()


PREPARE: dict[str, Callable[[Path], None]] = {
    "docs/api/images.md": with_weights,
    "docs/api/model.md": with_run,
    "docs/api/render.md": with_run,
    "docs/api/runs.md": with_run,
    "docs/api/task.md": with_run_and_plugin_package,
    "docs/api/train.md": with_run,
    "docs/data_formats.md": with_run_and_volumes,
    "docs/plugins.md": with_plugin_package,
    "docs/plugin_reference.md": with_plugin_package,
}
"""Page -> puts the files that its blocks talk about into the working directory."""

AFTER: dict[str, Callable[[dict[str, Any]], None]] = {
    "docs/data_formats.md": has_copy,
    "docs/rasterize.md": has_frames,
    "docs/getting_started.md": has_same_metrics,
    "docs/plugin_reference.md": has_plugin_objects,
}
"""Page -> checks what its blocks left behind."""


@pytest.mark.parametrize("page", PYTHON, ids=name_of)
def test_python_blocks(page: Path, static_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All blocks of a page in their order, in one namespace and an empty directory."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    PREPARE.get(name_of(page), lambda run: None)(static_run)
    names: dict[str, Any] = {"__name__": "documentation"}
    for block in blocks(page):
        if block.language == "python" and block.skipped is None:
            exec(compile("\n" * (block.line - 1) + block.text, str(page), "exec", dont_inherit=True), names)
    AFTER.get(name_of(page), lambda names: None)(names)


def test_json_blocks_are_json_and_the_cameras_are_cameras(tmp_path: Path) -> None:
    texts = [b.text for b in EVERY if b.language == "json"]
    (cameras,) = [text for text in texts if "frames" in json.loads(text) and "pl_pos" not in text]
    path = tmp_path / "cameras.json"
    path.write_text(cameras)
    first, second = [camera for _, camera in read_cameras(path)]
    for camera in (first, second):  # both look at the middle of the scene
        x, y, z, _ = camera.viewmat @ torch.tensor([0.0, 0.0, 0.5, 1.0], dtype=torch.float64)
        assert z == 4 and abs(x) < 1e-12 and abs(y) < 1e-12
    assert (second.fx, second.cx, second.cy) == (900, 300, 240)


# ---------------------------------------------------------------- commands


@pytest.fixture(scope="module")
def conditions() -> list[ConditionSpec]:
    """The conditions of all tasks."""
    specs = [report.spec for report in TASKS.survey()]
    return [c for spec in specs if spec is not None for c in spec.conditions]


def check(words: list[str], conditions: list[ConditionSpec]) -> None:
    """Raises where the command line or the configuration would refuse ``neuprim WORDS``."""
    name = words[0]
    parser = COMMANDS[name].build_parser()
    settings, others = split_settings(words[1:], parser) if COMMANDS[name].settings else ([], words[1:])
    args, rest = parser.parse_known_args(others)
    if name == "run":
        for take in (take_viewer_overrides, take_launcher_overrides, take_target_overrides):
            _, settings = take(settings)
        if (args.multirun and not drop_output_overrides(settings)) or args.config is not None or args.out is not None:
            settings = ["task=static", *settings]  # the others may be in a file
        (compose_all if args.multirun else compose)([s for s in settings if s != "resume=true"], False)
    elif name == "truth":
        (compose_all if args.multirun else compose)(take_launcher_overrides(settings)[1], False)
    elif name == "bench":
        compose(["scene=blender", "scene.path=DIR", *take_budget_override(settings)[1]], False)
    elif name == "tradeoff" and args.run_dir is None:
        compose(take_launcher_overrides(take_budget_override(settings)[1])[1], False)
    elif name == "export":
        options = EXPORTERS.load(args.format).options if not PLACEHOLDER.search(args.format) else {}
        rest += [word for word in settings if word.partition("=")[0] not in options]
    if name in ("render", "inspect", "export"):
        given, rest = split_conditions(rest, conditions)
        known = {condition: text for condition, text in given.items() if not PLACEHOLDER.search(text)}
        read_conditions(conditions, known, pytest.fail)
    assert rest == [], f"{rest} is no argument of neuprim {name}"


@pytest.mark.parametrize("block", [b for b in SHELL if any(commands(b, "neuprim"))], ids=place)
def test_commands(
    block: Block, conditions: list[ConditionSpec], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    unknown = OF_THE_READER.get(name_of(block.page), set())
    for words in commands(block, "neuprim"):
        words = [STAND_INS.get(word, word) for word in words if word not in unknown]
        check([word for word in words if word != "--help"], conditions)


@pytest.mark.parametrize(
    "line",
    [
        "neuprim run task=static model.primitive=3",
        "neuprim render RUN_DIR --camera orbit --time 2",
        "neuprim export RUN_DIR --format vdb gird=8",
        "neuprim evla RUN_DIR",
    ],
)
def test_a_wrong_command_is_noticed(line: str, conditions: list[ConditionSpec]) -> None:
    (words,) = commands(Block(ROOT / "x.md", 1, "sh", f"cd x && .venv/bin/{line}  # text\n", None), "neuprim")
    with pytest.raises((AssertionError, KeyError, NeuprimError)):
        check(words, conditions)


def test_scripts_that_commands_name_exist() -> None:
    text = {name_of(page): page.read_text(encoding="utf-8") for page in PAGES}
    named = {
        (page, path)
        for page, words in text.items()
        for path in re.findall(r"python3? ((?:benchmarks|docs|examples)/[\w/]+\.py)", words)
    }
    assert len(named) > 5
    assert [(page, path) for page, path in named if not (ROOT / path).is_file()] == []


def test_extras_that_pages_name_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    found = [
        (name_of(page), extra)
        for page in PAGES
        for names in re.findall(r"(?:neuprim|'\.)\[([a-z,]+)\]", page.read_text(encoding="utf-8"))
        for extra in names.split(",")
    ]
    assert len(found) > 5
    assert [pair for pair in found if pair[1] not in extras] == []

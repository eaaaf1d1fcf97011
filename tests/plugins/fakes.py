"""Third-party packages made on the spot: files and a ``.dist-info`` in a directory on ``sys.path``."""

from __future__ import annotations

import importlib
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from neuprim.core import errors
from neuprim.plugins import registry

TOY = """
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.task import SceneSpec, TaskSpec

TASK = TaskSpec(
    api=1,
    name="toy",
    summary="a toy",
    config_package="toytask.conf",
    scenes=(SceneSpec("ball", "one ball", lambda s, c: None), SceneSpec("files", "from files", lambda s, c: None)),
    build=lambda m, d: None,
    loss=lambda s: None,
    options={"gain": (1.0, "of the amplifier")},
    uses=("model.neurons",),
    conditions=(ConditionSpec("time", (), "1", (0.0, 1.0), lambda t: []),
                ConditionSpec("light_pos", (3,), "m", (0.0, 1.0), lambda t: [])),
)
"""

TOY_FILES = {
    "toytask/__init__.py": TOY,
    "toytask/conf/__init__.py": "",
    "toytask/conf/task/toy.yaml": "scene: ball\noptions: {gain: 1.0}\n",
    "toytask/conf/scene/toy/ball.yaml": "size: 20\nsmooth: false\nlook: auto\nratio: 0.5\nsteps: [1, 2]\n",
    "toytask/conf/scene/toy/files.yaml": "_paths_: [path]\npath: ???\ndownsample: 1\n",
    "toytask/conf/preset/toy/quick.yaml": "train: {iterations: 7, rates: {means: 1e-3}}\n",
    "toytask/conf/preset/toy/long.yaml": "model: {primitives: 9}\ntrain: {iterations: 700}\nrenderer: {near: 0.5}\n",
}


def install(
    root: Path,
    distribution: str,
    tasks: Mapping[str, str],
    files: Mapping[str, str],
    version: str = "0.3",
    group: str = registry.TASKS.entry_points,
) -> None:
    """Puts a distribution with entry points ``tasks`` of a group and source ``files`` under ``root``."""
    install_groups(root, distribution, {group: tasks}, files, version)


def install_groups(
    root: Path,
    distribution: str,
    groups: Mapping[str, Mapping[str, str]],
    files: Mapping[str, str],
    version: str = "0.3",
) -> Path:
    """The same with entry points of several groups; returns the distribution's folder of metadata."""
    info = root / f"{distribution.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
    sections = [
        f"[{group}]\n" + "".join(f"{name} = {target}\n" for name, target in entries.items())
        for group, entries in groups.items()
    ]
    (info / "entry_points.txt").write_text("\n".join(sections))
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return info


def uninstall(root: Path, distribution: str) -> None:
    """Removes a distribution's metadata; its modules are found no longer, and forgotten."""
    for info in root.glob(f"{distribution.replace('-', '_')}-*.dist-info"):
        for target in (info / "entry_points.txt").read_text().splitlines():
            top = target.partition("=")[2].strip().partition(":")[0].partition(".")[0]
            if top and (root / top).is_dir():
                shutil.rmtree(root / top)
            for name in [n for n in sys.modules if top and n.partition(".")[0] == top]:
                del sys.modules[name]
        shutil.rmtree(info)
    importlib.invalidate_caches()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty directory on ``sys.path``; what was imported from it is forgotten afterwards, and no warning was given
    before."""
    monkeypatch.setattr(errors, "_said", set())
    root = tmp_path / "site"
    root.mkdir()
    monkeypatch.syspath_prepend(str(root))
    yield root
    ours = {entry.stem for entry in root.iterdir()}
    for name in [n for n in sys.modules if n.partition(".")[0] in ours]:
        del sys.modules[name]


@pytest.fixture
def toy(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The task ``toy`` of the distribution ``neuprim-toy``, with an empty working directory; returns its package's
    folder."""
    install(site, "neuprim-toy", {"toy": "toytask:TASK"}, TOY_FILES)
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    return site / "toytask"

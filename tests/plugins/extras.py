"""One plugin of every kind, as small as can be, in a package of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from neuprim.plugins.registry import EXPORTERS, INSPECTORS, LOSSES, SCENES, TASKS, PluginGroup
from tests.plugins.fakes import TOY, install

__all__ = ["EXPORTER", "INSPECTOR", "KINDS", "LOSS", "SCENE", "add"]

SCENE = """
from neuprim.core.extensions import SceneExtension
from neuprim.core.task import SceneSpec

def load(settings, context):
    from tests.core.tiny import two_primitives
    assert settings == {"wobble": 2.0}
    return two_primitives()

PLUGIN = SceneExtension(api=1, task="static", scene=SceneSpec("extra", "two ellipsoids", load),
                        config_package="fake_extra.conf")
"""
LOSS = """
from neuprim.core.extensions import LossExtension

def make(settings):
    weight = settings["options"]["weight"]
    assert settings["ssim_weight"] >= 0 and isinstance(weight, float)
    def loss(rendered, truth, frame):
        value = weight * (rendered - truth).square().mean()
        return value, {"mse": value.item()}
    return loss

PLUGIN = LossExtension(
    api=1, name="extra", summary="mean squared error", make=make,
    options={"weight": (3.0, "of it")}, uses=("train.ssim_weight",)
)
"""
EXPORTER = """
from neuprim.core.extensions import Exporter, ExportReport
PLUGIN = Exporter(api=1, name="extra", summary="nothing at all", write=lambda job: ExportReport((), False),
                  options={"size": (1, "of it")})
"""
INSPECTOR = """
from neuprim.core.extensions import Inspector
PLUGIN = Inspector(api=1, name="extra", summary="nothing at all", layers=lambda frame: [])
"""
KINDS: dict[str, tuple[PluginGroup[Any], str, str, str]] = {
    "task": (TASKS, "extra", TOY.replace('name="toy"', 'name="extra"').replace("TASK", "PLUGIN"), "TaskSpec"),
    "scene": (SCENES, "static.extra", SCENE, "SceneExtension"),
    "loss": (LOSSES, "extra", LOSS, "LossExtension"),
    "exporter": (EXPORTERS, "extra", EXPORTER, "Exporter"),
    "inspector": (INSPECTORS, "extra", INSPECTOR, "Inspector"),
}
"""Kind -> group, entry point, source, class."""


def add(site: Path, kind: str, source: str | None = None, package: str = "fake_extra", name: str = "") -> None:
    group, entry, text, _ = KINDS[kind]
    files = {f"{package}/__init__.py": source or text, f"{package}/conf/__init__.py": ""}
    files[f"{package}/conf/scene/static/extra.yaml"] = "wobble: 2.0\n"
    install(site, package.replace("_", "-"), {name or entry: f"{package}:PLUGIN"}, files, group=group.entry_points)

"""Scenes of the static task, whose data sets this task fits as well; found by name, so they may come from anywhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuprim.core.data import Dataset
from neuprim.core.task import SceneContext, SceneSpec

__all__ = ["SCENES"]


def _like_static(name: str, summary: str) -> SceneSpec:
    def load(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
        from neuprim.plugins.registry import find_registered_scene, load_task

        return find_registered_scene(load_task("neuprim:static"), name).spec.load(settings, context)

    return SceneSpec(name, summary, load)


SCENES = (
    _like_static("solids", "the built-in scene of the static task, small"),
    _like_static("blender", "NeRF-synthetic layout: transforms_train.json, RGBA images: scene.path=DIR"),
)

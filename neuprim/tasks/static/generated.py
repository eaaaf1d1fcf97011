"""Load the generated scenes of the static task: ``scene=solids`` and ``scene=room``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from neuprim.core.data import Dataset
from neuprim.core.task import SceneContext
from neuprim.core.validation import validate
from neuprim.scenes.room.generate import RoomSettings, generate_room
from neuprim.scenes.solids import SolidsSettings, generate_solids
from neuprim.tasks.static.datasets import load_blender, load_nerfstudio


def load_solids(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load ``scene=solids``: drawn on first use, read from ``context.cache_dir`` afterwards."""
    folder = generate_solids(validate(SolidsSettings, settings, "scene"), context.cache_dir, context.progress)
    return replace(load_blender({"path": str(folder)}, context), name="solids", data_source="generated")


def load_room(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load ``scene=room``: drawn on first use, read from ``context.cache_dir`` afterwards."""
    folder = generate_room(validate(RoomSettings, settings, "scene"), context.cache_dir, context.progress)
    dataset = load_nerfstudio({"path": str(folder)}, context)
    return replace(dataset, name="room", data_source="generated", up=torch.tensor([0.0, 0.0, 1.0]))

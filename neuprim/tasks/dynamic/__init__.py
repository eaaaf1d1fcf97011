"""The dynamic task: smoke and fire, from OpenVDB sequences or from images with a time each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuprim.core.data import Dataset
from neuprim.core.data.dataset import GroundTruth
from neuprim.core.errors import ConfigError
from neuprim.core.model.densities.cosine import DENSITY_OPTIONS, DENSITY_TRADE
from neuprim.core.model.fields import ColourField, ConditionSpec, DensityField
from neuprim.core.task import API_VERSION, Chunks, SceneContext, SceneSpec, TaskSpec
from neuprim.core.train.losses import photometric
from neuprim.core.validation import validate_choices
from neuprim.core.volumes.source import VolumeSource
from neuprim.tasks.dynamic import evaluation
from neuprim.tasks.dynamic.colour import FREQUENCIES, TimeHarmonics
from neuprim.tasks.dynamic.density import TimeDensity


def _check(model: Mapping[str, Any]) -> None:
    validate_choices(model["density"], "model.density", {"time": str, "divide_above": float, **DENSITY_OPTIONS})
    validate_choices(model["colour"], "model.colour", {"frequencies": tuple(FREQUENCIES), "powers": int, "waves": int})
    try:
        _build_density(model)
    except ValueError as error:
        raise ConfigError(f"model.density.time: {error}") from error
    try:
        TimeHarmonics(model["sh_degree"], **model["colour"])
    except ValueError as error:
        raise ConfigError(f"model.colour: {error}") from error


def _build_density(model: Mapping[str, Any], components: tuple[str, ...] = ()) -> TimeDensity:
    return TimeDensity(model["neurons"], **model["density"], components=components)


def _tunable_settings(model: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    parts = ("none", "phase", "window", "window+motion", "phase+window+motion")
    bands: dict[str, tuple[Any, ...]] = {
        "model.sh_degree": (0, 1, 2, 3),
        "model.colour.powers": (0, 2, 4),
        "model.colour.waves": (0, 2, 4),
    }
    return {**DENSITY_TRADE, "model.density.time": parts, **bands}


def _build(model: Mapping[str, Any], dataset: Dataset) -> tuple[DensityField, ColourField]:
    components = () if dataset.points is None else dataset.points.components
    return _build_density(model, components), TimeHarmonics(
        model["sh_degree"], dataset.channels, model["sh_every"], **model["colour"]
    )


# Loaders are imported when used: each pulls in modules of its own.


def _load_volume_scene(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    from neuprim.tasks.dynamic.volume.scene import load_dataset

    return load_dataset(settings, context)


def _open_volumes(settings: Mapping[str, Any], context: SceneContext) -> VolumeSource:
    from neuprim.tasks.dynamic.volume.scene import open_volumes

    return open_volumes(settings, context)


def _open_ground_truth(
    settings: Mapping[str, Any], context: SceneContext, known: Mapping[str, Any] | None
) -> GroundTruth:
    from neuprim.tasks.dynamic.volume.scene import open_ground_truth

    return open_ground_truth(settings, context, known)


def _split_chunks(config: Mapping[str, Any], context: SceneContext) -> Chunks | None:
    from neuprim.tasks.dynamic.volume.scene import split_chunks

    return split_chunks(config, context)


def _load_multiview(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    from neuprim.tasks.dynamic.multiview import load

    return load(settings, context)


def parse_time(text: str) -> list[Tensor]:
    """Parse a time in 0..1 after ``--time``; raise ConfigError for anything else."""
    try:
        time = float(text)
    except ValueError:
        time = math.nan
    if not 0.0 <= time <= 1.0:
        raise ConfigError(
            f"--time {text}: expected a time in 0..1, as 0.5, or FIRST:LAST or FIRST:LAST:COUNT, as 0:1:100"
        )
    return [torch.tensor(time)]


_VOLUME_SCENES = {
    "smoke_fire": "fire under dark smoke, 100 timesteps; simulated, or scene.vdb=DIR",
    "colorful_smoke": "coloured smoke, 128 timesteps; simulated, or scene.vdb=DIR",
    "ground_explosion": "a blast and its cloud, 130 timesteps; simulated, or scene.vdb=DIR",
    "dust_tornado": "a column of dust, 100 timesteps; simulated, or scene.vdb=DIR",
    "vdb": "any sequence of .vdb files: scene.vdb=DIR",
}

TASK = TaskSpec(
    api=API_VERSION,
    name="dynamic",
    summary="Smoke and fire over time, from OpenVDB sequences or images with a time each (time inside the density)",
    config_package="neuprim.tasks.dynamic.conf",
    scenes=(
        *(
            SceneSpec(name, summary, _load_volume_scene, _open_volumes, _open_ground_truth, _split_chunks)
            for name, summary in _VOLUME_SCENES.items()
        ),
        SceneSpec("multiview", "images with a time per frame (D-NeRF layout): scene.path=DIR", _load_multiview),
    ),
    build=_build,
    loss=photometric,
    check=_check,
    tunable_settings=_tunable_settings,
    conditions=(ConditionSpec("time", (), "fraction of the sequence", (0.0, 1.0), parse_time, sweep="0:1"),),
    fields={"TimeDensity": TimeDensity, "TimeHarmonics": TimeHarmonics},
    uses=("model.neurons", "model.sh_degree", "model.sh_every", "train.ssim_weight"),
    mask=evaluation.mask,
    diagnose=evaluation.diagnose,
    clips=evaluation.clips,
    layers=evaluation.LAYERS,
)

"""The dynamic task: smoke and fire, from OpenVDB sequences or from images with a time each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuprim.core.data import Dataset
from neuprim.core.data.dataset import GroundTruth
from neuprim.core.errors import ConfigError
from neuprim.core.model.densities.cosine import DENSITY_OPTIONS, DENSITY_TRADE
from neuprim.core.model.fields import ColourField, ConditionSpec, DensityField
from neuprim.core.task import API_VERSION, Chunks, SceneContext, SceneSpec, TaskSpec
from neuprim.core.train.losses import photometric
from neuprim.core.validation import validate_choices
from neuprim.core.volumes.source import VolumeSource
from neuprim.tasks.dynamic import judging
from neuprim.tasks.dynamic.colour import FREQUENCIES, TimeHarmonics
from neuprim.tasks.dynamic.density import TimeDensity
from neuprim.tasks.dynamic.layers import LAYERS
from neuprim.tasks.dynamic.time import parse_times

__all__ = ["TASK"]


def _check(model: Mapping[str, Any]) -> None:
    validate_choices(model["density"], "model.density", {"time": str, "divide_above": float, **DENSITY_OPTIONS})
    validate_choices(model["colour"], "model.colour", {"frequencies": tuple(FREQUENCIES), "powers": int, "waves": int})
    try:
        _density(model)
    except ValueError as error:
        raise ConfigError(f"model.density.time: {error}") from error
    try:
        TimeHarmonics(model["sh_degree"], **model["colour"])
    except ValueError as error:
        raise ConfigError(f"model.colour: {error}") from error


def _density(model: Mapping[str, Any], components: tuple[str, ...] = ()) -> TimeDensity:
    return TimeDensity(model["neurons"], **model["density"], components=components)


def _trade(model: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    parts = ("none", "phase", "window", "window+motion", "phase+window+motion")
    bands: dict[str, tuple[Any, ...]] = {
        "model.sh_degree": (0, 1, 2, 3),
        "model.colour.powers": (0, 2, 4),
        "model.colour.waves": (0, 2, 4),
    }
    return {**DENSITY_TRADE, "model.density.time": parts, **bands}


def _build(model: Mapping[str, Any], dataset: Dataset) -> tuple[DensityField, ColourField]:
    components = () if dataset.points is None else dataset.points.components
    return _density(model, components), TimeHarmonics(
        model["sh_degree"], dataset.channels, model["sh_every"], **model["colour"]
    )


# Loaders are imported when used: each pulls in modules of its own.


def _volume(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    from neuprim.tasks.dynamic.volume.scene import load

    return load(settings, context)


def _files(settings: Mapping[str, Any], context: SceneContext) -> VolumeSource:
    from neuprim.tasks.dynamic.volume.scene import load_volume

    return load_volume(settings, context)


def _truth(settings: Mapping[str, Any], context: SceneContext, known: Mapping[str, Any] | None) -> GroundTruth:
    from neuprim.tasks.dynamic.volume.scene import load_truth

    return load_truth(settings, context, known)


def _chunks(config: Mapping[str, Any], context: SceneContext) -> Chunks | None:
    from neuprim.tasks.dynamic.volume.scene import load_chunks

    return load_chunks(config, context)


def _multiview(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    from neuprim.tasks.dynamic.multiview import load

    return load(settings, context)


TASK = TaskSpec(
    api=API_VERSION,
    name="dynamic",
    summary="Smoke and fire over time, from OpenVDB sequences or images with a time each (time inside the density)",
    config_package="neuprim.tasks.dynamic.conf",
    scenes=(
        SceneSpec(
            "smoke_fire",
            "fire under dark smoke, 100 timesteps; simulated, or scene.vdb=DIR",
            _volume,
            _files,
            _truth,
            _chunks,
        ),
        SceneSpec(
            "colorful_smoke",
            "coloured smoke, 128 timesteps; simulated, or scene.vdb=DIR",
            _volume,
            _files,
            _truth,
            _chunks,
        ),
        SceneSpec(
            "ground_explosion",
            "a blast and its cloud, 130 timesteps; simulated, or scene.vdb=DIR",
            _volume,
            _files,
            _truth,
            _chunks,
        ),
        SceneSpec(
            "dust_tornado",
            "a column of dust, 100 timesteps; simulated, or scene.vdb=DIR",
            _volume,
            _files,
            _truth,
            _chunks,
        ),
        SceneSpec("vdb", "any sequence of .vdb files: scene.vdb=DIR", _volume, _files, _truth, _chunks),
        SceneSpec("multiview", "images with a time per frame (D-NeRF layout): scene.path=DIR", _multiview),
    ),
    build=_build,
    loss=photometric,
    check=_check,
    trade=_trade,
    conditions=(ConditionSpec("time", (), "fraction of the sequence", (0.0, 1.0), parse_times, sweep="0:1"),),
    fields={"TimeDensity": TimeDensity, "TimeHarmonics": TimeHarmonics},
    uses=("model.neurons", "model.sh_degree", "model.sh_every", "train.ssim_weight"),
    mask=judging.mask,
    diagnose=judging.diagnose,
    clips=judging.clips,
    layers=LAYERS,
)

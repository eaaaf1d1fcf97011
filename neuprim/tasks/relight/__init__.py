"""The relighting task: images under one point light each in, a model that takes any light out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.model.densities.cosine import DENSITY_OPTIONS, DENSITY_TRADE, CosineDensity
from neuprim.core.model.fields import ColourField, ConditionSpec, DensityField
from neuprim.core.task import API_VERSION, SceneContext, SceneSpec, TaskSpec
from neuprim.core.train.losses import l1
from neuprim.core.validation import validate_choices
from neuprim.tasks.relight import evaluation
from neuprim.tasks.relight.colour import FORMS, VISIBILITY, LightHarmonics, LightNetwork
from neuprim.tasks.relight.lighting import (
    illuminate,
    lighting_of,
    orbit_in_frames,
    parse_intensities,
    parse_lights,
    typical_light,
)

_SETTINGS: dict[str, tuple[Any, ...] | type] = {
    "form": (*FORMS, "harmonics"),
    "hidden": int,
    "visibility": VISIBILITY,
    "boost": float,
    "degree": int,
}


def _colour(model: Mapping[str, Any], falloff: bool = False, typical: float = 1.0) -> ColourField:
    chosen = {"form": "additive", "degree": 5, **model["colour"]}
    degree = chosen.pop("degree")
    if chosen["form"] == "harmonics":
        return LightHarmonics(degree, falloff=falloff, typical=typical)
    return LightNetwork(falloff=falloff, typical=typical, **chosen)


def _check(model: Mapping[str, Any]) -> None:
    validate_choices(model["density"], "model.density", DENSITY_OPTIONS)
    validate_choices(model["colour"], "model.colour", _SETTINGS)
    try:
        _colour(model)
    except ValueError as error:
        raise ConfigError(f"model.colour: {error}") from error


def _tunable_settings(model: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    if model["colour"].get("form") == "harmonics":
        return {**DENSITY_TRADE, "model.colour.degree": (1, 2, 3, 5)}
    return {**DENSITY_TRADE, "model.colour.hidden": (0, 4, 8, 12), "model.colour.visibility": VISIBILITY}


def _build(model: Mapping[str, Any], dataset: Dataset) -> tuple[DensityField, ColourField]:
    if dataset.channels != 3:
        raise ConfigError(
            f"{dataset.name}: {dataset.channels} colour channels; task relight expects 3, as light_intensity has"
        )
    falloff = lighting_of(dataset).falloff == "inverse_square"
    density = CosineDensity(model["neurons"], **model["density"])
    return density, _colour(model, falloff, typical_light(dataset, falloff))


# Loaders are imported when used: each pulls in modules of its own.


def _lit_solids(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    from neuprim.tasks.relight.lit_solids import load

    return load(settings, context)


def _olat(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    from neuprim.tasks.relight.olat import load

    return load(settings, context)


TASK = TaskSpec(
    api=API_VERSION,
    name="relight",
    summary="A scene under any light, from images under one point light each (a colour network per primitive)",
    config_package="neuprim.tasks.relight.conf",
    scenes=(
        SceneSpec(
            "lit_solids", "built in: solids and a glossy ring under moving point lights, with shadows", _lit_solids
        ),
        SceneSpec("olat", "GS3 / NRHints layout: a light position per image, PNG or EXR: scene.path=DIR", _olat),
    ),
    build=_build,
    loss=l1,
    check=_check,
    tunable_settings=_tunable_settings,
    conditions=(
        ConditionSpec(
            "light",
            (3,),
            "position, scene units",
            (-1e6, 1e6),
            parse_lights,
            sweep="orbit",
            in_frames=orbit_in_frames,
            place=parse_lights,
        ),
        ConditionSpec("light_intensity", (3,), "radiometric", (0.0, 1e6), parse_intensities),
    ),
    fields={"CosineDensity": CosineDensity, "LightNetwork": LightNetwork, "LightHarmonics": LightHarmonics},
    environment=illuminate,
    uses=("model.neurons",),
    mask=evaluation.mask,
    metrics=evaluation.metrics,
    diagnose=evaluation.diagnose,
    clips=evaluation.clips,
    facts=evaluation.facts,
    orbit=evaluation.orbit,
    layers=evaluation.LAYERS,
)

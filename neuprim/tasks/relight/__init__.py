"""The task ``relight``: fit a model to images under one point light each, and render it under any light.

Image values are linear light divided by the exposure; 1 is the brightest value of a display. Metrics clamp the values
to 0..1, since a single highlight of 20 would dominate an image's error. Metrics with "linear_clamped" in the name
compare the clamped values. Metrics with "display" convert the clamped values to sRGB first. The metric FLIP needs
``neuprim[flip]``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from neuprim.core.data import Clip, Dataset, View
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.images import linear_to_srgb
from neuprim.core.light_conditions import LIGHT_CONDITIONS, lights_from_environment, summarize_lights, typical_light
from neuprim.core.metrics import mean_metrics as mean_metrics
from neuprim.core.metrics import psnr, ssim
from neuprim.core.metrics.lpips import flip, flip_available
from neuprim.core.model.cosine import DENSITY_OPTIONS, DENSITY_TRADE, CosineDensity
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.light import LIGHT_LAYERS, VISIBILITY
from neuprim.core.task import API_VERSION, SceneSpec, TaskSpec, lazy_function
from neuprim.core.train.losses import l1
from neuprim.core.validation import validate_choices
from neuprim.scenes import PIXEL_CLASSES
from neuprim.tasks.relight.colour import FORMS, LightHarmonics, LightNetwork
from neuprim.tasks.relight.lighting import dataset_lighting
from neuprim.tasks.relight.surface import INDIRECT, SurfaceColour

_NETWORK = {"hidden": 8, "visibility": "primitive", "boost": 5.0}
_OF_FORM: dict[str, dict[str, Any]] = {
    "surface": {"lobes": 1, "indirect": 4, "visibility": "primitive"},
    **dict.fromkeys(FORMS, _NETWORK),
    "harmonics": {"degree": 5},
}
"""Settings of ``model.colour`` for each colour form, with their defaults."""


def _light_colour_field(model: Mapping[str, Any], falloff: bool = False, typical: float = 1.0) -> ColourField:
    form = model["colour"].get("form", "additive")
    chosen = {**_OF_FORM[form], **model["colour"], "form": form, "falloff": falloff, "typical": typical}
    if form in FORMS:
        return LightNetwork(**chosen)
    del chosen["form"]
    return SurfaceColour(**chosen) if form == "surface" else LightHarmonics(**chosen)


def _check_relight_model(model: Mapping[str, Any]) -> None:
    validate_choices(model["density"], "model.density", DENSITY_OPTIONS)
    colour = model["colour"]
    types: dict[str, tuple[Any, ...] | type] = {"hidden": int, "lobes": int, "indirect": int, "degree": int}
    validate_choices(
        colour, "model.colour", {"form": tuple(_OF_FORM), "visibility": VISIBILITY, "boost": float, **types}
    )
    form = colour.get("form", "additive")
    for key in colour:
        if key != "form" and key not in _OF_FORM[form]:
            owners = " or ".join(name for name, own in _OF_FORM.items() if key in own)
            expected = f"model.colour.form={owners}, or no model.colour.{key}"
            raise ConfigError(f"model.colour.{key}={colour[key]}: not a setting of form={form}; expected {expected}")
    try:
        _light_colour_field(model)
    except ValueError as error:
        raise ConfigError(f"model.colour: {error}") from error


def _tunable_relight_settings(model: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    if model["colour"].get("form") == "harmonics":
        return {**DENSITY_TRADE, "model.colour.degree": (1, 2, 3, 5)}
    if model["colour"].get("form") == "surface":
        return {**DENSITY_TRADE, "model.colour.lobes": (0, 1, 2, 3), "model.colour.indirect": INDIRECT}
    return {**DENSITY_TRADE, "model.colour.hidden": (0, 4, 8, 12), "model.colour.visibility": VISIBILITY}


def _build_relight_fields(model: Mapping[str, Any], dataset: Dataset) -> tuple[DensityField, ColourField]:
    if dataset.channels != 3:
        raise ConfigError(
            f"{dataset.name}: images have {dataset.channels} colour channels; "
            "task relight expects 3, because lights are RGB"
        )
    falloff = dataset_lighting(dataset).falloff == "inverse_square"
    density = CosineDensity(model["neurons"], **model["density"])
    return density, _light_colour_field(model, falloff, typical_light(dataset, falloff))


_MIN_ALPHA = 1.0 / 255.0  # least alpha of a pixel that shows matter


def relight_matter_mask(dataset: Dataset, index: int) -> Tensor | None:
    """Return an (H, W) bool mask of a test view's pixels with alpha above 1/255; None for images without alpha."""
    alpha = dataset.test.pixels(index).alpha
    return None if alpha is None else alpha > _MIN_ALPHA


def relight_metrics(
    dataset: Dataset, index: int, rendered: Tensor, truth: Tensor, structure: bool = True
) -> dict[str, float]:
    """Return metric name -> value for the image ``rendered`` (H, W, 3) of a test view; ``truth`` is the ground truth.

    The metrics are those of :func:`relight_scores`. If the test split has parts, such as "new_light", the PSNR is
    repeated under the name of the view's part. If pixels have classes, such as "cast_shadow", errors per class are
    added.
    """
    known, result = dataset_lighting(dataset), relight_scores(rendered, truth, structure)
    part = next((p for p in known.parts if dataset.test.view(index).name.startswith(p)), None)
    if part is not None:
        result[f"psnr_linear_clamped_{part}"] = result["psnr_linear_clamped"]
    if known.classes is None:
        return result
    return result | relight_pixel_class_errors(rendered, truth, known.classes(dataset.test, index))


def diagnose_lighting(dataset: Dataset, model: Primitives) -> dict[str, Any]:
    """Return facts about a relighting run: exposure, falloff, baseline scores, shares of pixel classes in percent."""
    known = dataset_lighting(dataset)
    result: dict[str, Any] = {"exposure": dataset.exposure, "falloff": known.falloff}
    result["baselines"] = lighting_baseline_scores(dataset)
    if not flip_available():
        result["flip_missing"] = "pip install 'neuprim[flip]'"
    if known.classes is not None:
        maps = [known.classes(dataset.test, i) for i in range(len(dataset.test))]
        result["class_percent"] = relight_pixel_class_shares(maps)
    return result


def lighting_baseline_scores(dataset: Dataset) -> dict[str, dict[str, Any]]:
    """Return baseline name -> mean scores over the test views; a baseline is an image made without a model, e.g. black.

    SSIM and FLIP are left out, because they are slow.
    """

    found = {}
    for name, guess in {"black": None, **dataset_lighting(dataset).baselines}.items():
        entries = []
        for i in range(len(dataset.test)):
            truth = dataset.test.pixels(i).over(dataset.background)
            image = torch.zeros_like(truth) if guess is None else guess(dataset.test, i)
            if image is not None:
                entries.append(relight_metrics(dataset, i, image, truth, structure=False))
        if entries:
            found[name] = mean_metrics(entries)
    return found


def relight_clips(dataset: Dataset) -> Sequence[Clip]:
    """Return the video clips of a relighting dataset."""
    return dataset_lighting(dataset).clips


def light_facts(dataset: Dataset) -> dict[str, Any]:
    """Return the entry "lights" for the model's header: a summary of the training lights."""
    lights = torch.stack([dataset.train.view(i).conditions["light"] for i in range(len(dataset.train))])
    return {"lights": summarize_lights(lights, dataset.center, dataset_lighting(dataset).falloff, dataset.exposure)}


def light_orbit(dataset: Dataset, frames: int) -> list[View]:
    """Return ``frames`` views of a camera orbit, in which the light orbits in the opposite direction.

    The light has the mean distance, mean elevation and mean intensity of the training lights.
    """
    training = [dataset.train.view(i).conditions for i in range(len(dataset.train))]
    up, center = dataset.up.double() / dataset.up.double().norm(), dataset.center.double()
    offsets = torch.stack([c["light"] for c in training]).double() - center
    radius, sine = offsets.norm(dim=-1).mean(), ((offsets @ up) / offsets.norm(dim=-1).clamp_min(1e-30)).mean()
    side = torch.linalg.cross(up, torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())])
    side = side / side.norm()
    other = torch.linalg.cross(up, side)
    intensity = torch.stack([c["light_intensity"] for c in training]).mean(0)
    views = []
    for i, view in enumerate(dataset.orbit(frames)):
        turn = -2.0 * math.pi * i / frames
        across = math.cos(turn) * side + math.sin(turn) * other
        light = center + radius * (sine * up + (1.0 - sine * sine).clamp_min(0.0).sqrt() * across)
        views.append(View(view.name, view.camera, {"light": light.float(), "light_intensity": intensity}))
    return views


# ---------------------------------------------------------------- scores


def relight_scores(rendered: Tensor, truth: Tensor, structure: bool = True) -> dict[str, float]:
    """Return scores of an image after clamping to 0..1: the PSNR in linear light and in sRGB ("display").

    With ``structure``, the result also has SSIM and, if FLIP is installed, FLIP; both compare sRGB values.
    """
    first, second = rendered.clamp(0.0, 1.0), truth.clamp(0.0, 1.0)
    result = {"psnr_linear_clamped": psnr(first, second)}
    first, second = linear_to_srgb(first), linear_to_srgb(second)
    result["psnr_display"] = psnr(first, second)
    if structure:
        result["ssim_display"] = ssim(first, second)
        if flip_available():
            result["flip"] = flip(first, second)
    return result


def relight_pixel_class_errors(rendered: Tensor, truth: Tensor, classes: Tensor) -> dict[str, float]:
    """Return MSE and number of pixels for each pixel class in the (H, W) map ``classes``.

    Raises:
        DataError: the map differs from the image in size, or has unknown classes.
    """
    if classes.shape != truth.shape[:2] or int(classes.max()) >= len(PIXEL_CLASSES):
        raise DataError(
            f"pixel classes: the map has shape {tuple(classes.shape)} and values up to {int(classes.max())}; "
            f"expected shape {tuple(truth.shape[:2])} and values below {len(PIXEL_CLASSES)}"
        )
    squares = (rendered.clamp(0.0, 1.0) - truth.clamp(0.0, 1.0)).double().square().mean(-1)
    result: dict[str, float] = {}
    for value, name in enumerate(PIXEL_CLASSES):
        inside = classes == value
        if bool(inside.any()):
            result |= {f"mse_{name}": float(squares[inside].mean()), f"pixels_{name}": float(inside.sum())}
    return result


def relight_pixel_class_shares(maps: list[Tensor]) -> dict[str, float]:
    """Return pixel class -> percent of all pixels that are not background; ``maps`` are (H, W) class indices."""
    counts = torch.stack([torch.bincount(m.reshape(-1).long(), minlength=len(PIXEL_CLASSES)) for m in maps]).sum(0)
    whole = max(float(counts[1:].sum()), 1.0)
    return {name: 100.0 * float(counts[i]) / whole for i, name in enumerate(PIXEL_CLASSES) if i}


TASK = TaskSpec(
    api=API_VERSION,
    name="relight",
    summary="An object under any light, from images under one point light each",
    config_package="neuprim.tasks.relight.conf",
    scenes=(
        SceneSpec(
            "lit_solids",
            "built in: solids and a glossy ring under moving point lights, with shadows",
            lazy_function("neuprim.tasks.relight.datasets:load_lit_solids_for_relighting"),
        ),
        SceneSpec(
            "olat",
            "GS3 / NRHints layout: a light position per image, PNG or EXR: scene.path=DIR",
            lazy_function("neuprim.tasks.relight.datasets:load_olat"),
        ),
    ),
    build=_build_relight_fields,
    loss=l1,
    check=_check_relight_model,
    tunable_settings=_tunable_relight_settings,
    conditions=LIGHT_CONDITIONS,
    fields={
        "CosineDensity": CosineDensity,
        "LightNetwork": LightNetwork,
        "LightHarmonics": LightHarmonics,
        "SurfaceColour": SurfaceColour,
    },
    environment=lights_from_environment,
    uses=("model.neurons",),
    mask=relight_matter_mask,
    metrics=relight_metrics,
    diagnose=diagnose_lighting,
    clips=relight_clips,
    facts=light_facts,
    orbit=light_orbit,
    layers=LIGHT_LAYERS,
)

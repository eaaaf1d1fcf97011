"""The task ``static``: fit a scene that does not change to images with known cameras."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.model.cosine import DENSITY_OPTIONS, DENSITY_TRADE, CosineDensity
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.model.gaussian import GaussianDensity
from neuprim.core.task import API_VERSION, SceneSpec, TaskSpec, lazy_function
from neuprim.core.train.losses import photometric
from neuprim.core.train.settings import ModelSettings
from neuprim.core.validation import validate_choices
from neuprim.tasks.static.colour import SphericalHarmonics, SphericalLobes

__all__ = ["TASK", "SphericalHarmonics", "SphericalLobes"]


_USUAL_LOBES = 2  # lobes per primitive if model.colour.lobes is not set


def _build_static_fields(model: Mapping[str, Any], dataset: Dataset) -> tuple[DensityField, ColourField]:
    chosen = dict(model["density"])
    gaussian = chosen.pop("form", "cosine") == "gaussian"
    density = GaussianDensity() if gaussian else CosineDensity(model["neurons"], **chosen)
    if model["colour"].get("form") == "lobes":
        return density, SphericalLobes(model["colour"].get("lobes", _USUAL_LOBES), dataset.channels)
    return density, SphericalHarmonics(model["sh_degree"], dataset.channels, model["sh_every"])


def _check_static_task_model(model: Mapping[str, Any]) -> None:
    validate_choices(model["density"], "model.density", {"form": ("cosine", "gaussian"), **DENSITY_OPTIONS})
    others = [key for key in model["density"] if key != "form"]
    if model["density"].get("form") == "gaussian" and others:
        expected = f"this form, or no model.density.{others[0]}"
        raise ConfigError(f"model.density.{others[0]}: used only with model.density.form=cosine; expected {expected}")
    _check_colour_settings(model["colour"], model["sh_degree"])


def _check_colour_settings(colour: Mapping[str, Any], degree: int) -> None:
    validate_choices(colour, "model.colour", {"form": ("sh", "lobes"), "lobes": int})
    if colour.get("form") != "lobes":
        if "lobes" in colour:
            raise ConfigError(
                f"model.colour.lobes={colour['lobes']}: used only with model.colour.form=lobes; "
                "expected this form, or no model.colour.lobes"
            )
        return
    try:
        SphericalLobes(colour.get("lobes", _USUAL_LOBES))
    except ValueError as error:
        raise ConfigError(f"model.colour.lobes={colour['lobes']}: {error}") from error
    if degree != ModelSettings.sh_degree:
        raise ConfigError(
            f"model.sh_degree={degree}: not used with model.colour.form=lobes; "
            "expected model.colour.form=sh, or no model.sh_degree"
        )


def _tunable_static_settings(model: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    cosine = model["density"].get("form", "cosine") == "cosine"
    lobes = model["colour"].get("form") == "lobes"
    colour = {"model.colour.lobes": (0, 1, 2)} if lobes else {"model.sh_degree": (0, 1, 2, 3)}
    return {**(DENSITY_TRADE if cosine else {}), **colour}


def _static_dataset_facts(dataset: Dataset) -> Mapping[str, Any]:
    """Return facts for a model's header: name and ``scene_from_file`` matrix of a mesh file; {} for other scenes."""
    return dataset.extra if isinstance(dataset.extra, dict) else {}


_SCENES = {
    "solids": (
        "built in: sharp edges, thin rods, a curved handle; generated in seconds",
        "datasets:load_solids_dataset",
    ),
    "room": (
        "built in: the solids in a textured room, taken like photographs: lens, exposures, points",
        "datasets:load_room_dataset",
    ),
    "mesh": ("your own model, ray-cast: a .glb, .gltf, .obj, .ply or .stl: scene.path=FILE", "mesh:load_mesh"),
    "blender": ("NeRF-synthetic layout: transforms_train.json, RGBA images", "datasets:load_blender"),
    "nerfstudio": ("instant-ngp / nerfstudio transforms.json", "datasets:load_nerfstudio"),
    "colmap": ("COLMAP sparse/0 and images (needs neuprim[colmap])", "datasets:load_colmap"),
}

TASK = TaskSpec(
    api=API_VERSION,
    name="static",
    summary="A scene that does not change, from photographs or other posed images",
    config_package="neuprim.tasks.static.conf",
    scenes=tuple(
        SceneSpec(name, summary, lazy_function(f"neuprim.tasks.static.{function}"))
        for name, (summary, function) in _SCENES.items()
    ),
    build=_build_static_fields,
    loss=photometric,
    check=_check_static_task_model,
    tunable_settings=_tunable_static_settings,
    facts=_static_dataset_facts,
    diagnose=lambda dataset, model: _static_dataset_facts(dataset),
    fields={
        "CosineDensity": CosineDensity,
        "GaussianDensity": GaussianDensity,
        "SphericalHarmonics": SphericalHarmonics,
        "SphericalLobes": SphericalLobes,
    },
    uses=("model.neurons", "model.sh_degree", "model.sh_every", "train.ssim_weight"),
)

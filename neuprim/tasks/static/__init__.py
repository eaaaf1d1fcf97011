"""The static task: a scene that does not change, from posed images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any

from neuprim.core.data import Dataset
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.core.model.densities.cosine import DENSITY_OPTIONS, DENSITY_TRADE, CosineDensity
from neuprim.core.model.densities.gaussian import GaussianDensity
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.task import API_VERSION, SceneContext, SceneSpec, TaskSpec
from neuprim.core.train.losses import photometric
from neuprim.core.validation import validate_choices
from neuprim.tasks.static.fields import SphericalHarmonics

__all__ = ["TASK"]


def _build(model: Mapping[str, Any], dataset: Dataset) -> tuple[DensityField, ColourField]:
    chosen = dict(model["density"])
    gaussian = chosen.pop("form", "cosine") == "gaussian"
    density = GaussianDensity() if gaussian else CosineDensity(model["neurons"], **chosen)
    return density, SphericalHarmonics(model["sh_degree"], dataset.channels, model["sh_every"])


def _check(model: Mapping[str, Any]) -> None:
    validate_choices(model["density"], "model.density", {"form": ("cosine", "gaussian"), **DENSITY_OPTIONS})
    others = [key for key in model["density"] if key != "form"]
    if model["density"].get("form") == "gaussian" and others:
        expected = "none with model.density.form=gaussian"
        raise ConfigError(f"model.density.{others[0]}: of densities of the form cosine; expected {expected}")
    validate_choices(model["colour"], "model.colour", {})


def _tunable_settings(model: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    cosine = model["density"].get("form", "cosine") == "cosine"
    return {**(DENSITY_TRADE if cosine else {}), "model.sh_degree": (0, 1, 2, 3)}


def _load(module: str, function: str, settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Import a loader when it is used, as each pulls in a library of its own, and call it."""
    loader: Callable[..., Dataset] = getattr(import_module(f"neuprim.tasks.static.{module}"), function)
    return loader(settings, context)


def _mesh(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    try:
        import trimesh  # noqa: F401
    except ImportError as error:
        raise BackendUnavailable(f"scene=mesh needs the package trimesh ({error}): pip install trimesh") from error
    return _load("mesh", "load", settings, context)


def _facts(dataset: Dataset) -> Mapping[str, Any]:
    """Of generated data, which file they show and where its points are."""
    return dataset.extra if isinstance(dataset.extra, dict) else {}


TASK = TaskSpec(
    api=API_VERSION,
    name="static",
    summary="A scene that does not change, from posed images (spherical-harmonics colour)",
    config_package="neuprim.tasks.static.conf",
    scenes=(
        SceneSpec(
            "solids",
            "built in: sharp edges, thin rods, a curved handle; generated in seconds",
            partial(_load, "generated", "load_solids"),
        ),
        SceneSpec(
            "room",
            "built in: the solids in a textured room, taken like photographs: lens, exposures, points",
            partial(_load, "generated", "load_room"),
        ),
        SceneSpec("mesh", "your own model, ray-cast: a .glb, .gltf, .obj, .ply or .stl: scene.path=FILE", _mesh),
        SceneSpec(
            "blender",
            "NeRF-synthetic layout: transforms_train.json, RGBA images",
            partial(_load, "datasets", "load_blender"),
        ),
        SceneSpec(
            "nerfstudio", "instant-ngp / nerfstudio transforms.json", partial(_load, "datasets", "load_nerfstudio")
        ),
        SceneSpec(
            "colmap", "COLMAP sparse/0 and images (needs neuprim[colmap])", partial(_load, "datasets", "load_colmap")
        ),
    ),
    build=_build,
    loss=photometric,
    check=_check,
    tunable_settings=_tunable_settings,
    facts=_facts,
    diagnose=lambda dataset, model: _facts(dataset),
    fields={
        "CosineDensity": CosineDensity,
        "GaussianDensity": GaussianDensity,
        "SphericalHarmonics": SphericalHarmonics,
    },
    uses=("model.neurons", "model.sh_degree", "model.sh_every", "train.ssim_weight"),
)

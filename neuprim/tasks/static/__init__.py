"""The static task: a scene that does not change, from posed images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.model import sh
from neuprim.core.model.cosine import DENSITY_OPTIONS, DENSITY_TRADE, CosineDensity
from neuprim.core.model.fields import ColourField, Conditions, Constant, DensityField, read_script
from neuprim.core.model.gaussian import GaussianDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.core.task import API_VERSION, SceneContext, SceneSpec, TaskSpec
from neuprim.core.train.losses import photometric
from neuprim.core.validation import validate_choices

__all__ = ["TASK", "SphericalHarmonics"]


class SphericalHarmonics(ColourField):
    """c = max(0, SH(direction camera -> mu) + 0.5), degree 0..3; C (degree + 1)^2 parameters.

    While training, one band is unlocked every ``sh_every`` of the budget; a loaded model uses all of them.
    """

    def __init__(self, degree: int = 3, channels: int = 3, sh_every: float = 0.0) -> None:
        if not isinstance(degree, int) or not 0 <= degree <= 3:
            raise ValueError(f"spherical-harmonics degree {degree!r}; expected 0..3")
        if not isinstance(channels, int) or channels < 1:
            raise ValueError(f"{channels!r} colour channels; expected at least 1")
        self.degree, self.channels, self.sh_every = degree, channels, sh_every
        self.active = degree

    def settings(self) -> dict[str, Any]:
        return {"degree": self.degree, "channels": self.channels}

    def set_progress(self, progress: float) -> None:
        self.active = min(self.degree, int(progress / self.sh_every + 1e-9)) if self.sh_every > 0 else self.degree

    def parameters(self) -> list[ParameterSpec]:
        C, rest = self.channels, sh.sh_coefficient_count(self.degree) - 1
        specs = [ParameterSpec("sh_dc", (C,), 2e-2, lambda c: sh.initial_sh_dc(c.colors))]
        if rest:
            specs.append(ParameterSpec("sh_rest", (rest, C), 2e-3, lambda c: torch.zeros(c.count, rest, C)))
        return specs

    def reductions(self) -> dict[str, tuple[int, ...]]:
        return {"degree": tuple(range(self.degree - 1, -1, -1))} if self.degree else {}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[SphericalHarmonics, dict[str, Tensor]]:
        return SphericalHarmonics(value, self.channels), sh.truncate_sh_bands(params, "sh_rest", value)

    def harmonics(self, params: Params, conditions: Conditions) -> tuple[Tensor, Tensor | None]:
        return params["sh_dc"], params.get("sh_rest")

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Coefficients, each of one channel."""
        return sh.prunable_sh_coefficients(self.degree, self.channels, "sh_rest")

    def script(self) -> str:
        return read_script(__package__, "fields.js")

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        return Constant(
            sh.sh_colors(geometry.means, params["sh_dc"], params.get("sh_rest"), camera.position, self.active)
        )


def _build_static_fields(model: Mapping[str, Any], dataset: Dataset) -> tuple[DensityField, ColourField]:
    chosen = dict(model["density"])
    gaussian = chosen.pop("form", "cosine") == "gaussian"
    density = GaussianDensity() if gaussian else CosineDensity(model["neurons"], **chosen)
    return density, SphericalHarmonics(model["sh_degree"], dataset.channels, model["sh_every"])


def _check_static_task_model(model: Mapping[str, Any]) -> None:
    validate_choices(model["density"], "model.density", {"form": ("cosine", "gaussian"), **DENSITY_OPTIONS})
    others = [key for key in model["density"] if key != "form"]
    if model["density"].get("form") == "gaussian" and others:
        expected = "none with model.density.form=gaussian"
        raise ConfigError(f"model.density.{others[0]}: of densities of the form cosine; expected {expected}")
    validate_choices(model["colour"], "model.colour", {})


def _tunable_static_settings(model: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    cosine = model["density"].get("form", "cosine") == "cosine"
    return {**(DENSITY_TRADE if cosine else {}), "model.sh_degree": (0, 1, 2, 3)}


def _load_static_scene(module: str, function: str, settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Import a loader when it is used, as each pulls in a library of its own, and call it."""
    loader: Callable[..., Dataset] = getattr(import_module(f"neuprim.tasks.static.{module}"), function)
    return loader(settings, context)


def _static_dataset_facts(dataset: Dataset) -> Mapping[str, Any]:
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
            partial(_load_static_scene, "datasets", "load_solids_dataset"),
        ),
        SceneSpec(
            "room",
            "built in: the solids in a textured room, taken like photographs: lens, exposures, points",
            partial(_load_static_scene, "datasets", "load_room_dataset"),
        ),
        SceneSpec(
            "mesh",
            "your own model, ray-cast: a .glb, .gltf, .obj, .ply or .stl: scene.path=FILE",
            partial(_load_static_scene, "mesh", "load_mesh"),
        ),
        SceneSpec(
            "blender",
            "NeRF-synthetic layout: transforms_train.json, RGBA images",
            partial(_load_static_scene, "datasets", "load_blender"),
        ),
        SceneSpec(
            "nerfstudio",
            "instant-ngp / nerfstudio transforms.json",
            partial(_load_static_scene, "datasets", "load_nerfstudio"),
        ),
        SceneSpec(
            "colmap",
            "COLMAP sparse/0 and images (needs neuprim[colmap])",
            partial(_load_static_scene, "datasets", "load_colmap"),
        ),
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
    },
    uses=("model.neurons", "model.sh_degree", "model.sh_every", "train.ssim_weight"),
)

"""The task ``gaussian``: a static scene of true Gaussian densities."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.task import TaskSpec
from neuprim.core.train.losses import photometric
from neuprim.core.validation import validate_choices
from neuprim_gaussian.colour import ViewDependentColour
from neuprim_gaussian.density import BellDensity
from neuprim_gaussian.scenes import SCENES

__all__ = ["TASK"]


def _build(model: Mapping[str, Any], dataset: Dataset) -> tuple[DensityField, ColourField]:
    return BellDensity(**model["density"]), ViewDependentColour(model["sh_degree"], dataset.channels)


def _check(model: Mapping[str, Any]) -> None:
    """Called before any data are loaded: a typo must not cost a user minutes."""
    validate_choices(model["density"], "model.density", {"deviations": float})
    validate_choices(model["colour"], "model.colour", {})
    try:
        BellDensity(**model["density"])
    except ValueError as error:
        raise ConfigError(f"model.density.deviations: {error}") from error


TASK = TaskSpec(
    api=1,
    name="gaussian",
    summary="A static scene of true Gaussian densities (an example of a third-party task)",
    config_package="neuprim_gaussian.conf",
    scenes=SCENES,
    build=_build,
    loss=photometric,
    check=_check,
    fields={"BellDensity": BellDensity, "ViewDependentColour": ViewDependentColour},
    uses=("model.sh_degree", "train.ssim_weight"),  # of the settings that not every task has; others are refused
)

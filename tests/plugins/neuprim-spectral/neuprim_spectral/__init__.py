"""Multispectral scenes: five bands of light, whose wavelengths shift from view to view."""

from typing import Annotated

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import LossExtension
from neuprim.core.task import SceneSpec, TaskSpec
from neuprim.core.validation import Range, validate_choices
from neuprim_spectral.bands import BANDS, SHIFT, display
from neuprim_spectral.fields import ShiftedSpectrum, TwoScales
from neuprim_spectral.files import files
from neuprim_spectral.loss import spectral_loss
from neuprim_spectral.scene import ball

_HELP = "weight of the angle between spectra in the loss, 0 to 1"
_SHARE = Annotated[float, Range(0, 1)]


def _build(model, dataset):
    return TwoScales(**model["density"]), ShiftedSpectrum(dataset.channels)


def _check(model):
    validate_choices(model["density"], "model.density", {"coarse": int, "fine": int})
    validate_choices(model["colour"], "model.colour", {})
    try:
        TwoScales(**model["density"])
    except ValueError as error:
        raise ConfigError(f"model.density: {error}") from error


TASK = TaskSpec(
    api=1,
    name="spectral",
    summary="Five bands of light from blue to near infrared",
    config_package="neuprim_spectral.conf",
    scenes=(
        SceneSpec("ball", "a ball of three belts, made on the spot", lambda settings, context: ball(**settings)),
        SceneSpec(
            "files", "EXR or .npy images of five bands, and cameras.json", lambda settings, context: files(**settings)
        ),
    ),
    build=_build,
    loss=lambda settings: spectral_loss(settings["options"]["angle"]),
    check=_check,
    conditions=(SHIFT,),
    options={"angle": (0.2, _HELP, _SHARE)},
    uses=(),
    fields={"TwoScales": TwoScales, "ShiftedSpectrum": ShiftedSpectrum},
    example=lambda: ball(size=12, train_views=5, test_views=2),
    channels=BANDS,
    display=display,
)

SPECTRAL_LOSS = LossExtension(
    api=1,
    name="spectral-angle",
    summary="absolute differences and the angle between spectra",
    make=lambda settings: spectral_loss(settings["options"]["angle_weight"]),
    options={"angle_weight": (0.2, _HELP, _SHARE)},
)

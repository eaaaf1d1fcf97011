"""The five bands of light that this task knows, and what they look like."""

import torch

from neuprim.core.errors import ConfigError
from neuprim.core.io.images import linear_to_srgb
from neuprim.core.model.fields import ConditionSpec

BANDS = ("450nm", "550nm", "650nm", "750nm", "850nm")

# A column each for red, green and blue; what is beyond red shows as a dull red.
_TO_RGB = torch.tensor([[0.0, 0.1, 0.9], [0.1, 0.8, 0.1], [0.7, 0.1, 0.0], [0.15, 0.0, 0.0], [0.05, 0.0, 0.0]])


def display(image):
    """(H, W, 5) linear light -> (H, W, 3) sRGB, 0 to 1."""
    return linear_to_srgb((image.clamp_min(0) @ _TO_RGB.to(image)).clamp(0, 1))


def parse_shift(text):
    """The text after --wavelength-shift -> one number."""
    try:
        return [torch.tensor(float(text))]
    except ValueError:
        raise ConfigError(f"--wavelength-shift {text}: expected a number from 0 to 1") from None


SHIFT = ConditionSpec(
    "wavelength_shift", (), "fraction of the distance of two bands", (0.0, 1.0), parse_shift, strict=True
)

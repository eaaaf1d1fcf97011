"""`neuprim inspect --show bands`: the primitives' centres, coloured by the band that they send most of."""

import torch

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Inspector
from neuprim.inspect.layers import Points, Scale
from neuprim_spectral.bands import BANDS
from neuprim_spectral.fields import spectrum


def bands(frame):
    model = frame.model
    if "logit" not in model.params or "wavelength_shift" not in frame.conditions:
        raise ConfigError("--show bands: the model has no spectra, or --wavelength-shift is missing")
    with torch.no_grad():
        best = spectrum(model.params["logit"], frame.conditions["wavelength_shift"]).argmax(1)[
            torch.as_tensor(frame.rows)
        ]
    scale = Scale(0, len(BANDS) - 1, "viridis", "strongest band")
    return [Points(frame.geometry.means.detach().numpy(), values=best.numpy(), scale=scale)]


BANDS_VIEW = Inspector(api=1, name="bands", summary="the strongest band of each primitive", layers=bands, shows="model")

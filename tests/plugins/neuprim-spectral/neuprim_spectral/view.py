"""`neuprim inspect --show bands`: the primitives' centres, coloured by the band that they send most of."""

import torch

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Inspector
from neuprim_spectral.bands import BANDS
from neuprim_spectral.fields import spectrum


def draw(plotter, frame):
    import pyvista

    model = frame.model
    if "logit" not in model.params or "wavelength_shift" not in frame.conditions:
        raise ConfigError("--show bands: the model has no spectra, or --wavelength-shift is missing")
    with torch.no_grad():
        best = spectrum(model.params["logit"], frame.conditions["wavelength_shift"]).argmax(1)[torch.as_tensor(frame.alive)]
    cloud = pyvista.PolyData(frame.geometry.means.detach().numpy())
    cloud.point_data["band"] = best.numpy()
    plotter.add_mesh(cloud, scalars="band", clim=(0, len(BANDS) - 1), render_points_as_spheres=True, point_size=8)


BANDS_VIEW = Inspector(api=1, name="bands", summary="the strongest band of each primitive", add=draw, shows="model")

"""A density of two scales, and a spectrum that is read between its bands."""

import math

import torch

from neuprim.core.model.cosine import cosine_density, split_cosine
from neuprim.core.model.fields import ColourField, Constant, Cosine, DensityField
from neuprim.core.model.schema import ParameterSpec

# Name of each part of the density -> factor of its phases.
_PARTS = {"coarse": 1.0, "fine": 30.0}


class TwoScales(DensityField):
    """sigma = (offset + coarse(x~) + fine(x~)) / m: two cosine networks, of slow and of fast phases.

    Args:
        coarse, fine: units of each.
    """

    init_settings = ("alpha",)

    def __init__(self, coarse=2, fine=4):
        for name, count in (("coarse", coarse), ("fine", fine)):
            if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= 32:
                raise ValueError(f"{name}={count!r}; expected a whole number from 0 to 32")
        self.units = {"coarse": coarse, "fine": fine}

    def settings(self):
        return dict(self.units)

    def parameters(self):
        specs = [
            ParameterSpec(
                "offset", (1,), 1e-2, lambda c: torch.full((c.count, 1), -math.log1p(-c.number("alpha", 0.8, 0, 1)) / 2)
            )
        ]
        for part, omega0 in _PARTS.items():
            K = self.units[part]
            bound = 4.0 / omega0
            specs += [
                ParameterSpec(
                    f"{part}_W1", (K, 3), 3e-2 / omega0, lambda c, K=K, bound=bound: c.uniform(K, 3, bound=bound)
                ),
                ParameterSpec(
                    f"{part}_b1",
                    (K,),
                    3e-2 / omega0,
                    lambda c, K=K, omega0=omega0: c.uniform(K, bound=math.pi / omega0),
                ),
                ParameterSpec(f"{part}_w2", (K,), 1e-2, lambda c, K=K: c.uniform(K, bound=0.1)),
            ]
        return specs

    def lower(self, params, geometry, conditions):
        coarse, fine = (
            Cosine(params[f"{part}_W1"], params[f"{part}_b1"], params[f"{part}_w2"], offset, omega0=omega0)
            for (part, omega0), offset in zip(
                _PARTS.items(), (params["offset"], torch.zeros_like(params["offset"])), strict=True
            )
        )
        return coarse + fine

    def density(self, params, geometry, prim, x, conditions):
        return cosine_density(self.lower(params, geometry, conditions), geometry, prim, x)

    def scale_density(self, params, factor):
        return {**params, **{name: params[name] * factor[:, None] for name in ("offset", "coarse_w2", "fine_w2")}}

    def on_split(self, params, old, new):
        """Children see the waves that their parent saw."""
        rows = {"offset": params["offset"] * (new.length_scale / old.length_scale)[:, None]}
        for part, omega0 in _PARTS.items():
            own = {name: params[f"{part}_{name}"] for name in ("W1", "b1", "w2")}
            children = split_cosine({**own, "b2": params["offset"]}, old, new, omega0)
            rows |= {f"{part}_{name}": children[name] for name in own}
        return rows


def spectrum(logit, shift):
    """(N, C) linear colours of a primitive with logits (N, C + 1), each read ``shift`` (a number) of the way to the
    next one."""
    values = logit.sigmoid()
    return torch.lerp(values[:, :-1], values[:, 1:], shift.to(values))


class ShiftedSpectrum(ColourField):
    """One spectrum per primitive, the same from all sides; a shift reads each band nearer to the next, the last nearer
    to one beyond."""

    def __init__(self, channels=5):
        self.channels = channels

    def settings(self):
        return {"channels": self.channels}

    def parameters(self):
        def start(c):
            logit = c.colors.logit(eps=0.02)
            return torch.cat([logit, logit[:, -1:]], dim=1)

        return [ParameterSpec("logit", (self.channels + 1,), 5e-2, start)]

    def lower(self, params, geometry, camera, conditions):
        return Constant(spectrum(params["logit"], conditions["wavelength_shift"]))

"""Colour field that changes in time: :class:`TimeHarmonics`."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.compute import device
from neuprim.core.model import sh
from neuprim.core.model.fields import ColourField, Conditions, Constant, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.tasks.dynamic.time_density import get_frame_time

FREQUENCIES = {"periods": 2 * math.pi, "printed": 1.0}
"""Setting -> frequency w of the first Fourier term, in radians per sequence. "printed" is the frequency in the paper,
at which the terms are nearly linearly dependent (condition number 5e13). With "periods", every term has a whole number
of periods in the sequence (condition number 2e5)."""

_TIME_TENSORS = ("time_poly", "time_cos", "time_sin")

_FITTED_TIMES = 256  # sampled times at which fewer terms are fitted to all terms
_MIN_SINGULAR = 1e-7  # relative singular value of a fit; weaker coefficients would not survive float32


class TimeHarmonics(ColourField):
    """SH colour whose lowest band changes in time: c = max(0, C0 S(xi) + higher bands + 1/2).

    S(xi) = S0 + sum_{i=1..n} a_i xi^i + sum_{i=1..l} (b_i cos(w i xi) + c_i sin(w i xi)) has 1 + n + 2 l parameters
    per channel: S0, a_i, b_i and c_i. xi is the time, 0..1 over the sequence. C0 is the constant SH of degree 0, n is
    ``powers``, l is ``waves``, and ``frequencies`` chooses w, see :data:`FREQUENCIES`. The higher bands do not change
    in time. With n = l = 4, three channels have 84 parameters at degree 3 and 39 at degree 0.
    """

    def __init__(
        self, degree: int = 3, channels: int = 3, sh_every: float = 0.0, powers: int = 4, waves: int = 4,
        frequencies: str = "periods",
    ) -> None:  # fmt: skip
        if not isinstance(degree, int) or not 0 <= degree <= 3:
            raise ValueError(f"spherical-harmonics degree {degree!r}; expected 0..3")
        if not isinstance(channels, int) or channels < 1:
            raise ValueError(f"{channels!r} colour channels; expected at least 1")
        if not all(isinstance(n, int) and 0 <= n <= 16 for n in (powers, waves)):
            raise ValueError(f"powers {powers!r} and waves {waves!r}; expected 0..16 for each")
        if frequencies not in FREQUENCIES:
            raise ValueError(f"frequencies {frequencies!r}; expected {' or '.join(FREQUENCIES)}")
        self.degree, self.channels, self.sh_every = degree, channels, sh_every
        self.powers, self.waves, self.frequencies = powers, waves, frequencies
        self.active = degree

    @property
    def stage(self) -> int:  # type: ignore[override]
        return self.active

    def settings(self) -> dict[str, Any]:
        names = ("degree", "channels", "powers", "waves", "frequencies")
        return {name: getattr(self, name) for name in names}

    def set_progress(self, progress: float) -> None:
        self.active = min(self.degree, int(progress / self.sh_every + 1e-9)) if self.sh_every > 0 else self.degree

    def parameters(self) -> list[ParameterSpec]:
        C, rest = self.channels, sh.sh_coefficient_count(self.degree) - 1
        specs = [ParameterSpec("sh_dc", (C,), 1e-2, lambda c: sh.initial_sh_dc(c.colors))]
        specs += [ParameterSpec(name, (n, C), 5e-3, _zero_time_colours(n, C)) for name, n in self._term_counts() if n]
        return specs + ([ParameterSpec("sh_rest", (rest, C), 2e-3, _zero_time_colours(rest, C))] if rest else [])

    def _term_counts(self) -> list[tuple[str, int]]:
        return list(zip(_TIME_TENSORS, (self.powers, self.waves, self.waves), strict=True))

    def reductions(self) -> dict[str, tuple[int, ...]]:
        most = {"degree": self.degree, "powers": self.powers, "waves": self.waves}
        return {name: tuple(range(value - 1, -1, -1)) for name, value in most.items() if value}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[TimeHarmonics, dict[str, Tensor]]:
        """Return a field of lower degree or with fewer terms in time, and its parameters.

        Fewer terms in time are fitted to S(xi) of all terms by least squares.
        """
        field = type(self)(**{**self.settings(), name: value})
        if name == "degree":
            return field, sh.truncate_sh_bands(params, "sh_rest", value)
        times = (torch.arange(_FITTED_TIMES, dtype=torch.float64) + 0.5) / _FITTED_TIMES
        all_terms, fewer_terms = (
            torch.stack([torch.cat([torch.ones_like(x)[None], *f._terms(x).values()]) for x in times])
            for f in (self, field)
        )
        # coefficients of all terms -> of those that stay
        fit = torch.linalg.pinv(fewer_terms, rtol=_MIN_SINGULAR) @ all_terms
        stored = torch.cat([params["sh_dc"][:, None], *(params[key] for key in _TIME_TENSORS if key in params)], 1)
        sizes = {key: len(basis) for key, basis in field._terms(times[0]).items()}
        dc, *rest = (
            (device.to_device_like(fit, stored.double()) @ stored.double()).to(stored).split([1, *sizes.values()], 1)
        )
        others = {key: value for key, value in params.items() if key not in _TIME_TENSORS}
        kept = {key: part.contiguous() for key, part in zip(sizes, rest, strict=True) if sizes[key]}
        return field, {**others, **kept, "sh_dc": dc[:, 0].contiguous()}

    def _terms(self, xi: Tensor) -> dict[str, Tensor]:
        """Return name of a parameter tensor -> float64 basis values (powers, cosines or sines) at the time ``xi``."""
        turn = FREQUENCIES[self.frequencies] * xi
        waves = turn * torch.arange(1, self.waves + 1, dtype=torch.float64, device=xi.device)
        powers = xi ** torch.arange(1, self.powers + 1, dtype=torch.float64, device=xi.device)
        return dict(zip(_TIME_TENSORS, (powers, waves.cos(), waves.sin()), strict=True))

    def harmonics(self, params: Params, conditions: Conditions) -> tuple[Tensor, Tensor | None] | None:
        return self.lowest_band(params, conditions), params.get("sh_rest")

    def lowest_band(self, params: Params, conditions: Conditions) -> Tensor:
        """Return S(xi), (N, C): the SH coefficient of degree 0 at the frame's time."""
        dc, xi = params["sh_dc"], get_frame_time(conditions)
        terms = self._terms(xi) if self.powers or self.waves else {}  # none if colours do not change in time
        for name, basis in terms.items():
            if name in params:
                dc = dc + (params[name] * device.to_device_like(basis, dc)[:, None]).sum(1)
        return dc

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Return prunable units (parameters that pruning zeroes together).

        There is one unit per channel and SH coefficient above degree 0, and one unit per term in time.
        """
        terms = ((name, i) for name, count in self._term_counts() for i in range(count))
        units = (PrunableUnit(f"{name} {i + 1}", {name: (i,)}) for name, i in terms)
        return (*sh.prunable_sh_coefficients(self.degree, self.channels, "sh_rest"), *units)

    def script(self) -> str:
        return read_script(__package__, "colour.js")

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        dc = self.lowest_band(params, conditions)
        return Constant(sh.sh_colors(geometry.means, dc, params.get("sh_rest"), camera.position, self.active))


def _zero_time_colours(terms: int, channels: int) -> Any:
    return lambda ctx: torch.zeros(ctx.count, terms, channels)

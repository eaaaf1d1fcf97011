"""How far a backend is from the oracle on one case, in the units of the bounds.

Optical depth is read from a colour channel of colour 1 over black, which keeps float32's relative precision where alpha
is small: I = -log1p(-alpha), up to I = 1.5; beyond, the error of alpha itself counts. What one rounding of alpha
explains is not counted against a float32 image.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.render import RenderSettings, render_lowered
from tests import scenes
from tests.backends import SLOW_HERE, by
from tests.numerics.equivalence import undecided
from tests.numerics.extremes.oracle import Integrals, long_colours, long_integrals

OPEN = RenderSettings(alpha_min=0.0, transmittance_min=0.0, alpha_max=0.9999)
SOLID = 0.45  # shorter chords, as a share of the central one, are thin: D < 0.2, or cut by a near plane
OPAQUE = 1.5  # optical depth beyond which alpha is compared instead
RIM = (
    1e-6  # |D| below which float32 may not know whether a ray meets an ellipsoid, which a hard edge's gradients hang on
)
FUNCTIONALS = 4
KEEPING = ("cpu", "reference")  # what others keep of a frame serves one backward pass
_SHORTEST = 1e-2  # share of the central chord below which a soft edge's error is compared with that of one as long


@dataclass
class Case:
    """Primitives, a camera, settings. ``name`` tells cases of a region apart."""

    tensors: dict[str, Tensor]
    camera: Camera
    settings: RenderSettings = OPEN
    name: str = ""
    edge: int = 0

    def cast(self, precision: str) -> Case:
        dtype = torch.float64 if precision == "float64" else torch.float32
        return replace(self, tensors={k: v.to(dtype) for k, v in self.tensors.items()})

    def for_backend(self, backend: str) -> Case:
        """The case with 8 or 16 units for a GPU's backend on a CPU, which compiles longer than it draws.

        Added units have weight 0.
        """
        if backend not in SLOW_HERE:
            return self
        units = {"W1": 1, "b1": 1, "w2": 1, "Wx": 1, "bias": 1, "Wout": 2}
        t = self.tensors
        most = 8 if max(t[k].shape[axis] for k, axis in units.items() if k in t) <= 8 else 16
        return replace(self, tensors={k: _padded(v, units[k], most) if k in units else v for k, v in t.items()})


def _padded(tensor: Tensor, axis: int, size: int) -> Tensor:
    shape = list(tensor.shape)
    shape[axis] = size - shape[axis]
    return torch.cat([tensor, tensor.new_zeros(shape)], axis)


@dataclass
class Errors:
    """Worst of some cases."""

    forward: float = 0.0  # |dI|/S on solid chords
    # |dI|/S (S/S_c)^2 on thin ones, S_c the central chord's S, and the same for hits missed and misses hit. With a soft
    # edge, whose integrals go as D^(p + 1/2), |dI|/S_c (S_c/S)^(2p - 1)
    thin: float = 0.0
    gradient: float = 0.0  # error of a parameter's gradient over the gradient's norm; parameter is the worst one
    parameter: str = ""
    at: float = 1.0  # S/S_c where forward was found
    hits: int = 0  # pixels compared
    wide: int = 0  # primitives that a fast backend drew in float64
    primitives: int = 0
    worst: dict[str, str] = field(default_factory=dict)

    def absorb(self, other: Errors, name: str) -> None:
        if not other.forward <= self.forward:
            self.forward, self.at, self.worst["forward"] = other.forward, other.at, name
        if not other.thin <= self.thin:
            self.thin, self.worst["thin"] = other.thin, name
        if not other.gradient <= self.gradient:
            self.gradient, self.parameter, self.worst["gradient"] = other.gradient, other.parameter, name
        self.hits, self.wide, self.primitives = (
            self.hits + other.hits,
            self.wide + other.wide,
            self.primitives + other.primitives,
        )


def drawn(case: Case, backend: str) -> tuple[np.ndarray, int]:  # type: ignore[type-arg]
    """(H, W) opacity of the one primitive, float64, and how many primitives were drawn in float64."""
    t = dict(case.tensors)
    t["colors"] = torch.ones_like(t["colors"]).requires_grad_()  # by the kernels that gradients need anyway
    out = render_lowered(scenes.lowered(t), case.camera, replace(case.settings, **by(backend)))
    return out.rgb[..., 0].detach().double().numpy(), int(out.stats.extra.get("float64", 0))


def integral_errors(case: Case, backend: str, exact: Integrals | None = None) -> Errors:
    """Worst |dI|/S over the pixels of a case of one primitive."""
    exact = exact or long_integrals(case.tensors, 0, case.camera, case.settings.near, case.edge)
    alpha, wide = drawn(case, backend)
    low, high = case.settings.alpha_min, case.settings.alpha_max
    true = np.maximum(exact.depth, 0)
    opacity = -np.expm1(-true)
    true = np.where(opacity < low, 0, -np.log1p(-np.minimum(opacity, high)))
    undecided = (low > 0) & (np.abs(opacity - low) < 1e-6)  # float32 may rightly fall on the other side of the cut
    found = -np.log1p(-np.minimum(alpha, np.nextafter(1, 0)))
    # where little light is left, alpha has too few digits to read I from: its own error is compared
    error = np.where(true > OPAQUE, np.abs(alpha - np.minimum(opacity, high)), np.abs(found - true))
    error = np.where(undecided, 0, error)
    if case.tensors["means"].dtype == torch.float32:
        error = np.maximum(error - 2.0**-24 * alpha / (1 - np.minimum(alpha, 0.99999)), 0)
    error = np.where(np.isfinite(alpha), error, np.inf)
    # float32 knows D = 1 - |x_m|^2 to about 1e-7, and dI/S = dD/2D: thin chords get a law of their own
    short = (exact.scale < SOLID * exact.central) & (exact.D > -1)
    share = np.where(short | ~exact.hit, 0, error / np.where(exact.hit, exact.scale, 1)).astype(np.float64)
    if case.edge == 0:
        rim = np.where(short | ~exact.hit, error * np.maximum(exact.scale, error) / exact.central**2, 0).astype(
            np.float64
        )
    else:
        length = np.maximum(exact.scale / exact.central, _SHORTEST)
        rim = np.where(short | ~exact.hit, error / exact.central / length ** (2 * case.edge - 1), 0).astype(np.float64)
    at = np.unravel_index(np.argmax(share), share.shape)
    where = float((exact.scale / exact.central)[at])
    return Errors(float(share.max()), float(rim.max()), 0.0, "", where, int(exact.hit.sum()), wide, 1)


def colour_errors(case: Case, backend: str, exact: Integrals) -> Errors:
    """Worst error of a colour network of one primitive over the size of its numbers, on solid and on thin chords.

    Colour is what a pixel has over what it has of colour 1, so that the opacity's own error does not count, nor that of
    1 - T.
    """
    plain = case.tensors | {"Wout": 0 * case.tensors["Wout"], "base": torch.ones_like(case.tensors["base"])}
    settings, images = replace(case.settings, **by(backend)), []
    for t in (case.tensors, plain):  # by the kernels that gradients need anyway
        leaf = t | {"base": t["base"].clone().requires_grad_()}
        images.append(render_lowered(scenes.lowered(leaf), case.camera, settings))
    found, opacity = (image.rgb.detach().double().numpy() for image in images)
    seen = exact.hit & (opacity[..., 0] > 1e-30)
    colour, size = long_colours(case.tensors, 0, exact)
    found = found / np.where(seen[..., None], opacity, 1)
    error = np.where(seen[..., None], np.abs(found - colour) / size, 0).max(-1).astype(np.float64)
    error = np.where(np.isfinite(error), error, np.inf)
    short = exact.scale < SOLID * exact.central
    solid, thin = np.where(short, 0, error), np.where(short, error, 0)
    at = np.unravel_index(np.argmax(solid), solid.shape)
    where = float(exact.scale[at] / exact.central[at])
    wide = int(images[0].stats.extra.get("float64", 0))
    return Errors(float(solid.max()), float(thin.max()), 0.0, "", where, int(seen.sum()), wide, 1)


def gradients(case: Case, backend: str, seed: int, keep: Tensor | None = None) -> list[dict[str, Tensor]]:
    """Gradients of a few random functionals of rgb and alpha."""
    g = torch.Generator().manual_seed(seed)
    h, w, C = case.camera.height, case.camera.width, scenes.channels(case.tensors)
    keep = torch.ones(h, w, 1, dtype=torch.float64) if keep is None else keep
    leaves = {k: v.detach().clone().requires_grad_() for k, v in case.tensors.items()}
    lowered, settings = scenes.lowered(leaves), replace(case.settings, **by(backend))
    out = render_lowered(lowered, case.camera, settings)
    grads = []
    for number in range(FUNCTIONALS):
        if number and backend not in KEEPING:
            out = render_lowered(lowered, case.camera, settings)
        rgb, alpha = ((torch.randn(h, w, n, generator=g, dtype=torch.float64) * keep).to(out.rgb.dtype) for n in (C, 1))
        found = torch.autograd.grad(
            (out.rgb, out.alpha), list(leaves.values()), (rgb, alpha[..., 0]), retain_graph=True, allow_unused=True
        )
        grads.append(
            {k: torch.zeros_like(v) if x is None else x for (k, v), x in zip(leaves.items(), found, strict=True)}
        )
    return grads


def gradient_errors(case: Case, backend: str, seed: int = 0, skip: Tensor | None = None) -> tuple[float, str]:
    """Worst over parameters and primitives of |error|/|row|, against the float64 reference.

    Both norms run over several random functionals, because the gradient of a single number may cancel by chance.
    """
    keep = torch.ones(case.camera.height, case.camera.width, 1, dtype=torch.float64)
    if skip is not None:
        keep[skip] = 0
    exact = gradients(case.cast("float64"), "reference", seed, keep)
    found = gradients(case, backend, seed, keep)
    worst, name = 0.0, ""
    for key in case.tensors:
        n = case.tensors[key].shape[0]
        a, b = (
            torch.stack([g[key].double().reshape(n, -1) for g in grads], 1).reshape(n, -1) for grads in (found, exact)
        )
        error, norm = (a - b).norm(dim=1), b.norm(dim=1)
        share = torch.where(error == 0, torch.zeros_like(error), error / norm.clamp_min(1e-300))
        share = torch.where(torch.isfinite(a).all(1), share, torch.full_like(share, float("inf")))
        if share.numel() and float(share.max()) > worst:
            worst, name = float(share.max()), key
    return worst, name


def frame_errors(case: Case, backend: str) -> tuple[Errors, Tensor]:
    """Worst difference of the images of several primitives from the float64 reference's, and the pixels left out.

    Left out are those on which float32 and float64 may rightly fall on different sides of a cut.
    """
    exact = case.cast("float64")
    with torch.no_grad():
        images = [
            render_lowered(scenes.lowered(c.tensors), c.camera, replace(c.settings, **by(name)))
            for c, name in ((case, backend), (exact, "reference"))
        ]
    skip = undecided(exact.tensors, exact.camera, exact.settings)
    difference = torch.maximum(
        (images[0].rgb.double() - images[1].rgb).abs().amax(-1), (images[0].alpha.double() - images[1].alpha).abs()
    )
    difference = torch.where(torch.isfinite(difference), difference, torch.full_like(difference, float("inf")))
    kept = torch.where(skip, torch.zeros_like(difference), difference)
    hits = int((images[1].alpha > 0).sum())
    return Errors(
        float(kept.max()),
        hits=hits,
        wide=int(images[0].stats.extra.get("float64", 0)),
        primitives=len(case.tensors["means"]),
    ), skip


def compare(
    case: Case, backend: str, precision: str, whole: bool, gradients: bool, exact: Integrals | None = None
) -> Errors:
    """Everything about one case on one backend; ``exact`` are its :func:`integrals`, if they are there already."""
    exact = None if whole else exact or integrals(case)
    with scenes.soft(case.edge):
        return _compare(case.cast(precision).for_backend(backend), backend, whole, gradients, exact)


def integrals(case: Case) -> Integrals:
    """What a case of one primitive is compared with; the same for every backend and precision."""
    return long_integrals(case.tensors, 0, case.camera, case.settings.near, case.edge)


def _compare(case: Case, backend: str, whole: bool, gradients: bool, exact: Integrals | None) -> Errors:
    skip: Tensor | None = None
    if exact is None:
        errors, skip = frame_errors(case, backend)
    else:
        errors = (colour_errors if "Wx" in case.tensors else integral_errors)(case, backend, exact)
        if case.edge == 0:  # a soft edge's gradients vanish there as D^(p - 1/2)
            skip = torch.from_numpy((np.abs(exact.D) < RIM).astype(np.bool_))
    if gradients:
        errors.gradient, errors.parameter = gradient_errors(case, backend, skip=skip)
    return errors

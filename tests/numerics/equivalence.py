"""The equivalence harness: :func:`same` draws one case with two backends and bounds the difference of their results.

A case (``tests/numerics/cases.py``) fixes the forms of density and colour, the edge, the order and the view. Compared
are images, gradients of a fixed random functional of them, and the contributions that population control counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.fields import CustomColour
from neuprim.core.render import RenderOutput, RenderSettings, render_lowered
from neuprim.core.render.backends import REFERENCE
from neuprim.core.render.output import Contributions
from neuprim.core.render.reference import pixel_ray_directions
from tests import scenes
from tests.backends import by
from tests.numerics.cases import Case


@dataclass
class Frame:
    """A backend's images and its gradients of one fixed random functional of them."""

    output: RenderOutput
    grads: dict[str, Tensor]
    tally: Contributions


def weights(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def undecided(t: dict[str, Tensor], camera: Camera, settings: RenderSettings) -> Tensor:
    """(H, W) pixels on which float32 and float64 may rightly fall on different sides of a cut.

    Those whose reference image jumps when alpha_min or transmittance_min moves by 1e-5 (of itself, for the latter
    1e-3). Where the order is that of entries, also those with :func:`near_ties`; where colours are networks, those with
    :func:`near_black`.
    """
    wide = scenes.lowered({k: v.detach().double() for k, v in t.items()})
    images = []
    with torch.no_grad():
        for sign in (-1.0, 1.0):
            low, stop = settings.alpha_min, settings.transmittance_min
            moved = replace(
                settings,
                backend="reference",
                depth=False,
                alpha_min=max(low + sign * 1e-5, 0.0),
                transmittance_min=stop * (1 + sign * 1e-3),
            )
            images.append(render_lowered(wide, camera, moved).alpha)
    jumps = images[0] != images[1]
    if "Wx" in t:
        jumps |= near_black(t, camera, settings)
    return jumps | near_ties(t, camera, settings.near) if settings.sort == "entry" else jumps


def near_black(t: dict[str, Tensor], camera: Camera, settings: RenderSettings, gap: float = 4e-6) -> Tensor:
    """(H, W) pixels with a colour within ``gap`` of where max(0, .) clamps it: float32 may pass its gradient where
    float64 does not."""
    w = {k: v.detach().double() for k, v in t.items()}
    low = scenes.lowered(w)
    m = low.geometry.length_scale

    def close(prim: Tensor, x: Tensor, d: Tensor) -> Tensor:
        local = (x - w["means"][prim]) / m[prim, None]
        waves = ((w["Wx"][prim] * local[:, None, :]).sum(-1) + w["bias"][prim]).cos()
        value = w["base"][prim] + (w["Wout"][prim] * waves[:, None, :]).sum(-1)
        size = w["base"][prim].abs() + w["Wout"][prim].abs().sum(-1)
        return ((value.abs() < gap * size) & (size > 0)).any(1, keepdim=True).double()

    with torch.no_grad():
        found = render_lowered(
            replace(low, colour=CustomColour(close, 1)), camera, replace(settings, backend="reference", depth=False)
        )
    return found.rgb[..., 0] > 0


def entries(t: dict[str, Tensor], camera: Camera, near: float) -> Tensor:
    """(N, H, W) camera-z at which each pixel's ray enters each ellipsoid, float64: ``near`` where that plane cuts it,
    inf if missed."""
    g = scenes.lowered({k: v.detach().double() for k, v in t.items()}).geometry
    d = pixel_ray_directions(camera)
    world = d @ camera.viewmat.detach().double()[:3, :3]
    to_sphere = g.rotations / g.scales[:, None, :]
    p = ((camera.position.detach().double() - g.means)[:, None] @ to_sphere)[:, 0]
    result = []
    for row in range(g.count):
        v = world @ to_sphere[row]
        a, b, c = (v * v).sum(-1), v @ p[row], p[row] @ p[row] - 1
        root = (b * b - a * c).clamp_min(0).sqrt()
        missed = (b * b - a * c <= 0) | ((root - b) / a * d[..., 2] <= near)
        result.append(((-b - root) / a * d[..., 2]).clamp_min(near).masked_fill(missed, torch.inf))
    return torch.stack(result)


def near_ties(t: dict[str, Tensor], camera: Camera, near: float, gap: float = 2e-6) -> Tensor:
    """(H, W) pixels with two entries closer than ``gap`` of their camera-z: float32 may order them the other way.

    That changes a pixel by the opacities' product times the colours' difference. Entries on the near plane are ties,
    not near ties.
    """
    z = entries(t, camera, near).sort(0).values
    front, back = z[:-1], z[1:]
    return ((back - front < gap * front) & (back > near) & (back < torch.inf)).any(0)


def draw(
    backend: str,
    t: dict[str, Tensor],
    camera: Camera,
    settings: RenderSettings,
    skip: Tensor | None = None,
    with_view: bool = True,
) -> Frame:
    """Images and gradients; the reference gets the same numbers in float64. ``skip`` pixels carry no gradient."""
    dtype = torch.float64 if backend == "reference" else torch.float32
    leaves = {k: v.detach().to(dtype).requires_grad_() for k, v in t.items()}
    view = camera.viewmat.detach().clone().requires_grad_(with_view)
    background = torch.linspace(0.2, 0.9, scenes.channels(t)).to(dtype).requires_grad_()
    output = render_lowered(
        scenes.lowered(leaves), replace(camera, viewmat=view), replace(settings, **by(backend)), background
    )
    h, w, C = output.rgb.shape
    keep = torch.ones(h, w, dtype=torch.float64) if skip is None else (~skip).double()
    tally = output.request_contributions((weights((h, w), 3).abs() * keep).float())
    total = (output.rgb * (weights((h, w, C), 0) * keep[..., None]).to(dtype)).sum() + (
        output.alpha * (weights((h, w), 1) * keep).to(dtype)
    ).sum()
    if output.depth is not None:
        # a depth is a quotient by alpha: near alpha_min its derivative is large and has few digits
        solid = (output.alpha.detach() > 0.1).double() * keep
        total = total + 0.1 * (output.depth * (weights((h, w), 2) * solid).to(dtype)).sum()
    total.backward()
    grads = {k: v.grad if v.grad is not None else torch.zeros_like(v) for k, v in leaves.items()}
    grads["background"] = background.grad if background.grad is not None else torch.zeros_like(background)
    if with_view and view.grad is not None:
        grads["viewmat"] = view.grad
    return Frame(output, {k: v.detach() for k, v in grads.items()}, tally)


def row_errors(found: Tensor, expected: Tensor) -> Tensor:
    """(N,) norm of each row's error over the row's own norm plus a thousandth of the mean row."""
    if expected.numel() == 0:
        return torch.zeros(1)
    a, b = found.double().reshape(found.shape[0], -1), expected.double().reshape(expected.shape[0], -1)
    norm = b.norm(dim=1)
    scale = norm + 1e-3 * norm.mean()
    return (a - b).norm(dim=1) / scale.clamp_min(1e-30)


@lru_cache(maxsize=64)  # what backends that draw the same case one after the other share
def _judged(reference: str, case: Case) -> tuple[Tensor, Frame]:
    skip = undecided(case.tensors, case.camera, case.settings)
    return skip, draw(reference, case.tensors, case.camera, case.settings, skip)


def same(
    fast: str, reference: str, case: Case, image_bound: float = 1e-5, grad_bound: float = 1e-3
) -> tuple[Frame, Frame]:
    """Draw a case with two backends and compare; return both frames.

    Images differ by at most ``image_bound``, gradients by ``grad_bound`` of each row's norm. Left out are pixels on
    which float32 and float64 may rightly decide differently (:func:`undecided`), under 5 % of the image.
    """
    with scenes.soft(case.edge):
        return _same(fast, reference, case, image_bound, grad_bound)


def _same(fast: str, reference: str, case: Case, image_bound: float, grad_bound: float) -> tuple[Frame, Frame]:
    t, camera, settings = case.tensors, case.camera, case.settings
    skip, b = _judged(reference, case)
    assert skip.float().mean() < 0.05, f"{int(skip.sum())} undecided pixels: too many for a comparison"
    a = draw(fast, t, camera, settings, skip)
    keep = ~skip
    report: dict[str, float] = {}
    report["rgb"] = (a.output.rgb.double() - b.output.rgb).abs().amax(-1)[keep].max().item()
    report["alpha"] = (a.output.alpha.double() - b.output.alpha).abs()[keep].max().item()
    if settings.depth:
        assert a.output.depth is not None and b.output.depth is not None
        distance = b.output.depth.abs().max().clamp_min(1e-30)  # the sum of w z is what is drawn
        error = (a.output.depth.double() - b.output.depth).abs() * b.output.alpha / distance
        report["depth"] = error[keep].max().item()
    assert all(v <= image_bound for v in report.values()), report
    found = {k: row_errors(a.grads[k], b.grads[k]).max().item() for k in t}
    for k in ("background", "viewmat"):
        found[k] = ((a.grads[k].double() - b.grads[k]).norm() / b.grads[k].norm().clamp_min(1e-12)).item()
    assert all(v <= grad_bound for v in found.values()), found
    return a, b


def assert_same_frame(
    t: dict[str, Tensor],
    camera: Camera,
    settings: RenderSettings,
    image_bound: float = 1e-5,
    grad_bound: float = 1e-3,
    backend: str = "cpu",
) -> tuple[Frame, Frame]:
    """:func:`same` of given tensors, against the reference."""
    return _same(backend, REFERENCE, Case(t, camera, settings), image_bound, grad_bound)


def same_contributions(fast: Frame, slow: Frame, skipped: float) -> None:
    """Compare the contributions of primitives, summed over all pixels; ``skipped`` bounds pairs at the cuts."""
    a, b = fast.tally, slow.tally
    assert (a.weight - b.weight).abs().max() <= 2e-5 * b.weight.max() + skipped
    assert (a.error_weight - b.error_weight).abs().max() <= 2e-5 * b.error_weight.max() + 1e-4
    assert torch.equal(a.weight > 0.05, b.weight > 0.05)
    assert a.weight[b.weight == 0].abs().sum() <= skipped


def assert_same_bits(first: Frame, second: Frame) -> None:
    """Check that images, gradients and contributions are equal to the bit."""
    for image in ("rgb", "alpha", "depth"):
        a, b = getattr(first.output, image), getattr(second.output, image)
        assert (a is None) == (b is None) and (a is None or torch.equal(a, b)), image
    for name, grad in first.grads.items():
        assert torch.equal(grad, second.grads[name]), name
    for sums in ("weight", "error_weight"):
        assert torch.equal(getattr(first.tally, sums), getattr(second.tally, sums)), sums

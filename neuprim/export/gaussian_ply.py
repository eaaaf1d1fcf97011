"""Export format ``gaussian-ply``: one Gaussian per primitive in the PLY layout of 3D Gaussian splatting (3DGS); lossy.

The vertices are binary, little-endian, and consist of floats:

* ``x y z``: centre in the coordinates of the run's data; ``double`` where float32 would lose more than 1e-4 of the
  scene's size, as in UTM coordinates
* ``nx ny nz``: 0
* ``f_dc_0..2 f_rest_0..44``: SH coefficients of degree 3; ``f_rest`` has 15 for red, then 15 for green, 15 for blue
* ``opacity``: logit of the opacity
* ``scale_0..2``: natural logarithm of the standard deviations
* ``rot_0..3``: quaternion wxyz

:func:`fit_gaussians` fits the Gaussians. Colours stay in the model's colour space, but viewers show them as sRGB. A
grey model is written as three equal channels. Models with channels other than red, green and blue are refused. If a
model depends on time or light, one file holds one time and light (``--time 0.5``, ``--light 1,2,3 --light-intensity
10,10,10``), and several frames become several files. Colours that are no spherical harmonics are approximated by
spherical harmonics.

The reported error is a PSNR: images of the Gaussians, drawn as the 3DGS rasteriser does, against the model's images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.world import World
from neuprim.core.data import View
from neuprim.core.data.points_file import LINEAR
from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport, TrainedModel
from neuprim.core.io.ply import write_ply
from neuprim.core.metrics import psnr
from neuprim.core.model.fields import Conditions
from neuprim.core.model.geometry import Geometry
from neuprim.core.render import render
from neuprim.core.task import API_VERSION
from neuprim.export.shared import ExportHarmonics, choose_export_views, find_export_rgb_channels, fit_export_harmonics

SIZES = ("moments", "footprint", "profile")
"""Methods to choose the size of a Gaussian; :func:`fit_gaussians` describes them."""
_SIDE = 12  # points of the quadrature along an axis of the unit ball
_CHUNK = 512
_FACTORS = [1.06**i for i in range(-24, 25)]  # on the covariance, in steps of three percent in size
# Of the authors' rasteriser:
_NEAR, _BLUR, _ALPHA_MAX, _ALPHA_MIN, _TRANSMITTANCE_MIN = 0.2, 0.3, 0.99, 1.0 / 255.0, 1e-4

OPTIONS = {
    "size": (
        "auto",
        "profile: the bell closest to the primitive's opacity; footprint: as much screen as it covers; moments: "
        "covariance of the density; "
        "auto: the best",
    ),
    "views": ("auto", "cameras of the PSNR: test, orbit, or auto (test for models without conditions)"),
}

LAYOUT = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)

_MAX_ROUNDING = 1e-4  # of centres in float32, as a share of the size of their cloud


@dataclass(frozen=True)
class ExportedGaussians:
    """Gaussians that stand for a model under some conditions, in scene coordinates.

    Attributes:
        errors: PSNR of the Gaussians against the model: "psnr", the mean over views, and "psnr_worst".
        notes: lines for the user, the same for all formats.
        measure: function that returns such errors for other Gaussians and colours, e.g. rounded ones.
    """

    gaussians: Gaussians
    colours: ExportHarmonics
    errors: dict[str, float]
    notes: tuple[str, ...]
    measure: Callable[[Gaussians, ExportHarmonics], dict[str, float]]

    def placed(self, world: World) -> tuple[np.ndarray, ...]:
        """Return the Gaussians in the coordinates that ``world`` maps the scene to, as float64 arrays.

        The arrays are centres (M, 3), standard deviations (M, 3), quaternions wxyz (M, 4), opacities (M,) and SH
        coefficients of degrees 0 to 3 (M, 16, 3).
        """
        gaussians, colours = self.gaussians.to_scene(world), self.colours.rotate(world.rotation)
        harmonics = torch.cat([colours.dc[:, None], colours.rest], 1)[gaussians.rows]
        return gaussians.means.numpy(), *gaussians.axes(), gaussians.opacities.numpy(), harmonics.numpy()


def fit_exported_gaussians(job: ExportJob) -> ExportedGaussians:
    """Fit Gaussians to a model by the method of the option ``size``; raise ConfigError if nothing absorbs light."""
    size, which = job.choice("size", "auto", *SIZES), job.choice("views", "auto", "test", "orbit")
    (conditions,) = job.frames()
    channels, rgb = job.run.channels, find_export_rgb_channels(job.run)
    job.progress("fitting Gaussians", 0.0)
    fits = {name: fit_gaussians(job.run, conditions, name) for name in SIZES if size in ("auto", name)}
    if not all(len(g.means) for g in fits.values()):
        reason = "no primitive absorbs anything under these conditions; nothing to export"
        raise ConfigError(f"{job.run.directory}: {reason}")
    colours = fit_export_harmonics(job.run, conditions).select_channels(rgb)
    images, seen = _draw_export_images(job, which, conditions, rgb)
    background = _export_background(job)[list(rgb)]

    def measure(gaussians: Gaussians, colours: ExportHarmonics) -> dict[str, float]:
        scores = _measure_gaussian_psnrs(job, gaussians, colours, images, background)
        return {"psnr": float(np.mean(scores)), "psnr_worst": float(np.min(scores))}

    errors = {name: measure(fit, colours) for name, fit in fits.items()}
    size = max(errors, key=lambda name: errors[name]["psnr"])
    gaussians = fits[size]
    notes = [
        f"{len(gaussians.means)} Gaussians, size={size}; PSNR of them drawn as the 3DGS rasteriser does, against "
        f"the model's images, {seen}, {channels.color_space} values",
    ]
    if colours.residual > 0:
        notes.append(
            "the model's colours are no harmonics of the view; fitted at the centres with an RMS error of "
            f"{colours.residual:.2g}"
        )
    if channels.own is not None:
        notes.append(
            f"red, green and blue are the channels {channels.name_list}, not what the display of task "
            f"{job.run.task.name!r} shows"
        )
    elif channels.display_text:
        notes.append(f"colours: {channels.display_text}")
    return ExportedGaussians(gaussians, colours, errors[size], tuple(notes), measure)


def _write_gaussian_ply(job: ExportJob) -> ExportReport:
    fitted, space = fit_exported_gaussians(job), job.run.channels.color_space
    rows = _gaussian_ply_rows(fitted, job.run.world)
    comments = ["3D Gaussian splatting layout, fitted to neural primitives by neuprim (lossy)"]
    comments += ["SplatRenderMode: default", *[LINEAR] * (space == "linear")]  # read by Brush and others
    write_ply(job.out, rows, comments)
    notes = [*fitted.notes, "axes and units are those of the run's data; degree 3 harmonics"]
    if rows.dtype["x"] == np.float64:
        kept = float(np.spacing(np.abs(np.stack([rows[axis] for axis in "xyz"])).max().astype(np.float32)))
        notes.append(
            "x y z are double: the coordinates are so large that a program which takes them for float rounds "
            f"them to {kept:.2g}"
        )
    if space == "linear":
        notes.append("colours are linear, viewers take them for sRGB: they look darker there")
    return ExportReport((job.out,), False, fitted.errors, tuple(notes))


def _gaussian_ply_rows(fitted: ExportedGaussians, world: World) -> np.ndarray:
    """Return Gaussians as PLY vertices in the run's data coordinates. Centres are double if float32 is too coarse."""
    means, scales, quats, opacity, harmonics = fitted.placed(world.inverse)
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(-1, 45)
    logit = np.log(opacity) - np.log1p(-opacity)
    zero = np.zeros((len(opacity), 3))
    table = np.concatenate([means, zero, harmonics[:, 0], rest, logit[:, None], np.log(scales), quats], axis=1)
    lost = np.abs(table[:, :3].astype(np.float32) - table[:, :3]).max()
    place = "<f8" if lost > _MAX_ROUNDING * np.ptp(table[:, :3], axis=0).max() else "<f4"
    rows = np.empty(len(table), [(name, place if name in ("x", "y", "z") else "<f4") for name in LAYOUT])
    for i, name in enumerate(LAYOUT):
        rows[name] = table[:, i]
    return rows


def _draw_export_images(
    job: ExportJob, which: str, conditions: Conditions, rgb: Sequence[int]
) -> tuple[list[tuple[View, Tensor]], str]:
    """Render the model for the PSNR. Return pairs (view, (H, W, 3) image), and a text that describes the views."""
    run = job.run
    views, what = choose_export_views(job, which, conditions)
    background, images = _export_background(job), []
    for i, view in enumerate(views):
        job.progress("drawing the model", i / len(views))
        with torch.no_grad():
            image = render(run.model, view.camera, view.conditions, run.settings, background).rgb
        images.append((view, image[..., list(rgb)]))
    return images, what


def _measure_gaussian_psnrs(
    job: ExportJob,
    gaussians: Gaussians,
    colours: ExportHarmonics,
    images: list[tuple[View, Tensor]],
    background: Tensor,
) -> list[float]:
    found = []
    for i, (view, truth) in enumerate(images):
        job.progress("drawing the Gaussians", i / len(images))
        found.append(psnr(draw_exported_gaussians(gaussians, colours, view.camera, background), truth))
    return found


def _export_background(job: ExportJob) -> Tensor:
    return torch.tensor([float(x) for x in job.run.header.get("background", [0.0] * job.run.model.colour.channels)])


# ---------------------------------------------------------------- fitting and drawing Gaussians


@dataclass(frozen=True)
class Gaussians:
    """M 3D Gaussians, fitted to primitives; float64.

    Attributes:
        means: (M, 3), scene units.
        covariances: (M, 3, 3), squared scene units.
        opacities: (M,) alpha at the centre of the projected Gaussian, 0..1.
        rows: (M,) for each Gaussian, the index of its primitive among the active primitives.
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    rows: Tensor

    def to_scene(self, world: World) -> Gaussians:
        """Return these Gaussians, given in world coordinates, in scene coordinates; ``world`` holds the transform."""
        if world.identity:
            return self
        linear = world.scene_from_world[:3, :3]
        return replace(self, means=world.scene_points(self.means), covariances=linear @ self.covariances @ linear.T)

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (M, 3) standard deviations along the principal axes, and (M, 4) quaternions wxyz of these axes."""
        values, vectors = np.linalg.eigh(self.covariances.numpy())
        vectors[np.linalg.det(vectors) < 0, :, 0] *= -1
        quats = Rotation.from_matrix(vectors).as_quat()[:, [3, 0, 1, 2]] if len(values) else np.zeros((0, 4))
        return np.sqrt(np.maximum(values, 1e-30)), quats


def fit_gaussians(run: TrainedModel, conditions: Conditions, size: str) -> Gaussians:
    """Fit one Gaussian to each primitive that absorbs light under the given conditions.

    ``size`` chooses the method:

    * "moments": The Gaussian has the mean and the covariance of rho = max(0, sigma), by quadrature in the ellipsoid.
      Its opacity is 1 - exp(-tau), averaged over the three axes of the ellipsoid. tau is the integral of rho along a
      line through the mean, parallel to the axis.
    * "footprint": As "moments", but the covariance is scaled. The Gaussian's projected alpha is opacity x exp(-d^2/2)
      at d standard deviations. On average over views along the three axes, the integral of this alpha over the image
      equals the integral of the primitive's alpha.
    * "profile": The scale of the covariance and the opacity minimise the squared difference of the two alphas over the
      images along the three axes. For each scale, the opacity preserves the integral of alpha, but is at most 0.99.

    The scale matters because the alpha of an opaque primitive is flat with an edge, unlike a Gaussian.
    """
    model = run.model
    with torch.no_grad():
        active = model.active(conditions)
        own, still, moved = active.own, active.stored, active.geometry
        parts = []
        for i in range(0, still.count, _CHUNK):
            part = slice(i, i + _CHUNK)
            params = {name: value[part] for name, value in own.items()}
            parts.append(_fit_gaussian_chunk(model.density.density, params, still[part], moved[part], conditions, size))
    empty = (torch.zeros(0, 3), torch.zeros(0, 3, 3), torch.zeros(0), torch.zeros(0, dtype=torch.bool))
    means, covariances, opacities, kept = (torch.cat(column) for column in zip(empty, *parts, strict=True))
    found = kept.nonzero()[:, 0]
    return Gaussians(means[found].double(), covariances[found].double(), opacities[found].double(), found)


def _fit_gaussian_chunk(
    density: Any, own: Any, still: Geometry, moved: Geometry, conditions: Conditions, size: str
) -> tuple[Tensor, ...]:
    """Fit Gaussians to n primitives: return means, covariances, opacities, and whether each primitive absorbs light."""
    n, step = still.count, 2.0 / _SIDE
    ticks = (torch.arange(_SIDE, dtype=torch.float64) + 0.5) * step - 1
    ball = torch.cartesian_prod(ticks, ticks, ticks)
    inside = ball.square().sum(-1) < 1
    scales, R = moved.scales.double(), moved.rotations.double()
    points = moved.means.double()[:, None] + torch.einsum("nij,pj->npi", R * scales[:, None, :], ball[inside])
    prim = torch.arange(n).repeat_interleave(int(inside.sum()))
    rho = torch.zeros(n, len(ball), dtype=torch.float64)
    sigma = density(own, still, prim, points.reshape(-1, 3).float(), conditions).double()
    rho[:, inside] = sigma.reshape(n, -1).clamp_min(0)
    total = rho.sum(1)
    kept = total * step**3 * scales.amin(1) > 1e-9  # an optical depth that no image shows
    weight = rho / total.clamp_min(1e-300)[:, None]
    mean = weight @ ball
    spread = torch.einsum("np,npi,npj->nij", weight, ball - mean[:, None], ball - mean[:, None])
    cube = rho.reshape(n, _SIDE, _SIDE, _SIDE)
    middle = ((mean + 1) / step).floor().long().clamp(0, _SIDE - 1)
    every = torch.arange(n)
    alphas, areas, bells, screens = [], [], [], []
    for axis in range(3):
        alpha = -torch.expm1(-cube.sum(axis + 1) * step * scales[:, axis, None, None])
        u, v = (a for a in range(3) if a != axis)
        flat = spread[:, [u, u, v, v], [u, v, u, v]].reshape(n, 2, 2)
        alphas.append(alpha[every, middle[:, u], middle[:, v]])
        areas.append(alpha.sum((1, 2)) * step * step)
        bells.append(2 * torch.pi * torch.linalg.det(flat).clamp_min(1e-12).sqrt())
        screens.append((alpha, flat, mean[:, [u, v]], scales[:, u] * scales[:, v]))
    opacity = torch.stack(alphas).mean(0).clamp(1e-6, 1 - 1e-6)
    if size == "footprint":
        spread = spread * (torch.stack(areas) / (opacity * torch.stack(bells))).mean(0)[:, None, None]
    elif size == "profile":
        wider, opacity = _fit_gaussian_ply_profile(screens, torch.stack(areas), torch.stack(bells), ticks)
        spread = spread * wider[:, None, None]
    world = R * scales[:, None, :]
    means = moved.means.double() + (world @ mean[:, :, None])[..., 0]
    return means, world @ spread @ world.transpose(1, 2), opacity, kept


def _fit_gaussian_ply_profile(
    screens: Sequence[tuple[Tensor, ...]], areas: Tensor, bells: Tensor, ticks: Tensor
) -> tuple[Tensor, Tensor]:
    """Fit size="profile" of :func:`fit_gaussians`: return (n,) factors on the covariance, and (n,) opacities.

    The fit tries a list of factors. For each, the opacity preserves the integral of alpha, but is at most 0.99. The
    factor with the smallest squared error wins. The error includes the Gaussian's part outside of the image.

    Args:
        screens: for each of three axes, the image of n primitives, projected along the axis: (n, S, S) alpha; (n, 2, 2)
            covariance and (n, 2) mean of the Gaussian; (n,) weight of the image, the product of its two semi-axes.
        areas: (3, n) integrals of alpha over the images.
        bells: (3, n) integrals of the unscaled Gaussian with opacity 1 over the image plane.
        ticks: (S,) coordinates of the pixel centres, from -1 to 1 (semi-axes of the ellipsoid).
    """
    step = ticks[1] - ticks[0]
    weights = torch.stack([screen[3] for screen in screens])
    u, v = torch.meshgrid(ticks, ticks, indexing="ij")
    away = []
    for _, flat, mean, _ in screens:
        d = torch.stack([u - mean[:, 0, None, None], v - mean[:, 1, None, None]], -1)
        inverse = torch.linalg.inv(flat + 1e-12 * torch.eye(2, dtype=torch.float64))
        away.append(torch.einsum("nuvi,nij,nuvj->nuv", d, inverse, d))
    best: tuple[Tensor, ...] = ()
    for factor in _FACTORS:
        opacity = ((weights * areas).sum(0) / (weights * bells * factor).sum(0)).clamp(1e-6, _ALPHA_MAX)
        error = torch.zeros_like(opacity)
        for weight, bell, square, (alpha, *_) in zip(weights, bells, away, screens, strict=True):
            common = (alpha * (-0.5 / factor * square).exp()).sum((1, 2)) * step * step
            error = error + weight * (opacity.square() * bell * factor / 2 - 2 * opacity * common)
        new = (error, torch.full_like(error, factor), opacity)
        best = tuple(torch.where(error < best[0], x, y) for x, y in zip(new, best, strict=True)) if best else new
    return best[1], best[2]


def draw_exported_gaussians(
    gaussians: Gaussians, colours: ExportHarmonics, camera: Camera, background: Tensor
) -> Tensor:
    """Draw Gaussians as the 3DGS rasteriser does, but in float64; return a (H, W, 3) float32 image.

    Gaussians are projected by a local affine approximation (EWA) and blurred by 0.3 square pixels. In a pixel, d
    standard deviations from the centre, alpha is min(0.99, opacity exp(-d^2/2)); Gaussians with alpha below 1/255 are
    skipped. Compositing is front to back by the depth of centres, and stops before the transmittance falls below 1e-4.
    Gaussians with a depth below 0.2 are left out. 3DGS draws a Gaussian only in the tiles within three standard
    deviations; this function limits its extent only by alpha.
    """
    view = camera.viewmat.double()
    W, t = view[:3, :3], gaussians.means @ view[:3, :3].T + view[:3, 3]
    order = torch.argsort(t[:, 2], stable=True)
    order = order[t[order, 2] > _NEAR]
    t, cov = t[order], gaussians.covariances[order]
    z = t[:, 2]
    limits = 1.3 * 0.5 * camera.width / camera.fx, 1.3 * 0.5 * camera.height / camera.fy
    x, y = ((t[:, a] / z).clamp(-limits[a], limits[a]) * z for a in (0, 1))
    J = torch.zeros(len(t), 2, 3, dtype=torch.float64)
    J[:, 0, 0], J[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    J[:, 1, 1], J[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    flat = J @ W @ cov @ W.T @ J.transpose(1, 2) + _BLUR * torch.eye(2, dtype=torch.float64)
    centers = torch.stack([camera.fx * t[:, 0] / z + camera.cx, camera.fy * t[:, 1] / z + camera.cy], -1)
    away = gaussians.means[order] - camera.position.double()
    colors = colours.evaluate(gaussians.rows[order], away / away.norm(dim=-1, keepdim=True)).numpy()
    inverse, opacity = torch.linalg.inv(flat).numpy(), gaussians.opacities[order].numpy()
    deviations = flat.diagonal(dim1=1, dim2=2).sqrt().numpy()
    reach = np.sqrt(2 * np.log(np.maximum(opacity / _ALPHA_MIN, 1.0)))[:, None] * deviations
    middle = centers.numpy()
    first = np.clip(np.floor(middle - reach), 0, [camera.width, camera.height]).astype(int)
    last = np.clip(np.ceil(middle + reach), 0, [camera.width, camera.height]).astype(int)
    image, left = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    for i in np.flatnonzero((last > first).all(1) & (opacity >= _ALPHA_MIN)):
        (x0, y0), (x1, y1) = first[i], last[i]
        dx, dy = np.arange(x0, x1) + 0.5 - middle[i, 0], (np.arange(y0, y1) + 0.5 - middle[i, 1])[:, None]
        power = -0.5 * (inverse[i, 0, 0] * dx * dx + inverse[i, 1, 1] * dy * dy) - inverse[i, 0, 1] * dx * dy
        alpha = np.minimum(_ALPHA_MAX, opacity[i] * np.exp(power))
        here = left[y0:y1, x0:x1]
        after = here * (1 - alpha)
        drawn = (alpha >= _ALPHA_MIN) & (here > 0)
        ends = drawn & (after < _TRANSMITTANCE_MIN)
        drawn &= ~ends
        image[y0:y1, x0:x1] += np.where(drawn, here * alpha, 0.0)[..., None] * colors[i]
        here[drawn] = after[drawn]
        here[ends] = -here[ends]  # finished: the sign marks it, the magnitude still lets the background through
    picture: Tensor = torch.from_numpy(image + np.abs(left)[..., None] * background.double().numpy()).float()
    return picture


EXPORTER = Exporter(
    API_VERSION,
    "gaussian-ply",
    "one fitted Gaussian per primitive, in the layout of 3D Gaussian splatting; lossy",
    _write_gaussian_ply,
    OPTIONS,
    conditions=True,
    sequence=True,
    default="gaussians.ply",
    suffixes=(".ply",),
)

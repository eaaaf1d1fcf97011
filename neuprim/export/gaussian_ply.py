"""``gaussian-ply``: one Gaussian per primitive in the layout of 3D Gaussian splatting, for its viewers; lossy.

Binary little-endian vertices of floats ``x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3``: centre in
the coordinates of the run's data (``double x y z`` where float32 would lose more than 1e-4 of the scene's size, as in
UTM), normals 0, SH coefficients of degree 3 (``f_rest`` channel by channel: 15 of red, 15 of green, 15 of blue), logit
of the opacity,
natural logarithm of the standard deviations, quaternion wxyz. How the Gaussians are fitted:
:mod:`neuprim.export.gaussians`.
Colours are those of the model in its own colour space; viewers show numbers as sRGB. A grey model is written as three
equal channels; other channels than red, green and blue are refused. A model that depends on time or light is written
under one value of each (``time=0.5``, ``light=1,2,3 light_intensity=10,10,10``); colours that are no harmonics are
fitted by harmonics.

The error is the PSNR of images of the fitted Gaussians, drawn as the 3DGS rasteriser draws them, against the model's
own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.data import View
from neuprim.core.data.points_file import LINEAR
from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport
from neuprim.core.io.ply import write_ply
from neuprim.core.metrics import psnr
from neuprim.core.model.fields import Conditions
from neuprim.core.render import render
from neuprim.core.task import API_VERSION
from neuprim.export.appearance import Harmonics, comparison_views, harmonics_of, rgb_of
from neuprim.export.gaussians import SIZES, Gaussians, draw_gaussians, fit_gaussians

__all__ = ["EXPORTER", "LAYOUT"]

OPTIONS = {
    "size": (
        "auto",
        "profile: the bell closest to the primitive's opacity; footprint: as much screen as it covers; moments: covariance of the density; "
        "auto: the best",
    ),
    "views": ("auto", "cameras of the PSNR: test, orbit, or auto (test for models without conditions)"),
}

LAYOUT = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)

_LOST = 1e-4
"""Of the size of the cloud of centres: what float32 may round them by."""


def _write(job: ExportJob) -> ExportReport:
    size, which = job.choice("size", "auto", *SIZES), job.choice("views", "auto", "test", "orbit")
    (conditions,) = job.frames()
    channels, rgb = job.run.channels, rgb_of(job.run)
    job.progress("fitting Gaussians", 0.0)
    fits = {name: fit_gaussians(job.run, conditions, name) for name in SIZES if size in ("auto", name)}
    if not all(len(g.means) for g in fits.values()):
        raise ConfigError(
            f"{job.run.directory}: no primitive absorbs anything under these conditions; nothing to export"
        )
    colours = harmonics_of(job.run, conditions).picked(rgb)
    images, seen = _images(job, which, conditions, rgb)
    scores = {name: _psnrs(job, fit, colours, images, rgb, name) for name, fit in fits.items()}
    size = max(scores, key=lambda name: float(np.mean(scores[name])))
    gaussians, errors = fits[size], {"psnr": float(np.mean(scores[size])), "psnr_worst": float(np.min(scores[size]))}
    rows = _rows(gaussians, colours, job.run.world)
    space = channels.color_space
    comments = ["3D Gaussian splatting layout, fitted to neural primitives by neuprim (lossy)"] + [LINEAR] * (
        space == "linear"
    )
    write_ply(job.out, rows, comments)
    notes = [
        f"{len(gaussians.means)} Gaussians, size={size}; PSNR of them drawn as the 3DGS rasteriser does, against the model's images, {seen}, {space} values",
        "axes and units are those of the run's data; degree 3 harmonics",
    ]
    if rows.dtype["x"] == np.float64:
        kept = float(np.spacing(np.abs(np.stack([rows[axis] for axis in "xyz"])).max().astype(np.float32)))
        notes.append(
            f"x y z are double: the coordinates are so large that a program which takes them for float rounds them to {kept:.2g}"
        )
    if colours.residual > 0:
        notes.append(
            f"the model's colours are no harmonics of the view; fitted at the centres with an RMS error of {colours.residual:.2g}"
        )
    if channels.own is not None:
        notes.append(
            f"red, green and blue are the channels {channels.listed}, not what the display of task {job.run.task.name!r} shows"
        )
    elif channels.shown:
        notes.append(f"colours: {channels.shown}")
    if space == "linear":
        notes.append("colours are linear, viewers take them for sRGB: they look darker there")
    return ExportReport((job.out,), False, errors, tuple(notes))


def _rows(gaussians: Gaussians, colours: Harmonics, world: World) -> np.ndarray:
    """The vertices, in the world of the user's files; centres in doubles where that world is too far away for
    floats."""
    gaussians, colours = gaussians.within(world.inverse), colours.turned(world.inverse.rotation)
    scales, quats = gaussians.axes()
    opacity = gaussians.opacities.numpy()
    rest = colours.rest[gaussians.rows].transpose(1, 2).reshape(-1, 45).numpy()
    logit = np.log(opacity) - np.log1p(-opacity)
    zero = np.zeros((len(opacity), 3))
    table = np.concatenate(
        [
            gaussians.means.numpy(),
            zero,
            colours.dc[gaussians.rows].numpy(),
            rest,
            logit[:, None],
            np.log(scales),
            quats,
        ],
        axis=1,
    )
    lost = np.abs(table[:, :3].astype(np.float32) - table[:, :3]).max()
    place = "<f8" if lost > _LOST * np.ptp(table[:, :3], axis=0).max() else "<f4"
    rows = np.empty(len(table), [(name, place if name in ("x", "y", "z") else "<f4") for name in LAYOUT])
    for i, name in enumerate(LAYOUT):
        rows[name] = table[:, i]
    return rows


def _images(
    job: ExportJob, which: str, conditions: Conditions, rgb: Sequence[int]
) -> tuple[list[tuple[View, Tensor]], str]:
    """The model's own images, red, green and blue, and what they show."""
    run = job.run
    views, what = comparison_views(job, which, conditions)
    background, images = _background(job), []
    for i, view in enumerate(views):
        job.progress("drawing the model", i / len(views))
        with torch.no_grad():
            images.append(
                (view, render(run.model, view.camera, view.conditions, run.settings, background).rgb[..., list(rgb)])
            )
    return images, what


def _psnrs(
    job: ExportJob,
    gaussians: Gaussians,
    colours: Harmonics,
    images: list[tuple[View, Tensor]],
    rgb: Sequence[int],
    name: str,
) -> list[float]:
    background, found = _background(job)[list(rgb)], []
    for i, (view, truth) in enumerate(images):
        job.progress(f"drawing the Gaussians (size={name})", i / len(images))
        found.append(psnr(draw_gaussians(gaussians, colours, view.camera, background), truth))
    return found


def _background(job: ExportJob) -> Tensor:
    return torch.tensor([float(x) for x in job.run.header.get("background", [0.0] * job.run.model.colour.channels)])


EXPORTER = Exporter(
    API_VERSION,
    "gaussian-ply",
    "one fitted Gaussian per primitive, in the layout of 3D Gaussian splatting; lossy",
    _write,
    OPTIONS,
    conditions=True,
    default="gaussians.ply",
    suffixes=(".ply",),
)

"""Export format ``gaussian-spz``: one Gaussian per primitive as SPZ, a compressed format of 3D Gaussians; lossy.

The file is SPZ version 4. As in files that other tools convert from PLY, y and z of the run's data are negated. SPZ has
no units and states no colour space; viewers show colours as sRGB. The Gaussians are fitted as in
:mod:`neuprim.export.gaussian_ply`. The reported error is that of the rounded Gaussians in the file.
"""

from __future__ import annotations

import numpy as np
import torch

from neuprim.core.cameras.world import World
from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport
from neuprim.core.io.files import atomic_path
from neuprim.core.io.spz import SPZ_FROM_DATA, SpzGaussians, decode_spz, encode_spz
from neuprim.core.model.geometry import quaternion_to_matrix
from neuprim.core.task import API_VERSION
from neuprim.export.gaussian_ply import OPTIONS, Gaussians, fit_exported_gaussians
from neuprim.export.shared import ExportHarmonics


def _write_gaussian_spz(job: ExportJob) -> ExportReport:
    fitted = fit_exported_gaussians(job)
    world = World(torch.from_numpy(SPZ_FROM_DATA) @ job.run.world.world_from_scene.double())
    means, scales, quats, opacities, harmonics = fitted.placed(world)
    try:
        data = encode_spz(SpzGaussians(means, np.log(scales), quats, opacities, harmonics))
    except ValueError as error:
        raise ConfigError(f"{job.run.directory}: {error} in an SPZ file; other formats have no such limit") from None
    errors = fitted.measure(*_place_in_scene(decode_spz(data, str(job.out)), world))
    with atomic_path(job.out) as temporary:
        temporary.write_bytes(data)
    notes = [*fitted.notes, f"rounding to SPZ changes this PSNR from {fitted.errors['psnr']:.2f} dB"]
    if job.run.channels.color_space == "linear":
        notes.append("colours are linear, viewers take them for sRGB: they look darker there")
    return ExportReport((job.out,), False, errors, tuple(notes))


def _place_in_scene(found: SpzGaussians, world: World) -> tuple[Gaussians, ExportHarmonics]:
    """Return the Gaussians of a file, and their colours, in scene coordinates; ``world`` maps the scene to the file."""
    means, quats, scales, opacities, harmonics = (
        torch.from_numpy(values)
        for values in (found.means, found.quats, np.exp(found.log_scales), found.opacities, found.harmonics)
    )
    sides = quaternion_to_matrix(quats) * scales[:, None]
    covariances = sides @ sides.transpose(1, 2)
    gaussians = Gaussians(means, covariances, opacities, torch.arange(len(means)))
    colours = ExportHarmonics(harmonics[:, 0], harmonics[:, 1:], 0.0)
    return gaussians.to_scene(world.inverse), colours.rotate(world.inverse.rotation)


EXPORTER = Exporter(
    API_VERSION,
    "gaussian-spz",
    "one fitted Gaussian per primitive, in the compressed format SPZ; lossy",
    _write_gaussian_spz,
    OPTIONS,
    conditions=True,
    sequence=True,
    default="gaussians.spz",
    suffixes=(".spz",),
)

"""Export format ``gaussian-usd``: one Gaussian per primitive as USD's ParticleField3DGaussianSplat; lossy.

Several frames become time samples of one prim, at the frame numbers of the model's source. Coordinates are those of the
run's data; the stage states the upward axis, and one metre per unit. Positions are float32, so the prim's translation
holds the offset of large coordinates. Opacities are 0 to 1, and SH coefficients of degree 3 have the conventions of 3D
Gaussian splatting. The Gaussians are fitted, and their error is measured, as in :mod:`neuprim.export.gaussian_ply`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from neuprim.core.cameras.world import World
from neuprim.core.conditions import frame_numbers
from neuprim.core.errors import BackendUnavailable
from neuprim.core.extensions import Exporter, ExportJob, ExportReport
from neuprim.core.task import API_VERSION
from neuprim.export.gaussian_ply import OPTIONS, ExportedGaussians, fit_exported_gaussians
from neuprim.export.shared import closest_up_axis, upside_down_usd_notes

_REACH = 3.0  # standard deviations that the stated extent contains


def _write_gaussian_usd(job: ExportJob) -> ExportReport:
    Gf, Usd, UsdGeom, UsdVol = _usd_modules()
    rate = job.number("fps", 0.1, 240.0)
    frames = job.frames(several=True)
    numbers = frame_numbers(job.run.header, frames)
    matrix = job.run.world.world_from_scene.double()
    stage = Usd.Stage.CreateNew(str(job.out))
    up = closest_up_axis(matrix[:3, :3] @ job.run.world.up)
    UsdGeom.SetStageUpAxis(stage, up[-1].upper())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)  # as in Blender, Houdini and OpenVDB; USD's default is a centimetre
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/gaussians")
    stage.SetDefaultPrim(prim.GetPrim())
    prim.AddTranslateOp().Set(Gf.Vec3d(*matrix[:3, 3].tolist()))
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(3)
    if len(frames) > 1:
        stage.SetStartTimeCode(min(numbers))
        stage.SetEndTimeCode(max(numbers))
    if rate is not None:
        stage.SetFramesPerSecond(rate)
        stage.SetTimeCodesPerSecond(rate)
    linear = job.run.channels.color_space == "linear"
    errors: dict[str, float] = {}
    notes: list[str] = []
    for i, (number, frame) in enumerate(zip(numbers, frames, strict=True)):
        job.progress("writing frames", i / len(frames))
        fitted = fit_exported_gaussians(replace(job, frame=frame, progress=lambda text, fraction: None))
        when = Usd.TimeCode(number) if len(frames) > 1 else Usd.TimeCode.Default()
        _set_gaussians(prim, fitted, World(matrix), when)
        prefix = f"frame_{number:04d}." if len(frames) > 1 else ""
        errors |= {f"{prefix}{key}": value for key, value in fitted.errors.items()}
        notes = notes or list(fitted.notes)
    prim.GetRadianceSphericalHarmonicsCoefficientsAttr().SetColorSpace(
        Gf.ColorSpaceNames.LinearRec709 if linear else Gf.ColorSpaceNames.SRGBRec709
    )
    stage.GetRootLayer().Save()
    if len(frames) > 1:
        notes.insert(0, f"{len(frames)} frames as time samples; of frame {numbers[0]}:")
    return ExportReport((job.out,), False, errors, (*notes, *upside_down_usd_notes(up)))


def _set_gaussians(prim: Any, fitted: ExportedGaussians, world: World, when: Any) -> None:
    """Set the attributes of a ParticleField3DGaussianSplat at a time; ``world`` maps the scene to the stage."""
    from pxr import Vt

    means, scales, quats, opacities, harmonics = fitted.placed(world)
    places = means - world.scene_from_world[:3, 3].numpy()
    reach = _REACH * scales.max(1, keepdims=True)

    def vectors(values: np.ndarray) -> Any:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values.reshape(-1, 3), np.float32))

    prim.CreatePositionsAttr().Set(vectors(places), when)
    prim.CreateScalesAttr().Set(vectors(scales), when)
    orientations = np.ascontiguousarray(quats[:, [1, 2, 3, 0]], np.float32)  # stored as xyzw
    prim.CreateOrientationsAttr().Set(Vt.QuatfArray.FromNumpy(orientations), when)
    prim.CreateOpacitiesAttr().Set(Vt.FloatArray.FromNumpy(opacities.astype(np.float32)), when)
    prim.CreateRadianceSphericalHarmonicsCoefficientsAttr().Set(vectors(harmonics), when)
    prim.CreateExtentAttr().Set(vectors(np.stack([(places - reach).min(0), (places + reach).max(0)])), when)


def _usd_modules() -> tuple[Any, Any, Any, Any]:
    """Import modules of usd-core; raise BackendUnavailable if it is missing or too old for the schema."""
    try:
        from pxr import Gf, Usd, UsdGeom, UsdVol
    except ImportError as error:
        raise BackendUnavailable(f"gaussian-usd needs usd-core ({error}): pip install 'neuprim[usd]'") from None
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        found = ".".join(map(str, Usd.GetVersion()[1:]))
        raise BackendUnavailable(f"gaussian-usd needs usd-core 26.3 or newer; found {found}: pip install -U usd-core")
    return Gf, Usd, UsdGeom, UsdVol


EXPORTER = Exporter(
    API_VERSION,
    "gaussian-usd",
    "one fitted Gaussian per primitive, as USD's ParticleField3DGaussianSplat; lossy",
    _write_gaussian_usd,
    {**OPTIONS, "fps": (None, "frames per second of the stage")},
    conditions=True,
    default="gaussians.usdc",
    suffixes=(".usdc", ".usda", ".usd"),
)

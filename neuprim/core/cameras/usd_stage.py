"""Script that prints the camera of a USD stage as JSON; runs in a separate process, without any import of neuprim.

The command-line arguments are the file, the prim path of the camera ("" for the only camera), and the largest number of
frames. The script prints an error as one line on standard error.
"""

from __future__ import annotations

import json
import math
import sys
from typing import Any

MEMORY = 4 << 30  # limit of the process in bytes, as a file may claim any size


def read_usd_camera(path: str, wanted: str, most: int) -> dict[str, Any]:
    """Read one camera of the USD stage ``path`` as a JSON object, for :mod:`neuprim.core.cameras.camera_files`.

    The object has the keys ``path`` (prim path of the camera), ``frames`` (one per time code), ``fps``, ``up`` (axis),
    ``meters`` (per unit of the stage), and those of :func:`usd_render_settings`. ``wanted`` is the camera's prim path,
    "" for the only camera; ``most`` limits the number of frames. Raises SystemExit with an error message.
    """
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(path, Usd.Stage.LoadNone)  # payloads are not followed
    except Tf.ErrorException as error:
        reason = (
            error.args[0].commentary.strip().splitlines()[0].removeprefix(f"{path}:")
        )  # the first is why, the others what failed with it
        raise SystemExit(f"not a readable USD file ({reason})") from None
    cameras = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    paths = [str(prim.GetPath()) for prim in cameras]
    if not paths:
        raise SystemExit("has no camera; expected one (payloads are not read)")
    listed = ", ".join(paths[:8]) + (", ..." if len(paths) > 8 else "")
    if wanted and wanted not in paths:
        raise SystemExit(f"has no camera {wanted}; expected one of {listed}")
    if not wanted and len(paths) > 1:
        raise SystemExit(f"has {len(paths)} cameras; expected FILE#PATH, where PATH is one of {listed}")
    camera = UsdGeom.Camera(cameras[paths.index(wanted) if wanted else 0])
    moments = usd_camera_times(stage, camera, most, Usd, UsdGeom)
    return {
        "path": str(camera.GetPath()),
        "frames": [usd_camera_frame(camera, moment) for moment in moments],
        "fps": stage.GetTimeCodesPerSecond(),
        "up": str(UsdGeom.GetStageUpAxis(stage)),
        "meters": UsdGeom.GetStageMetersPerUnit(stage),
        **usd_render_settings(stage),
    }


def usd_camera_times(stage: Any, camera: Any, most: int, Usd: Any, UsdGeom: Any) -> list[Any]:
    """Return the time codes at which to read a camera; raise SystemExit for more than ``most`` time codes.

    A moving camera is read at time codes in steps of 1, from the stage's start time code to the end time code. A camera
    at rest is read once: at the start time code, or at USD's earliest time if the stage has no time range. ``Usd`` and
    ``UsdGeom`` are modules of the package pxr.
    """
    prim, moves = camera.GetPrim(), any(a.ValueMightBeTimeVarying() for a in camera.GetPrim().GetAttributes())
    while not moves and prim and not prim.IsPseudoRoot():
        moves, prim = (
            UsdGeom.Xformable(prim).TransformMightBeTimeVarying() if UsdGeom.Xformable(prim) else False,
            prim.GetParent(),
        )
    if not moves:
        return [
            Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.EarliestTime()
        ]
    if not stage.HasAuthoredTimeCodeRange():
        raise SystemExit("the camera moves, but startTimeCode and endTimeCode are missing; expected both")
    first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    if not (math.isfinite(first) and math.isfinite(last) and 0 <= last - first < most):
        raise SystemExit(f"startTimeCode {first:g} to endTimeCode {last:g}; expected a range of 1 to {most} time codes")
    return [Usd.TimeCode(first + i) for i in range(int(last - first + 1e-9) + 1)]


def usd_camera_frame(camera: Any, moment: Any) -> dict[str, Any]:
    """Return time code, projection, (4, 4) camera-to-world pose for column vectors, focal length and aperture."""
    found = camera.GetCamera(moment)
    matrix = found.transform
    return {
        "code": moment.GetValue(),
        "projection": "perspective" if found.projection == found.Perspective else "orthographic",
        "transform_matrix": [[matrix[column][row] for column in range(4)] for row in range(4)],
        "focal": found.focalLength,
        "aperture": [found.horizontalAperture, found.verticalAperture],
        "offset": [found.horizontalApertureOffset, found.verticalApertureOffset],
    }


def usd_render_settings(stage: Any) -> dict[str, Any]:
    """Return the stage's render settings; empty without settings.

    ``resolution`` is the image size [width, height] in pixels, ``pixelAspectRatio`` the width of a pixel divided by its
    height, and ``aspectRatioConformPolicy`` says how to fit the aperture into an image of another shape.
    """
    from pxr import UsdRender

    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    if not settings:
        return {}
    size = settings.GetResolutionAttr().Get()
    return {
        "resolution": None if size is None else [int(size[0]), int(size[1])],
        "pixelAspectRatio": settings.GetPixelAspectRatioAttr().Get(),
        "aspectRatioConformPolicy": str(settings.GetAspectRatioConformPolicyAttr().Get()),
    }


def limit_usd_memory() -> None:
    """Limit the memory of this process to :data:`MEMORY`, if the system supports limits."""
    try:
        import resource
    except ImportError:  # Windows
        return
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    if hard == resource.RLIM_INFINITY or hard > MEMORY:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, hard))


if __name__ == "__main__":
    limit_usd_memory()
    print(json.dumps(read_usd_camera(sys.argv[1], sys.argv[2], int(sys.argv[3]))))

"""Write a USD stage that shows exported .vdb files as one volume, with a time sample per frame (schema UsdVol)."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from neuprim.core.io.files import write_text

_ASSET = """
    rel field:{prim} = </volume/{prim}>

    def OpenVDBAsset "{prim}"
    {{
        token fieldName = {name}
        asset filePath{paths}
    }}
"""


def write_usd_volume(
    path: Path,
    files: Mapping[int, Path],
    grids: Sequence[str],
    boxes: Sequence[np.ndarray],
    up: str,
    rate: float | None,
) -> None:
    """Write the stage as text file ``path`` (.usda), atomically. The stage names files in its folder by relative paths.

    Args:
        files: frame number -> .vdb file, in the folder of ``path``. With one file, the volume does not change in time.
        grids: names of the grids in every file.
        boxes: (2, 3) bounds of the frames that have any voxel, in the files' world coordinates.
        up: upward axis in these coordinates; USD only knows y and z, so that the sign of -y and -z is left out.
        rate: frames per second; None leaves USD's default, 24.
    """
    # one metre per unit, as in Blender, Houdini and OpenVDB; USD's default is a centimetre
    head = ['defaultPrim = "volume"', f'upAxis = "{up[-1].upper()}"', "metersPerUnit = 1"]
    if rate is not None:
        head += [f"framesPerSecond = {rate:g}", f"timeCodesPerSecond = {rate:g}"]
    if len(files) == 1:
        (only,) = files.values()
        paths = f" = @./{only.name}@"
    else:
        head += [f"startTimeCode = {min(files)}", f"endTimeCode = {max(files)}"]
        samples = "".join(f"            {n}: @./{file.name}@,\n" for n, file in files.items())
        paths = f".timeSamples = {{\n{samples}        }}"
    everywhere = np.stack(boxes or [np.zeros((2, 3))])
    ends = everywhere[:, 0].min(0), everywhere[:, 1].max(0)
    low, high = (f"({', '.join(f'{x:.9g}' for x in end)})" for end in ends)
    assets = "".join(_ASSET.format(prim=_prim_name(name), name=json.dumps(name), paths=paths) for name in grids)
    lines = "".join(f"    {line}\n" for line in head)
    body = f'def Volume "volume"\n{{\n    float3[] extent = [{low}, {high}]\n{assets}}}\n'
    write_text(path, f"#usda 1.0\n(\n{lines})\n\n{body}")


def _prim_name(grid: str) -> str:
    """Return a name that USD allows: letters, digits and _, not beginning with a digit."""
    name = re.sub(r"\W", "_", grid, flags=re.ASCII)
    return name if name and not name[0].isdigit() else f"_{name}"

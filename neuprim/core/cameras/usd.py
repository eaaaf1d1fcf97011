"""Cameras of USD stages, read by Pixar's library in a process of its own with limits of time and memory."""

from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
import sys
from pathlib import Path

import torch
from torch import Tensor

from neuprim.core.cameras import usd_stage
from neuprim.core.cameras.pinhole import (
    FRAME_RATES,
    MAX_CAMERAS,
    MAX_IMAGE_SIDE,
    Camera,
    CameraViews,
    opengl_to_viewmat,
)
from neuprim.core.errors import BackendUnavailable, DataError
from neuprim.core.io.json_reader import JsonReader

_MAGIC = (b"#usda ", b"PXR-USDC", b"PK\x03\x04")
_MAX_BYTES = 1 << 30
_SECONDS = 120.0
_SCALED = 1e-3  # how unequal the axes of a pose may be


def is_usd(path: Path) -> bool:
    """Whether a file begins as one of USD's three formats does."""
    try:
        with open(path, "rb") as file:
            return file.read(8).startswith(_MAGIC)
    except OSError:
        return False


def read_usd_cameras(path: Path, prim: str = "", size: tuple[int, int] | None = None) -> CameraViews:
    """Read the camera of a stage (``prim``, where there are several), at every whole time code where it moves.

    Axes and units are the stage's; ``size`` is in pixels, None for the stage's own. The image shows the whole aperture
    ("expandAperture" of UsdRender). Raises DataError for unreadable stages, orthographic or sheared cameras, or no
    size.
    """
    if importlib.util.find_spec("pxr") is None:
        raise BackendUnavailable(f"{path}: USD files need the package usd-core: pip install 'neuprim[usd]'")
    stage = _read_usd_stage(path, prim)
    where = f"{path}: {stage.text('path')}"
    wanted = size or _usd_image_size(stage, path)
    records = list(stage.objects("frames"))
    cameras = [
        _usd_camera(JsonReader(r.values, where if len(records) == 1 else f"{where}, frame {i}"), wanted)
        for i, r in enumerate(records)
    ]
    note = (
        f"{stage.text('up')} is up and a unit is {stage.number('meters', 'metres per unit', 0.0):g} m in "
        "this file; taken as the axes and units of the run's data"
    )
    fps = stage.number("fps", "time codes per second above 0", 0.0) if len(cameras) > 1 else None
    if fps is not None and not FRAME_RATES[0] <= fps <= FRAME_RATES[1]:  # some tools count in ticks
        note, fps = f"{note}; timeCodesPerSecond {fps:g} is no rate of a film, --fps says another", None
    return CameraViews(tuple((f"camera_{i:03d}", camera) for i, camera in enumerate(cameras)), None, fps, (note,))


def _read_usd_stage(path: Path, prim: str) -> JsonReader:
    """What the process printed."""
    if path.stat().st_size > _MAX_BYTES:
        raise DataError(f"{path}: {path.stat().st_size} bytes; expected at most {_MAX_BYTES}")
    # -P: modules beside the script are none of pxr's
    words = [sys.executable, "-P", str(Path(usd_stage.__file__)), str(path.resolve()), prim, str(MAX_CAMERAS)]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=_SECONDS)
    except subprocess.TimeoutExpired:
        raise DataError(f"{path}: not read after {_SECONDS:.0f} s; expected a USD file with a camera") from None
    if done.returncode < 0:
        raise DataError(
            f"{path}: not a readable USD file (its reader ended by {signal.Signals(-done.returncode).name})"
        )
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise DataError(f"{path}: {said[:300]}")
    try:
        return JsonReader(json.loads(done.stdout.strip().splitlines()[-1]), str(path))
    except (ValueError, IndexError) as error:
        raise DataError(f"{path}: not a readable USD file ({error})") from None


def _usd_image_size(stage: JsonReader, path: Path) -> tuple[int, int]:
    if not stage.has("resolution"):
        raise DataError(f"{path}: names no size of an image (renderSettingsPrimPath); give --size WxH")
    width, height = (int(x) for x in stage.array("resolution", (2,), "width and height").tolist())
    if not (0 < width <= MAX_IMAGE_SIDE and 0 < height <= MAX_IMAGE_SIDE):
        raise DataError(f"{path}: resolution {width}x{height}; expected 1 to {MAX_IMAGE_SIDE} pixels a side")
    return width, height


def _usd_camera(record: JsonReader, size: tuple[int, int]) -> Camera:
    if record.text("projection") != "perspective":
        raise record.fail("projection", "perspective; others are not drawn")
    focal = record.number("focal", "a focal length above 0", 0.0)
    (wide, high), (right, up) = (record.array(key, (2,), "two numbers").tolist() for key in ("aperture", "offset"))
    if wide <= 0 or high <= 0:
        raise DataError(f"{record.where}: aperture is {wide:g} x {high:g}; expected numbers above 0")
    width, height = size
    scale = min(width / wide, height / high)  # pixels per unit of the aperture; all of it is in the image
    pose = opengl_to_viewmat(_remove_pose_scale(record.matrix("transform_matrix"), record.where))
    camera = Camera(
        pose, focal * scale, focal * scale, width / 2 - right * scale, height / 2 + up * scale, width, height
    )
    return camera.validate(record.where)


def _remove_pose_scale(matrix: Tensor, where: str) -> Tensor:
    """The pose without the one scale of all its axes, which a camera's image does not depend on."""
    lengths = matrix[:3, :3].norm(dim=0)
    mean = lengths.mean()
    if not bool(mean > 0) or float((lengths / mean - 1).abs().max()) > _SCALED:
        raise DataError(
            f"{where}: its transform scales by {', '.join(f'{x:g}' for x in lengths.tolist())}; expected one "
            "scale for all axes"
        )
    return torch.cat([torch.cat([matrix[:3, :3] / lengths, matrix[:3, 3:]], 1), matrix[3:]])

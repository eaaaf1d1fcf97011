"""Read cameras from files: JSON with a list of frames or a camera path, USD stages, and COLMAP models.

USD stages are read with Pixar's USD library, in a separate process with limits on time and memory.
"""

from __future__ import annotations

import importlib.util
import json
import math
import signal
import subprocess
import sys
from pathlib import Path

import torch
from torch import Tensor

from neuprim.core.cameras.colmap import find_colmap_model, read_colmap_cameras
from neuprim.core.cameras.intrinsics import (
    MODELS,
    CameraTarget,
    has_fisheye_lens,
    read_camera,
    read_lens_coefficients,
    refuse_unsupported_camera_keys,
)
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

__all__ = ["read_camera_file", "read_cameras"]

_MAX_BYTES = 64 * 1024 * 1024
_USD_SCRIPT = Path(__file__).with_name("usd_stage.py")  # run, never imported
_VIEWER_NOTE = (
    "poses are taken as they are; nerfstudio's viewer has them in the frame that its dataparser moved "
    "and scaled the scene to"
)


def read_camera_file(path: Path, size: tuple[int, int] | None = None) -> CameraViews:
    """Read the cameras of a JSON file, a USD stage or a COLMAP model.

    A JSON file has a list ``frames``, as in ``transforms.json``, or the ``camera_path`` that nerfstudio's viewer
    writes. The path ``FILE#/PRIM`` chooses one camera of a USD stage by its prim.

    Args:
        size: (width, height) in pixels, for files that do not state an image size.

    Raises:
        DataError: a field is missing or wrong.
        BackendUnavailable: the package that reads the format is missing.
    """
    text, hash_, prim = str(path).partition("#")
    path, prim = (Path(text), prim) if hash_ and not path.exists() else (path, "")
    model = find_colmap_model(path)
    if model is not None:
        named, notes = read_colmap_cameras(model)
        if len(named) > MAX_CAMERAS:
            raise DataError(f"{path}: the model has {len(named)} cameras; expected at most {MAX_CAMERAS}")
        return CameraViews(tuple(named), notes=tuple(notes))
    if path.is_dir():
        found = "is a folder without cameras.txt or cameras.bin"
        raise DataError(f"{path}: {found}; expected a COLMAP model, or a file of cameras")
    if is_usd(path):
        return read_usd_cameras(path, prim, size)
    document = JsonReader.open(path, _MAX_BYTES)
    if document.has("camera_path"):
        return _read_camera_path(document, size)
    if not document.has("frames"):
        raise document.fail("frames", "a non-empty list of objects (or camera_path, as nerfstudio's viewer writes it)")
    return _read_camera_frames(document, size)


def read_cameras(path: Path, size: tuple[int, int] | None = None) -> list[tuple[str, Camera]]:
    """Return (name, camera) pairs of a file in any format that :func:`read_camera_file` reads."""
    return list(read_camera_file(path, size).named)


def _camera_records(document: JsonReader, key: str) -> list[JsonReader]:
    records = list(document.objects(key))
    if len(records) > MAX_CAMERAS:
        raise DataError(f"{document.where}: {key} has {len(records)} cameras; expected at most {MAX_CAMERAS}")
    return records


def _read_camera_image_size(record: JsonReader, keys: tuple[str, str], size: tuple[int, int] | None) -> tuple[int, int]:
    found = []
    for key, fallback in zip(keys, size or (0, 0), strict=True):
        value = record.count(key) if record.has(key) or size is None else fallback
        if not 0 < value <= MAX_IMAGE_SIDE:
            raise DataError(f"{record.where}: {key} is {value}; expected 1 to {MAX_IMAGE_SIDE} pixels")
        found.append(value)
    return found[0], found[1]


def _read_camera_file_times(records: list[JsonReader], key: str) -> tuple[float, ...] | None:
    """Return one time per camera, from the field ``key`` of each record; None if a record lacks the field."""
    return tuple(r.number(key, "a time") for r in records) if all(r.has(key) for r in records) else None


def _read_camera_frame_rate(document: JsonReader, count: int) -> float | None:
    """Return the frames per second: the field ``fps``, else ``count`` frames divided by the field ``seconds``.

    Returns None if the file has neither field.
    """
    for key in ("fps", "seconds"):
        if document.has(key):
            value = document.number(key, "a number above 0", 0.0)
            rate = value if key == "fps" else count / value
            if not FRAME_RATES[0] <= rate <= FRAME_RATES[1]:
                raise document.fail(key, f"{FRAME_RATES[0]:g} to {FRAME_RATES[1]:g} frames per second")
            return rate
    return None


def _read_camera_frames(document: JsonReader, size: tuple[int, int] | None) -> CameraViews:
    """Read the cameras of a JSON file in the format of ``transforms.json``.

    The keys are ``{"w", "h", "camera_angle_x" | "fl_x"[, ...], "frames": [{"transform_matrix", ...}]}``. ``size`` is
    (width, height) in pixels, for a file without ``w`` and ``h``. Lens distortion is left out, and a note of the result
    says so.
    """
    records, found, bent = _camera_records(document, "frames"), [], 0
    notes: dict[str, None] = {}
    refuse_unsupported_camera_keys(document)
    for i, record in enumerate(records):
        refuse_unsupported_camera_keys(record)
        if has_fisheye_lens(record, document, ()):
            what = "the camera is a fisheye (camera_model, is_fisheye)"
            raise DataError(f"{record.where}: {what}; expected one of {', '.join(MODELS)}")
        bent += any(read_lens_coefficients(record, document).values())
        stated = {key: r.values[key] for r in (document, record) for key in ("w", "h") if r.has(key)}
        target = CameraTarget(*_read_camera_image_size(JsonReader(stated, record.where), ("w", "h"), size))
        own = record.has("transform_matrix") or not document.has("transform_matrix")
        view = None if own else opengl_to_viewmat(document.matrix("transform_matrix"))
        camera = read_camera(record, document, target, view, lambda text: notes.update({text: None}))
        found.append((f"camera_{i:03d}", camera.validate(record.where)))
    if bent:
        notes[f"the lens distortion of {bent} of {len(found)} cameras is left out"] = None
    return CameraViews(
        tuple(found),
        _read_camera_file_times(records, "time"),
        _read_camera_frame_rate(document, len(found)),
        tuple(notes),
    )


def _read_camera_path(document: JsonReader, size: tuple[int, int] | None) -> CameraViews:
    """Read a nerfstudio ``camera_path``: ``fov`` is vertical, in degrees; poses are camera to world, OpenGL axes."""
    if document.values.get("camera_type", "perspective") != "perspective":
        raise document.fail("camera_type", "perspective, the only supported type")
    records = _camera_records(document, "camera_path")
    width, height = _read_camera_image_size(document, ("render_width", "render_height"), size)
    found = []
    for i, record in enumerate(records):
        fov = record.number("fov", "a vertical field of view in degrees, between 0 and 180", 0.0, 180.0)
        focal = 0.5 * height / math.tan(math.radians(fov) / 2)
        view = opengl_to_viewmat(_read_camera_matrix(record, "camera_to_world"))
        camera = Camera(view, focal, focal, 0.5 * width, 0.5 * height, width, height)
        found.append((f"camera_{i:03d}", camera.validate(f"{record.where}.camera_to_world")))
    return CameraViews(
        tuple(found),
        _read_camera_file_times(records, "render_time"),
        _read_camera_frame_rate(document, len(found)),
        (_VIEWER_NOTE,),
    )


def _read_camera_matrix(record: JsonReader, key: str) -> Tensor:
    """Read a (4, 4) matrix from field ``key``, given as 16 numbers in row-major order, or as 3 or 4 rows."""
    value = record.values.get(key)
    if isinstance(value, list) and len(value) == 16:
        return JsonReader({key: [value[i : i + 4] for i in (0, 4, 8, 12)]}, record.where).matrix(key)
    if not isinstance(value, list) or len(value) not in (3, 4):
        raise record.fail(key, "16 numbers, row by row")
    return record.matrix(key)


_USD_MAGIC = (b"#usda ", b"PXR-USDC", b"PK\x03\x04")
_MAX_USD_BYTES = 1 << 30
_USD_SECONDS = 120.0
_USD_POLICY = "expandAperture"
_UNEQUAL_SCALES = 1e-3  # largest relative deviation of a pose's axis scales from their mean


def is_usd(path: Path) -> bool:
    """Return whether a file begins like a USD file: as text (usda), binary (usdc) or a zip archive (usdz)."""
    try:
        with open(path, "rb") as file:
            return file.read(8).startswith(_USD_MAGIC)
    except OSError:
        return False


def read_usd_cameras(path: Path, prim: str = "", size: tuple[int, int] | None = None) -> CameraViews:
    """Read one camera of a USD stage; a moving camera gives one view per time code, in steps of 1.

    ``prim`` is the prim path of the camera, required if the stage has several cameras. The result has the axes and
    units of the stage. ``size`` is (width, height) in pixels; None uses the size in the stage's render settings. The
    image shows the whole aperture ("expandAperture" of UsdRender). Raises DataError for unreadable stages, orthographic
    cameras, poses with shear or unequal scales, a size in pixels that are not square, or if no size is known. Raises
    BackendUnavailable if the package usd-core is missing.
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
    if stage.has("aspectRatioConformPolicy") and (policy := stage.text("aspectRatioConformPolicy")) != _USD_POLICY:
        note = f"{note}; aspectRatioConformPolicy {policy} is read as {_USD_POLICY}"
    fps = stage.number("fps", "time codes per second above 0", 0.0) if len(cameras) > 1 else None
    if fps is not None and not FRAME_RATES[0] <= fps <= FRAME_RATES[1]:  # some tools count in ticks
        note, fps = f"{note}; timeCodesPerSecond {fps:g} is no rate of a film, --fps says another", None
    codes = tuple(r.number("code", "a time code") for r in records) if len(records) > 1 else None
    named = tuple((f"camera_{i:03d}", camera) for i, camera in enumerate(cameras))
    return CameraViews(named, None, fps, (note,), codes)


def _read_usd_stage(path: Path, prim: str) -> JsonReader:
    """Return the JSON object that ``usd_stage.py`` prints for camera ``prim`` of a file, run in a separate process."""
    if path.stat().st_size > _MAX_USD_BYTES:
        raise DataError(f"{path}: the file has {path.stat().st_size} bytes; expected at most {_MAX_USD_BYTES}")
    # -P: pxr must not import modules from the script's folder
    words = [sys.executable, "-P", str(_USD_SCRIPT), str(path.resolve()), prim, str(MAX_CAMERAS)]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=_USD_SECONDS)
    except subprocess.TimeoutExpired:
        raise DataError(f"{path}: reading took over {_USD_SECONDS:.0f} s; expected a USD file with a camera") from None
    if done.returncode < 0:
        raise DataError(
            f"{path}: not a readable USD file (the USD reader was ended by {signal.Signals(-done.returncode).name})"
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
        raise DataError(f"{path}: states no image size (renderSettingsPrimPath); give --size WxH")
    width, height = (int(x) for x in stage.array("resolution", (2,), "width and height").tolist())
    if not (0 < width <= MAX_IMAGE_SIDE and 0 < height <= MAX_IMAGE_SIDE):
        raise DataError(f"{path}: resolution {width}x{height}; expected 1 to {MAX_IMAGE_SIDE} pixels per side")
    ratio = stage.number_or("pixelAspectRatio", 1.0)
    if abs(ratio - 1.0) > 1e-6:
        raise DataError(f"{path}: pixelAspectRatio {ratio:g}; expected 1 (square pixels), or --size WxH")
    return width, height


def _usd_camera(record: JsonReader, size: tuple[int, int]) -> Camera:
    if record.text("projection") != "perspective":
        raise record.fail("projection", "perspective, the only supported projection")
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
    """Remove the uniform scale from a (4, 4) camera-to-world pose; raise DataError if the axes have unequal scales."""
    lengths = matrix[:3, :3].norm(dim=0)
    mean = lengths.mean()
    if not bool(mean > 0) or float((lengths / mean - 1).abs().max()) > _UNEQUAL_SCALES:
        raise DataError(
            f"{where}: its transform scales the axes by {', '.join(f'{x:g}' for x in lengths.tolist())}; "
            "expected the same scale for all axes"
        )
    return torch.cat([torch.cat([matrix[:3, :3] / lengths, matrix[:3, 3:]], 1), matrix[3:]])

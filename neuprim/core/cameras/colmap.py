"""Read COLMAP's sparse models with the package pycolmap.

Binary files are checked before pycolmap reads them, because pycolmap hangs on files with damaged counts of records.
"""

from __future__ import annotations

import shutil
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import Camera
from neuprim.core.errors import BackendUnavailable, DataError

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")  # camera models without distortion
_DISTORTED = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")  # pinholes but for their distortion

_PARTS = ("cameras", "images", "points3D", "rigs", "frames")


def import_pycolmap() -> Any:
    """Return the imported package pycolmap; raise :class:`BackendUnavailable` if it is missing."""
    try:
        import pycolmap
    except ImportError as error:
        what = f"COLMAP scenes need the package pycolmap ({error}): pip install 'neuprim[colmap]'"
        raise BackendUnavailable(what) from None
    return pycolmap


def _colmap_model_suffix(folder: Path) -> str | None:
    return next((s for s in (".bin", ".txt") if (folder / f"cameras{s}").is_file()), None)


def read_colmap_model(folder: Path) -> Any:
    """Read the ``pycolmap.Reconstruction`` in a folder; raises DataError for a missing or damaged file."""
    pycolmap = import_pycolmap()
    kind = _colmap_model_suffix(folder)
    if kind is None:
        raise DataError(f"{folder}: no cameras.bin or cameras.txt; expected a COLMAP model (scene.model)")
    absent = [name + kind for name in _PARTS[1:3] if not (folder / (name + kind)).is_file()]
    if absent:
        raise DataError(
            f"{folder}: {len(absent)} files not found: {', '.join(absent)}; expected a complete COLMAP model"
        )
    if kind == ".bin":
        check_binary_colmap_model(folder, _lens_parameter_count)
    framed = (folder / f"frames{kind}").is_file()
    try:
        stored = _stored_colmap_images(folder / f"images{kind}") if framed or kind == ".txt" else []
        model = pycolmap.Reconstruction(str(folder))
        for number, _, name in stored:
            if " " in name:  # COLMAP cuts names of text files off at the first blank
                model.images[number].name = name
        for image in model.images.values():
            _ = image.name  # UnicodeDecodeError where it is no UTF-8
        if framed:
            _check_colmap_frame_poses(model, stored, folder, kind)
        return model
    except DataError:
        raise
    except Exception as error:  # pycolmap raises many types for inconsistent models
        raise DataError(f"{folder}: not a readable COLMAP model ({type(error).__name__}: {error})") from None


def _stored_colmap_images(path: Path) -> list[tuple[int, Sequence[Any], str]]:
    """Return (number, pose as QW QX QY QZ TX TY TZ, name) of each image in an images file; "" for names in binary."""
    images: list[tuple[int, Sequence[Any], str]] = []
    if path.suffix == ".bin":
        file = _ColmapRecordReader(path)
        for _ in range(file.number("Q")):
            number, *pose = struct.unpack_from("<I7d", file.data, file.at)
            images.append((number, pose, ""))
            _skip_image(file)
        return images
    lines = iter(path.read_text(encoding="utf-8-sig", errors="surrogateescape").split("\n"))
    for line in lines:
        fields = line.strip().split(maxsplit=9)
        if not fields or fields[0].startswith("#"):
            continue
        points = next(lines, "").split()
        if len(points) % 3 or (points and not points[-1].removeprefix("-").isdecimal()):
            found = f"the line after image {fields[0]} is no line of points"
            expected = "X, Y, POINT3D_ID for each point, or an empty line if the image has none"
            raise DataError(f"{path}: {found}; expected {expected}")
        images.append((int(fields[0]), fields[1:8], fields[9] if len(fields) == 10 else ""))
    return images


def _check_colmap_frame_poses(
    model: Any, stored: Sequence[tuple[int, Sequence[Any], str]], folder: Path, kind: str
) -> None:
    """Raise DataError if the pose of an image differs in the frames file, from which COLMAP 3.12 and later read it."""
    pycolmap = import_pycolmap()
    for number, pose, _ in stored:
        image = model.images[number]
        if not image.has_pose:
            continue
        w, x, y, z, *shift = map(float, pose)
        turn = pycolmap.Rotation3d(np.array([x, y, z, w]))
        found, read = pycolmap.Rigid3d(turn, np.array(shift)).matrix(), colmap_viewmat(image)[:3].numpy()
        unit = [1.0, 1.0, 1.0, max(float(np.linalg.norm(shift)), 1e-2)]
        if not np.allclose(found / unit, read / unit, rtol=0.0, atol=1e-4, equal_nan=True):
            what = f"the pose of image {image.name} in images{kind} differs from that in frames{kind}"
            remedy = "remove rigs.* and frames.* if another program changed images.*"
            raise DataError(f"{folder}: {what}; expected equal poses ({remedy})")


def _lens_parameter_count(model: int) -> int:
    pycolmap = import_pycolmap()
    try:
        return len(pycolmap.Camera(model=pycolmap.CameraModelId(model), width=1, height=1).params_info.split(","))
    except Exception:  # unknown numbers raise different types in different versions
        return -1


def pinhole_parameters(lens: Any, where: str) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy in pixels of a ``pycolmap.Camera``, ignoring distortion."""
    # asking a panorama for its focal length ends the process, so the parameters are taken by their names
    named: dict[str, float | None] = dict(
        zip((n.strip() for n in lens.params_info.split(",")), map(float, lens.params), strict=False)
    )
    named = {"fx": named.get("f"), "fy": named.get("f"), **named}
    fx, fy, cx, cy = (named.get(key) for key in ("fx", "fy", "cx", "cy"))
    if fx is None or fy is None or cx is None or cy is None:
        expected = "a model with focal lengths, which a pinhole camera can replace"
        raise DataError(f"{where}: model is {lens.model_name}; expected {expected}")
    return fx, fy, cx, cy


def colmap_viewmat(image: Any) -> Tensor:
    """Return the (4, 4) float64 world-to-camera matrix, OpenCV axes, of a ``pycolmap.Image``."""
    pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3] = torch.from_numpy(np.asarray(pose.matrix(), dtype=np.float64))
    return viewmat


def largest_colmap_model(project: Path) -> tuple[Path | None, str]:
    """Find the COLMAP model with the most images in the folder ``sparse`` of a project.

    Returns a pair: the folder of the model (None without any model), and a message for the user (empty unless there are
    several models).
    """
    place = project / "sparse"
    models = sorted(
        (p for p in place.glob("*") if _colmap_model_suffix(p) is not None), key=lambda p: (len(p.name), p.name)
    )
    if not models:
        return (place if _colmap_model_suffix(place) is not None else None), ""
    counts = [_count_colmap_images(p) for p in models]
    best = models[counts.index(max(counts))]
    if len(models) == 1:
        return best, ""
    found = ", ".join(f"{p.name} with {n}" for p, n in zip(models, counts, strict=True))
    return best, f"{place}: has several models: {found} posed images; {best.name} is used"


def _count_colmap_images(model: Path) -> int:
    """Count a COLMAP model's images from its images file without decoding them; 0 if the file is not readable."""
    try:
        if (model / "images.bin").is_file():
            with open(model / "images.bin", "rb") as file:
                return int.from_bytes(file.read(8), "little")
        with open(model / "images.txt", encoding="utf-8", errors="replace") as file:
            return (sum(not line.startswith("#") for line in file) + 1) // 2
    except OSError:
        return 0


def find_colmap_model(path: Path) -> Path | None:
    """Return the folder of the COLMAP model that ``path`` refers to; None if there is no model.

    ``path`` may be the folder, a file of the model, or a project: a folder whose subfolder ``sparse`` holds models.
    """
    if path.is_dir():
        return path if _colmap_model_suffix(path) is not None else largest_colmap_model(path)[0]
    is_part = path.suffix in (".txt", ".bin") and path.stem in _PARTS
    return path.parent if is_part and _colmap_model_suffix(path.parent) else None


def read_colmap_cameras(folder: Path) -> tuple[list[tuple[str, Camera]], list[str]]:
    """Return the pinhole cameras of all posed images of a COLMAP model, and messages for the user.

    A posed image is an image with a known camera pose. The cameras are pairs (image name without suffix, camera),
    sorted by name. Lens distortion is left out, and a message says so. Raises DataError for a damaged model, an
    unsupported camera model, or no posed image.
    """
    reconstruction = _read_colmap_cameras_only(folder)
    images = sorted((i for i in reconstruction.images.values() if i.has_pose), key=lambda i: i.name)
    if not images:
        raise DataError(f"{folder}: has no images with a pose; expected at least one")
    found, bent = [], Counter[str]()
    for image in images:
        lens = reconstruction.cameras[image.camera_id]
        if not PurePosixPath(image.name).name:
            raise DataError(f"{folder}: image {image.image_id} has the name {image.name!r}; expected a file name")
        where = f"{folder}: camera {image.camera_id} of image {image.name}"
        if lens.model_name not in (*PINHOLES, *_DISTORTED):
            expected = ", ".join((*PINHOLES, *_DISTORTED))
            raise DataError(f"{where}: model is {lens.model_name}; expected one of {expected}")
        named = zip((name.strip() for name in lens.params_info.split(",")), lens.params, strict=True)
        bent[lens.model_name] += any(value for name, value in named if name not in ("f", "fx", "fy", "cx", "cy"))
        camera = Camera(colmap_viewmat(image), *pinhole_parameters(lens, where), int(lens.width), int(lens.height))
        found.append((str(PurePosixPath(image.name).with_suffix("")), camera.validate(where)))
    notes = [
        f"the lens distortion of {count} of {len(found)} cameras ({model}) is left out"
        for model, count in sorted(bent.items())
        if count
    ]
    several = largest_colmap_model(folder.parent.parent)[1] if folder.parent.name == "sparse" else ""
    return found, notes + [several] * bool(several)


def _read_colmap_cameras_only(folder: Path) -> Any:
    """Return the ``pycolmap.Reconstruction`` of a COLMAP model, even if the model's file of 3D points is missing."""
    kind = _colmap_model_suffix(folder)
    if kind is None or (folder / f"points3D{kind}").is_file() or not (folder / f"images{kind}").is_file():
        return read_colmap_model(folder)
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        for part in _PARTS:
            if (folder / f"{part}{kind}").is_file():
                shutil.copyfile(folder / f"{part}{kind}", copy / f"{part}{kind}")
        (copy / f"points3D{kind}").write_bytes(b"" if kind == ".txt" else bytes(8))
        try:
            return read_colmap_model(copy)
        except DataError as error:
            raise DataError(str(error).replace(name, str(folder))) from None


_MAX_PARAMS = 64  # most parameters of a camera model


class _ColmapRecordReader:
    """Sequential reader of a binary file; reading past the end of the file raises DataError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
        self.at = 0

    def skip(self, size: int) -> int:
        """Advance the read position by ``size`` bytes; return the position before, in bytes from the file's start."""
        start, self.at = self.at, self.at + size
        if size < 0 or self.at > len(self.data):
            found = f"a record ends at byte {self.at}, but the file ends at byte {len(self.data)}"
            raise DataError(f"{self.path}: truncated or corrupt: {found}")
        return start

    def number(self, kind: str) -> int:
        value: int = struct.unpack_from("<" + kind, self.data, self.skip(struct.calcsize(kind)))[0]
        return value

    def name(self) -> None:
        end = self.data.find(b"\0", self.at)
        self.skip((end if end >= 0 else len(self.data)) + 1 - self.at)


def check_binary_colmap_model(folder: Path, parameter_count: Callable[[int], int]) -> None:
    """Check all ``.bin`` files of a model record by record; raise DataError for a damaged file.

    ``parameter_count`` is a function that returns the number of lens parameters of a camera model, given COLMAP's
    number for this camera model; -1 stands for an unknown model.
    """
    records = (lambda file: _skip_camera(file, parameter_count), _skip_image, _skip_point, _skip_rig, _skip_frame)
    for part, skip_record in zip(_PARTS, records, strict=True):
        path = folder / f"{part}.bin"
        if part in ("rigs", "frames") and not path.is_file():
            continue
        file = _ColmapRecordReader(path)
        for _ in range(file.number("Q")):
            skip_record(file)
        if file.at != len(file.data):
            found = f"records end at byte {file.at}, but the file ends at byte {len(file.data)}"
            raise DataError(f"{file.path}: corrupt: {found}")


def _skip_camera(file: _ColmapRecordReader, parameter_count: Callable[[int], int]) -> None:
    file.skip(4)
    model = file.number("i")
    count = parameter_count(model)
    if not 0 <= count <= _MAX_PARAMS:
        raise DataError(f"{file.path}: camera model number {model} is unknown; expected one of COLMAP's models")
    file.skip(16 + 8 * count)


def _skip_image(file: _ColmapRecordReader) -> None:
    file.skip(4 + 7 * 8 + 4)  # id, pose, camera
    file.name()
    file.skip(24 * file.number("Q"))


def _skip_point(file: _ColmapRecordReader) -> None:
    file.skip(8 + 3 * 8 + 3 + 8)  # id, position, colour, error
    file.skip(8 * file.number("Q"))


def _skip_rig(file: _ColmapRecordReader) -> None:
    file.skip(4)
    for sensor in range(file.number("I")):
        file.skip(8)  # kind and number
        if sensor and file.number("B"):  # the first is the reference and has no pose
            file.skip(7 * 8)


def _skip_frame(file: _ColmapRecordReader) -> None:
    file.skip(4 + 4 + 7 * 8)  # id, rig, pose
    file.skip(16 * file.number("I"))

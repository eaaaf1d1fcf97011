"""Cameras from files, whose format is told by what is in them: JSON, USD, or a model of COLMAP."""

from __future__ import annotations

from pathlib import Path

from neuprim.core.cameras.colmap import is_model, posed_cameras
from neuprim.core.cameras.json_files import read_json_cameras
from neuprim.core.cameras.pinhole import Camera
from neuprim.core.cameras.usd import is_usd, read_usd_cameras
from neuprim.core.cameras.views import MOST, CameraViews
from neuprim.core.errors import DataError

__all__ = ["CameraViews", "read_camera_file", "read_cameras"]


def read_camera_file(path: Path, size: tuple[int, int] | None = None) -> CameraViews:
    """The cameras of a file, or of a folder.

    ===========================================================
    ================================================================
    JSON with ``frames``                                         :mod:`~neuprim.core.cameras.json_files`
    JSON with ``camera_path``                                    the same; nerfstudio's viewer
    .usd, .usda, .usdc, .usdz; ``FILE#/PRIM`` of several cameras :mod:`~neuprim.core.cameras.usd`
    a folder with ``cameras`` and ``images``, .txt or .bin       :mod:`~neuprim.core.cameras.colmap`; also one of these
    files, or a project ===========================================================
    ================================================================

    Args:
        size: (width, height) where the file names none.

    Raises:
        DataError: names the file and the field that is missing or wrong.
        BackendUnavailable: the package that reads the format is missing.
    """
    path, prim = split_prim(path)
    model = is_model(path)
    if model is not None:
        named, notes = posed_cameras(model)
        if len(named) > MOST:
            raise DataError(f"{path}: {len(named)} cameras; expected at most {MOST}")
        return CameraViews(tuple(named), notes=tuple(notes))
    if path.is_dir():
        raise DataError(
            f"{path}: is a folder without cameras.txt or cameras.bin; expected a COLMAP model, or a file of cameras"
        )
    if is_usd(path):
        return read_usd_cameras(path, prim, size)
    return read_json_cameras(path, size)


def split_prim(path: Path) -> tuple[Path, str]:
    """``FILE#/World/Camera`` as a file and what stands after it; a file of that very name comes first."""
    text, hash_, prim = str(path).partition("#")
    return (Path(text), prim) if hash_ and not path.exists() else (path, "")


def read_cameras(path: Path, size: tuple[int, int] | None = None) -> list[tuple[str, Camera]]:
    """Names and cameras of :func:`read_camera_file`."""
    return list(read_camera_file(path, size).named)

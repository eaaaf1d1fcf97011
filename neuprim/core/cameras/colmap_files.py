"""Complete-file checks of COLMAP's binary models.

COLMAP's reader takes what a truncated file happens to hold, and a damaged count can keep it busy for hours. Walking the
records first costs milliseconds and finds both.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from neuprim.core.errors import DataError

__all__ = ["check_binary_model"]

_MAX_PARAMS = 64


class _Bytes:
    """A read position in one file; running past the end is the error that names it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
        self.at = 0

    def skip(self, size: int) -> int:
        """The position before moving on by ``size`` bytes."""
        start, self.at = self.at, self.at + size
        if size < 0 or self.at > len(self.data):
            raise DataError(
                f"{self.path}: truncated or corrupt: a record ends at byte {self.at}, the file at {len(self.data)}"
            )
        return start

    def number(self, kind: str) -> int:
        value: int = struct.unpack_from("<" + kind, self.data, self.skip(struct.calcsize(kind)))[0]
        return value

    def name(self) -> None:
        end = self.data.find(b"\0", self.at)
        self.skip((end if end >= 0 else len(self.data)) + 1 - self.at)


def check_binary_model(folder: Path, parameter_count: Callable[[int], int]) -> None:
    """Check all ``.bin`` files of the model in ``folder`` from first to last record.

    Models of COLMAP before 3.12 have no ``rigs.bin`` and ``frames.bin``.

    Args:
        parameter_count: parameters of a COLMAP camera model by its number; -1 for an unknown one.

    Raises:
        DataError: a file is unreadable, truncated, longer than its records, or names an unknown camera model.
    """
    for name, record in (
        ("cameras.bin", lambda f: _camera(f, parameter_count)),
        ("images.bin", _image),
        ("points3D.bin", _point),
        ("rigs.bin", _rig),
        ("frames.bin", _frame),
    ):
        if record in (_rig, _frame) and not (folder / name).is_file():
            continue
        file = _Bytes(folder / name)
        for _ in range(file.number("Q")):
            record(file)
        if file.at != len(file.data):
            raise DataError(f"{file.path}: corrupt: its records end at byte {file.at}, the file at {len(file.data)}")


def _camera(file: _Bytes, parameter_count: Callable[[int], int]) -> None:
    file.skip(4)
    model = file.number("i")
    count = parameter_count(model)
    if not 0 <= count <= _MAX_PARAMS:
        raise DataError(f"{file.path}: camera model number {model} is unknown; expected one of COLMAP's models")
    file.skip(16 + 8 * count)


def _image(file: _Bytes) -> None:
    file.skip(4 + 7 * 8 + 4)  # id, pose, camera
    file.name()
    file.skip(24 * file.number("Q"))


def _point(file: _Bytes) -> None:
    file.skip(8 + 3 * 8 + 3 + 8)  # id, position, colour, error
    file.skip(8 * file.number("Q"))


def _rig(file: _Bytes) -> None:
    file.skip(4)
    for sensor in range(file.number("I")):
        file.skip(8)  # kind and number
        if sensor and file.number("B"):  # the first is the reference and has no pose
            file.skip(7 * 8)


def _frame(file: _Bytes) -> None:
    file.skip(4 + 4 + 7 * 8)  # id, rig, pose
    file.skip(16 * file.number("I"))

"""Settings of the loaders of posed images: what all have in common, declared once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from neuprim.core.checked import Range, text, verify
from neuprim.core.errors import DataError

__all__ = ["Background", "EveryNth", "FolderSettings", "HoldOut", "SplitName", "data_folder"]

Background = Literal["auto", "white", "black", "random"]

EveryNth = Annotated[int, Range(at_least=2)]
"""Every n-th image is held out."""

HoldOut = Annotated[int, Range(at_least=2, also=(0,))]
"""The same, or 0 where a split of its own is there to test on."""

SplitName = Annotated[str, text("the name in transforms_NAME.json")]


@dataclass(frozen=True)
class FolderSettings:
    """What every loader of a folder with posed images is told; a loader derives a class with its own settings beside
    these.

    Attributes:
        path: the data set's folder, ``~`` allowed.
        background: "auto" (white for data with alpha, else black), "white", "black", or "random" (training composites
        random colours,
            evaluation white).
        downsample: whole factor, area filter on premultiplied values.
        preload: decode all images at once, so that damaged files are found before training.
        strict: refuse a damaged view; otherwise it is left out with a warning.
    """

    path: Annotated[Path, text("the data set's folder")]
    background: Background = "auto"
    downsample: Annotated[int, Range(at_least=1)] = 1
    preload: bool = True
    strict: bool = False

    def __post_init__(self) -> None:
        verify(self, "scene")


def data_folder(path: str | Path) -> Path:
    """The existing folder of the ``path`` setting, ``~`` expanded.

    Raises:
        DataError: there is no such folder.
    """
    try:
        folder = Path(path).expanduser()
        usable = folder.is_dir()
    except (OSError, RuntimeError) as error:  # a name that is too long, a home folder that nobody has
        raise DataError(f"{path}: {error}; expected the data set's folder (scene.path)") from None
    if not usable:
        found = "is a file" if folder.exists() else "does not exist"
        raise DataError(f"{folder}: {found}; expected the data set's folder (scene.path)")
    return folder

"""Files that keep the traceback of a plugin's crash, so that the user reads one line: see
:mod:`neuprim.plugins.blame`."""

from __future__ import annotations

import re
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

from neuprim.version import __version__

__all__ = ["written"]


def written(error: BaseException, who: str, name: str, folders: Sequence[Path]) -> Path | None:
    """The file with the traceback, in the first of the folders that can be written, else with the temporary files; None
    if nowhere.

    Args:
        who: what it says first.
        name: its own begins so.
        folders: each is passed over while the directory around it holds nothing but hidden files, as the lock of the
        run that works there,
            because a run refuses to write into one that does.
    """
    text = (
        f"{who}, neuprim {__version__}, Python {sys.version.split()[0]}\n\n{''.join(traceback.format_exception(error))}"
    )
    stem = f"{re.sub(r'[^A-Za-z0-9_-]+', '_', name).strip('_')}-{time.strftime('%Y%m%d-%H%M%S')}"
    begun = [folder for folder in folders if _begun(folder.parent)]
    for folder in (*begun, Path(tempfile.gettempdir())):
        for number in range(1, 100):  # several in one second
            path = folder / (f"{stem}.txt" if number == 1 else f"{stem}-{number}.txt")
            try:
                folder.mkdir(parents=True, exist_ok=True)
                with open(path, "x", encoding="utf-8", newline="\n") as file:
                    file.write(text)
                return path
            except FileExistsError:
                if not folder.is_dir():
                    break
            except OSError:
                break
    return None


def _begun(directory: Path) -> bool:
    return directory.is_dir() and any(not path.name.startswith(".") for path in directory.iterdir())

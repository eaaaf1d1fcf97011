"""Files that keep the traceback of a plugin's crash, so that the user reads one line."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from pathlib import Path

__all__ = ["written"]


def written(text: str, name: str, folders: Sequence[Path]) -> Path | None:
    """Where the text was written; None if nowhere."""
    stem = f"{re.sub(r'[^A-Za-z0-9_-]+', '_', name).strip('_')}-{time.strftime('%Y%m%d-%H%M%S')}"
    for folder in folders:
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

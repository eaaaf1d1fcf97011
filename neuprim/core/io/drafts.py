"""Files that somebody else's code writes: first in a private folder, and in their place only when all is done and
nothing is in the way."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neuprim.core.errors import ConfigError, NeuprimError

__all__ = ["Draft", "drafted", "refuse_taken"]


def refuse_taken(final: Path, overwrite: bool) -> None:
    """Raises ConfigError if a file or a folder that holds something is at ``final`` and may not be replaced."""
    if overwrite or not os.path.lexists(final):
        return
    if not final.is_dir():
        raise ConfigError(f"{final}: exists; --force replaces it, --out PATH writes elsewhere")
    if any(final.iterdir()):
        raise ConfigError(
            f"{final}: exists and is not empty; --force replaces files of the same name, --out PATH writes elsewhere"
        )


class Draft:
    """Where to write what shall become ``final``.

    Attributes:
        out: a path of the same name that does not exist yet, alone in a folder of its own on the same file system.
    """

    def __init__(self, folder: Path, final: Path, overwrite: bool) -> None:
        self._folder, self._final, self._overwrite = folder, final, overwrite
        self.out = folder / (final.name if final.name not in ("", "..") else "out")

    def place(self, path: Path) -> Path | None:
        """Where a file of the draft will be; None for a file that is not in the draft."""
        try:
            parts = path.resolve().relative_to(self._folder.resolve()).parts
        except ValueError:
            return None
        if not parts:
            return None
        return self._final.joinpath(*parts[1:]) if parts[0] == self.out.name else self._final.parent.joinpath(*parts)

    def words(self, text: str) -> str:
        """A text with the final paths in place of the draft's."""
        return text.replace(str(self.out), str(self._final)).replace(str(self._folder), str(self._final.parent))

    def publish(self) -> None:
        """Moves everything to its place, file by file, into folders that are there already.

        Raises:
            ConfigError: something is in the way; then nothing is moved.
        """
        moves: list[tuple[Path, Path]] = []
        for entry in sorted(self._folder.iterdir()):
            target = self.place(entry)
            assert target is not None
            inside = entry.is_dir() and target.is_dir()
            parts = [p for p in sorted(entry.rglob("*")) if not p.is_dir()] if inside else [entry]
            moves += [(part, target / part.relative_to(entry)) for part in parts]
        for source, target in moves:
            refuse_taken(target, self._overwrite)
            if os.path.lexists(target) and source.is_dir() != target.is_dir():
                found, wanted = ("folder", "file") if target.is_dir() else ("file", "folder")
                raise ConfigError(f"{target}: is a {found}; expected a {wanted}, or nothing")
        for source, target in moves:
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, target)


@contextmanager
def drafted(final: Path, overwrite: bool) -> Iterator[Draft]:
    """A draft that is gone after the block, published or not; what errors say about its paths they say about the final
    ones."""
    there = final if final.is_dir() else next(p for p in (*final.parents, Path(".")) if p.exists())
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".neuprim.{os.getpid()}.", dir=there))
    except OSError as error:
        error.filename = str(final)  # rather than a name nobody knows
        raise
    draft = Draft(folder, final, overwrite)
    try:
        yield draft
    except NeuprimError as error:
        error.args = tuple(draft.words(part) if isinstance(part, str) else part for part in error.args)
        raise
    except OSError as error:
        if isinstance(error.filename, str | Path):
            error.filename = draft.words(str(error.filename))
        raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)

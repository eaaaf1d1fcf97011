"""``neuprim new-task``: a small package with a working task, to change into one's own."""

from __future__ import annotations

import keyword
import re
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from string import Template

from neuprim.core.errors import ConfigError
from neuprim.core.io.files import publish_folder
from neuprim.plugins.registry import list_tasks
from neuprim.version import __version__

__all__ = ["new_task"]

_SUFFIX = ".in"


def new_task(name: str, out: Path | None = None) -> list[str]:
    """Write a package with the task ``name`` and return the lines that say what to do next.

    Args:
        out: the folder to make; None is ``neuprim-NAME`` in the working directory.

    Raises:
        ConfigError: the name cannot be a task's or is taken, or the folder exists; nothing was written.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", name) or keyword.iskeyword(name):
        raise ConfigError(
            f"new-task {name!r}: expected a name of lower-case letters, digits and _ that starts with a letter"
        )
    for info in list_tasks():
        if info.name == name:
            raise ConfigError(f"new-task {name}: {info.origin} already has a task of this name; choose another")
    words = {
        "name": name,
        "package": f"neuprim_{name}",
        "distribution": f"neuprim-{name.replace('_', '-').strip('-')}",
        "version": __version__,
    }
    folder = Path(words["distribution"]) if out is None else out
    place = folder if folder.is_absolute() else f"./{folder}"  # pip takes a bare name for a package of the index
    if folder.exists() or folder.is_symlink():
        raise ConfigError(f"{folder}: exists; expected a folder to make (--out DIR)")

    def write(draft: Path) -> None:
        _write(resources.files("neuprim.plugins") / "template", draft, words)

    publish_folder(folder, write, lambda path: path.exists())
    return [
        f"wrote {folder}: a task {name!r} that works; change {words['package']}/fields.py and scene.py into yours",
        "next:",
        f"  pip install -e '{place}[test]'",
        f"  neuprim run task={name}",
        f"  pytest {folder}",
        "guide: docs/plugins.md",
    ]


def _write(source: Traversable, target: Path, words: dict[str, str]) -> None:
    for entry in source.iterdir():
        name = entry.name.replace("PACKAGE", words["package"]).replace("NAME", words["name"])
        if entry.is_dir():
            (target / name).mkdir()
            _write(entry, target / name, words)
        elif name.endswith(_SUFFIX):
            text = Template(entry.read_text(encoding="utf-8")).substitute(words)
            (target / name.removesuffix(_SUFFIX)).write_text(text, encoding="utf-8", newline="\n")

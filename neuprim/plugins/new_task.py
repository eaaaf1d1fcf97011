"""``neuprim new-task``: write a small package with a working task, as a starting point for a plugin."""

from __future__ import annotations

import keyword
import re
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from string import Template

from neuprim.core.errors import ConfigError
from neuprim.core.io.files import publish_folder
from neuprim.plugins.registry import TASKS
from neuprim.version import __version__

_TEMPLATE_SUFFIX = ".in"


def write_plugin_package(name: str, out: Path | None = None) -> list[str]:
    """Write a Python package with the task ``name``; return lines that tell the user what to do next.

    Args:
        out: the folder to create; None for ``neuprim-NAME`` in the working directory.

    Raises:
        ConfigError: the name is not valid for a task, an installed task has the name, or the folder exists. Nothing
            is written then.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", name) or keyword.iskeyword(name):
        raise ConfigError(
            f"new-task {name!r}: expected a name of lower-case letters, digits and _ that starts with a letter"
        )
    for info in TASKS.list_plugins():
        if info.name == name:
            raise ConfigError(f"new-task {name}: {info.origin} already has a task of this name; choose another")
    variables = {
        "name": name,
        "package": f"neuprim_{name}",
        "distribution": f"neuprim-{name.replace('_', '-').strip('-')}",
        "version": __version__,
    }
    folder = Path(variables["distribution"]) if out is None else out
    if folder.exists() or folder.is_symlink():
        raise ConfigError(f"{folder}: exists already; choose a new folder with --out DIR")

    template = resources.files("neuprim.plugins") / "template"
    publish_folder(folder, lambda draft: _write_template(template, draft, variables), lambda path: path.exists())
    place = folder if folder.is_absolute() else f"./{folder}"  # pip takes a bare name for a package of the index
    return [
        f"wrote {folder}: a task {name!r} that works; change {variables['package']}/fields.py and scene.py into yours",
        "next:",
        f"  pip install -e '{place}[test]'",
        f"  neuprim run task={name}",
        f"  pytest {folder}",
        "guide: docs/plugins.md",
    ]


def _write_template(source: Traversable, target: Path, variables: dict[str, str]) -> None:
    for entry in source.iterdir():
        name = entry.name.replace("PACKAGE", variables["package"]).replace("NAME", variables["name"])
        if entry.is_dir():
            (target / name).mkdir()
            _write_template(entry, target / name, variables)
        elif name.endswith(_TEMPLATE_SUFFIX):
            text = Template(entry.read_text(encoding="utf-8")).substitute(variables)
            (target / name.removesuffix(_TEMPLATE_SUFFIX)).write_text(text, encoding="utf-8", newline="\n")

"""The package ``neuprim-spectral`` beside this file: somebody else's task of five bands, installed without pip, whole
or with other lines."""

from __future__ import annotations

import importlib
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

from neuprim.config import compose
from neuprim.runs.fit import Events, ignore_run_event
from neuprim.runs.run import run
from tests.plugins.fakes import install_groups

NAMES = ("450nm", "550nm", "650nm", "750nm", "850nm")
PACKAGE = Path(__file__).parent / "neuprim-spectral"
SMALL = (
    "scene.size=24",
    "scene.train_views=8",
    "scene.test_views=2",
    "model.primitives=60",
    "model.density.coarse=1",
    "model.density.fine=1",
    "train.iterations=60",
    "train.rates.means=1.6e-3",
)


def forget() -> None:
    """The package that was imported, so that another one of its name can be."""
    for name in [n for n in sys.modules if n.partition(".")[0] == "neuprim_spectral"]:
        del sys.modules[name]
    importlib.invalidate_caches()


def install_spectral(site: Path, edits: Mapping[str, tuple[str, str]] | None = None, **changes: str) -> Path:
    """The package in a folder on ``sys.path``; returns the folder of its modules.

    Args:
        edits: module -> (text, another in its place).
        changes: replace lines of the TaskSpec, e.g. ``display="None"``.
    """
    forget()
    source = {
        str(p.relative_to(PACKAGE)): p.read_text() for p in sorted((PACKAGE / "neuprim_spectral").rglob("*.[py][ya]*"))
    }
    for module, (old, new) in (edits or {}).items():
        text = source[f"neuprim_spectral/{module}.py"]
        assert old in text, f"{module}.py has no {old!r}"
        source[f"neuprim_spectral/{module}.py"] = text.replace(old, new)
    head, start, body = source["neuprim_spectral/__init__.py"].partition("\nTASK = ")
    for name, value in changes.items():
        line = next(line for line in body.splitlines() if line.startswith(f"    {name}="))
        body = body.replace(line, f"    {name}={value},")
    source["neuprim_spectral/__init__.py"] = head + start + body
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    install_groups(site, project["name"], project["entry-points"], source, project["version"])
    importlib.invalidate_caches()
    return site / "neuprim_spectral"


def fit(out: Path, *words: str, events: Events = ignore_run_event) -> Path:
    """A short run of the task."""
    return run(compose(["task=spectral", f"output_dir='{out}'", *SMALL, *words]), events)

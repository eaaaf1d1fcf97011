"""A task, an exporter and an inspector of packages that know neuprim by its documentation alone."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.plugins.registry import EXPORTERS, INSPECTORS, TASKS, PluginGroup
from tests.plugins import marked
from tests.plugins.fakes import install, site
from tests.plugins.spectral import install_spectral

__all__ = ["add", "run_dir", "site"]

EXPORTER = '''
import json

from neuprim.core.extensions import Exporter, ExportReport


def write(job):
    """It calls no helper at all."""
    path = job.out or job.run.directory / "centres.json"
    path.write_text(json.dumps(job.run.model.params["means"].tolist()))
    return ExportReport((path,), False)


PLUGIN = Exporter(api=1, name="centres", summary="centres as JSON", write=write)
'''

INSPECTOR = """
from neuprim.core.extensions import Inspector
from neuprim.inspect.layers import Points

PLUGIN = Inspector(api=1, name="crumbs", summary="points", layers=lambda frame: [Points(frame.box)])
"""


def add(site: Path, kind: str, source: str) -> None:
    """The exporter ``centres`` of the distribution strange-exporter 0.3, or the inspector ``crumbs`` of
    strange-inspector."""
    group: PluginGroup[Any]
    group, name = (EXPORTERS, "centres") if kind == "exporter" else (INSPECTORS, "crumbs")
    entries, files = {name: f"strange_{kind}:PLUGIN"}, {f"strange_{kind}.py": source}
    install(site, f"strange-{kind}", entries, files, group=group.entry_points)
    importlib.invalidate_caches()
    sys.modules.pop(f"strange_{kind}", None)


def spectral(site: Path, strict: bool = False) -> Path:
    """The task ``spectral``, which depends on a ``wavelength_shift``, and a run of it; ``strict`` as its condition
    is."""
    install_spectral(site, {"bands": ("strict=True", f"strict={strict}")})
    fields = TASKS.load("spectral").fields
    assert fields is not None
    colours = torch.cat([marked.COLOURS, marked.COLOURS[:, :2]], 1)
    context = InitContext(marked.PLACES, marked.RADII, colours, torch.Generator().manual_seed(3))
    model = Primitives.initialise(fields["TwoScales"](), fields["ShiftedSpectrum"](), context)  # type: ignore[arg-type]
    words = ["task=spectral", "scene.size=16", "scene.train_views=4", "scene.test_views=2"]
    return marked.write_run(site.parent / "run", model, words, background=[0.0] * 5, color_space="linear")


@pytest.fixture
def run_dir(site: Path) -> Path:
    """A run of the task ``spectral``."""
    return spectral(site)

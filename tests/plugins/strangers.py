"""A task, an exporter and an inspector of packages that know neuprim by its documentation alone."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
import torch

from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.plugins.new_task import new_task
from neuprim.plugins.registry import EXPORTERS, INSPECTORS, TASKS, Group
from tests.plugins import marked
from tests.plugins.fakes import install, site

__all__ = ["add", "run_dir", "site"]

TASK = """
from dataclasses import replace

import torch

from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import ColourField, ConditionSpec, Constant
from neuprim.core.model.schema import ParameterSpec
from neuprim_spectral import TASK as PLAIN
from neuprim_spectral.fields import WaveDensity


class Shifted(ColourField):
    channels = 3

    def settings(self):
        return {}

    def parameters(self):
        return [ParameterSpec("logit", (3,), 5e-2, lambda c: c.colors.logit(eps=0.02), group="colour")]

    def lower(self, params, geometry, camera, conditions):
        return Constant(conditions["wavelength_shift"].to(params["logit"]) * params["logit"].sigmoid())


def parse(text):
    try:
        return [torch.tensor(float(text))]
    except ValueError:
        raise ConfigError(f"--wavelength-shift {text}: expected a number from 0 to 1") from None


SHIFT = ConditionSpec("wavelength_shift", (), "of the spectrum", (0.0, 1.0), parse, strict=STRICT)
TASK = replace(
    PLAIN,
    conditions=(SHIFT,),
    build=lambda model, dataset: (WaveDensity(), Shifted()),
    fields={"WaveDensity": WaveDensity, "Shifted": Shifted},
)
"""

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

PLUGIN = Inspector(api=1, name="crumbs", summary="points", add=lambda plotter, frame: plotter.add_points(frame.box))
"""


def add(site: Path, kind: str, source: str) -> None:
    """The exporter ``centres`` of the distribution strange-exporter 0.3, or the inspector ``crumbs`` of strange-inspector."""
    groups: dict[str, tuple[Group, str]] = {"exporter": (EXPORTERS, "centres"), "inspector": (INSPECTORS, "crumbs")}  # type: ignore[type-arg]
    group, name = groups[kind]
    install(site, f"strange-{kind}", {name: f"strange_{kind}:PLUGIN"}, {f"strange_{kind}.py": source}, group=group.entry_points)
    importlib.invalidate_caches()
    sys.modules.pop(f"strange_{kind}", None)


def spectral(site: Path, strict: bool = False) -> Path:
    """The task ``spectral``, which depends on a ``wavelength_shift``, made of what ``neuprim new-task`` writes, and a run of it."""
    made = site.parent / "neuprim-spectral"
    new_task("spectral", made)
    (made / "neuprim_spectral").rename(site / "neuprim_spectral")
    install(
        site,
        "neuprim-spectral",
        {"spectral": "shifted:TASK"},
        {"shifted.py": TASK.replace("STRICT", str(strict))},
        group=TASKS.entry_points,
    )
    importlib.invalidate_caches()
    fields = TASKS.load("spectral").fields
    assert fields is not None
    generator = torch.Generator().manual_seed(3)
    context = InitContext(marked.PLACES, marked.RADII, marked.COLOURS, generator)
    model = Primitives.initialise(fields["WaveDensity"](), fields["Shifted"](), context)  # type: ignore[arg-type]
    words = ["task=spectral", "scene.size=16", "scene.train_views=4", "scene.test_views=2"]
    return marked.write_run(site.parent / "run", model, words)


@pytest.fixture
def run_dir(site: Path) -> Path:
    """A run of the task ``spectral``."""
    return spectral(site)

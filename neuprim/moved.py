"""Modules under the names they had before; imported under one, the module of today answers, with a DeprecationWarning.

Only names that the documentation has given are here. The table is all that is needed: no file stands where a module
used to be.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

__all__ = ["MOVED", "install"]

MOVED = {
    "neuprim.core.camera_file": "neuprim.core.cameras.camera_files",
    "neuprim.core.choices": "neuprim.core.checked",
    "neuprim.core.cosine": "neuprim.core.model.densities.cosine",
    "neuprim.core.datasets": "neuprim.core.data",
    "neuprim.core.datasets.common": "neuprim.core.data.posed_images",
    "neuprim.core.datasets.initial": "neuprim.core.data.initial",
    "neuprim.core.datasets.settings": "neuprim.core.data.posed_images",
    "neuprim.core.datasets.transforms": "neuprim.core.data.transforms_json",
    "neuprim.core.datasets.views": "neuprim.core.data.image_views",
    "neuprim.core.density_grid": "neuprim.core.volumes.grid",
    "neuprim.core.density_truth": "neuprim.core.volumes.truth",
    "neuprim.core.fields": "neuprim.core.model.fields",
    "neuprim.core.files": "neuprim.core.io.files",
    "neuprim.core.film": "neuprim.core.io.animation",
    "neuprim.core.flip": "neuprim.core.metrics.flip",
    "neuprim.core.gaussian": "neuprim.core.model.densities.gaussian",
    "neuprim.core.geometry": "neuprim.core.model.geometry",
    "neuprim.core.images": "neuprim.core.io.images",
    "neuprim.core.primitives": "neuprim.core.model.primitives",
    "neuprim.core.ray_cameras": "neuprim.core.cameras.projections",
    "neuprim.core.render.settings": "neuprim.core.settings",
    "neuprim.core.schema": "neuprim.core.model.schema",
    "neuprim.core.sh": "neuprim.core.model.colours.sh",
    "neuprim.core.vdb": "neuprim.core.io.vdb",
    "neuprim.core.volume_source": "neuprim.core.volumes.source",
    "neuprim.evaluate": "neuprim.runs",
    "neuprim.inspecting": "neuprim.runs.inspect",
    "neuprim.measure": "neuprim.runs.measure",
    "neuprim.new_task": "neuprim.plugins.new_task",
    "neuprim.plugins.conformance": "neuprim.conformance",
    "neuprim.run": "neuprim.runs.run",
}
"""Old name -> name of today."""


class _Finder(MetaPathFinder, Loader):
    """Asked last, so that a module which is there always wins."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in MOVED:
            return None
        return ModuleSpec(fullname, self, is_package=any(name.startswith(f"{fullname}.") for name in MOVED))

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        warnings.warn(f"{name} is now {MOVED[name]}", DeprecationWarning, stacklevel=2)
        today = importlib.import_module(MOVED[name])
        module.__doc__ = today.__doc__
        module.__all__ = getattr(today, "__all__", [])  # type: ignore[attr-defined]

        def attribute(wanted: str) -> Any:
            if wanted.startswith("__"):
                raise AttributeError(wanted)
            return getattr(today, wanted)

        module.__getattr__ = attribute  # type: ignore[method-assign]


def install() -> None:
    """Makes the old names importable; once is enough."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder())

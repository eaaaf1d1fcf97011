"""What a plugin can add beside whole tasks: scenes and losses of a task, file formats to export to, ways of looking into a density.

Each is registered under an entry-point group of its own, found and loaded by :mod:`neuprim.plugins.registry`; the built-in ones come
through the same groups as anybody's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neuprim.core.channels import Channels, stored_channels
from neuprim.core.data import Dataset
from neuprim.core.primitives import Primitives
from neuprim.core.render.settings import RenderSettings
from neuprim.core.task import Loss, SceneSpec, TaskSpec
from neuprim.core.volume_source import VolumeSource

__all__ = ["Exporter", "ExportJob", "ExportReport", "Inspector", "LossExtension", "SceneExtension", "StoredModel", "TrainedModel"]


@dataclass(frozen=True)
class TrainedModel:
    """A run's model with what is known about it.

    Attributes:
        directory: of the run.
        header: of ``model.safetensors``: background, colour space, data source, iterations, ...
        scene: settings of the scene it was fitted to.
        settings: how the run renders.
        dataset: loads the scene again; raises :class:`~neuprim.core.errors.DataError` where its files are gone.
        volume: the voxel files of the scene, without drawing anything; None for scenes that have none. Raises as ``dataset``.
    """

    directory: Path
    task: TaskSpec
    model: Primitives
    header: Mapping[str, Any]
    scene: Mapping[str, Any]
    settings: RenderSettings
    dataset: Callable[[], Dataset]
    volume: Callable[[], VolumeSource | None] = lambda: None

    @property
    def channels(self) -> Channels:
        """What its colours are called, and what they look like.

        Raises:
            CheckpointError: the header names others than the model has.
        """
        return stored_channels(self.directory, self.header, self.task, self.model.colour.channels)


@dataclass(frozen=True)
class ExportJob:
    """One call of ``neuprim export``.

    Attributes:
        out: file or folder the user named, or None for the exporter's default name inside the run directory.
        options: ``KEY=VALUE`` words of the user, numbers and booleans as such; only names that the exporter has.
        conditions: condition name -> text, as ``render`` takes it; empty unless the exporter takes conditions.
        overwrite: whether files that exist may be replaced.
        progress: called with (text, fraction 0..1).
    """

    run: TrainedModel
    out: Path | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    conditions: Mapping[str, str] = field(default_factory=dict)
    overwrite: bool = False
    progress: Callable[[str, float], None] = lambda text, fraction: None


@dataclass(frozen=True)
class ExportReport:
    """What was written, and what it lost.

    Attributes:
        files: in order.
        lossless: whether importing restores the model exactly.
        errors: named numbers of the export against the model, e.g. ``{"psnr": 31.2}``; empty where none is defined.
        notes: one line each, for the user (conventions, frames, what is left out).
    """

    files: tuple[Path, ...]
    lossless: bool
    errors: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class StoredModel:
    """A whole model out of a file.

    Attributes:
        header: as of ``model.safetensors``; unchecked.
        tensors: name -> (N, ...) float32 array; unchecked.
        config: text of ``config.yaml``; unchecked.
    """

    header: Mapping[str, Any]
    tensors: Mapping[str, np.ndarray]
    config: str


@dataclass(frozen=True)
class Exporter:
    """A format of ``neuprim export --format NAME``; group ``neuprim.exporters``.

    Attributes:
        options: option name -> (default, one line of help).
        write: does it, atomically; raises a :class:`~neuprim.core.errors.NeuprimError` for what the format cannot hold.
        conditions: whether it takes values of the task's conditions (``time=0.5``).
        read: for lossless formats, ``neuprim import``: what ``write`` wrote, from an untrusted file; raises
            :class:`~neuprim.core.errors.DataError`. Chosen by the file's suffix, which is then the exporter's name.
    """

    api: int
    name: str
    summary: str
    write: Callable[[ExportJob], ExportReport]
    options: Mapping[str, tuple[Any, str]] = field(default_factory=dict)
    conditions: bool = False
    read: Callable[[Path], StoredModel] | None = None


@dataclass(frozen=True)
class Inspector:
    """A way of showing a density in ``neuprim inspect --show NAME``; group ``neuprim.inspectors``.

    Attributes:
        add: (pyvista plotter, :class:`~neuprim.plugins.inspect.field.FieldFrame`) draws one frame into the plotter; called again with
            the next frame after the plotter's actors of the last one were removed.
        shows: "sigma" for the extinction on the frame's grid, drawn a second time from the ground truth where there is one; "model"
            for the primitives themselves; "primitive" for a single one, with a camera of its own; "both" for what needs the truth.
    """

    api: int
    name: str
    summary: str
    add: Callable[[Any, Any], None]
    shows: Literal["sigma", "model", "primitive", "both"] = "sigma"


@dataclass(frozen=True)
class SceneExtension:
    """A scene for a task of another package; group ``neuprim.scenes``, under the entry-point name ``TASK.SCENE``.

    Attributes:
        task: name of the task.
        config_package: importable package that holds ``scene/TASK/NAME.yaml``.
    """

    api: int
    task: str
    scene: SceneSpec
    config_package: str


@dataclass(frozen=True)
class LossExtension:
    """A training loss for any task, chosen by ``train.loss=NAME``; group ``neuprim.losses``.

    Attributes:
        make: the settings under ``train``, and this loss's options as "options" -> the loss.
        options: name -> (default, one line of help), set as ``task.options.NAME`` while the loss is chosen; as
            :attr:`~neuprim.core.task.TaskSpec.options`.
        uses: the settings of :data:`neuprim.core.uses.OPTIONAL` under ``train`` that ``make`` reads.
    """

    api: int
    name: str
    summary: str
    make: Callable[[Mapping[str, Any]], Loss]
    options: Mapping[str, tuple[Any, str]] = field(default_factory=dict)
    uses: tuple[str, ...] = ()

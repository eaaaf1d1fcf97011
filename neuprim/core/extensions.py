"""Interfaces of plugins other than tasks: scenes and losses, export formats, and ways to show a density.

Each kind has its own entry-point group; :mod:`neuprim.plugins.registry` finds and loads them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels, read_stored_channels
from neuprim.core.conditions import condition_flag, conditions_per_frame
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.model.primitives import Primitives
from neuprim.core.settings import RenderSettings
from neuprim.core.task import Loss, SceneSpec, TaskSpec
from neuprim.core.validation import Option, Range, validate_value
from neuprim.core.volumes.density_truth import DensityGridSource


@dataclass(frozen=True)
class TrainedModel:
    """A run's model and what is known about it.

    Attributes:
        directory: of the run.
        header: of ``model.safetensors``: background, colour space, data source, iterations, ...
        scene: settings of the scene that it was fitted to.
        settings: how the run renders.
        dataset: loads the scene again; raises :class:`~neuprim.core.errors.DataError` if its files are gone.
        volume: opens the voxel files of the scene; None for scenes without. Raises as ``dataset``.
    """

    directory: Path
    task: TaskSpec
    model: Primitives
    header: Mapping[str, Any]
    scene: Mapping[str, Any]
    settings: RenderSettings
    dataset: Callable[[], Dataset]
    volume: Callable[[], DensityGridSource | None] = lambda: None

    @property
    def world(self) -> World:
        """The transform between the scene and the user's files, in whose coordinates everything is exported."""
        return World.of(self.header, str(self.directory))

    @property
    def channels(self) -> Channels:
        """The channels of its colours."""
        return read_stored_channels(self.directory, self.header, self.task, self.model.colour.channels)


@dataclass(frozen=True)
class ExportJob:
    """One call of ``neuprim export``.

    Attributes:
        out: the file to write, or the folder to make; files beside it count, too. It has the final name but lies in a
            private folder. Its content is moved to its place afterwards if nothing is in the way, so an exporter need
            not handle ``--force``, and one that fails leaves nothing behind.
        options: every option of the exporter: the user's value as a number or boolean if it is one, or the default.
        conditions: condition name -> text, already checked; empty unless the exporter takes conditions.
        progress: called with (text, fraction 0..1).
    """

    run: TrainedModel
    out: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    conditions: Mapping[str, str] = field(default_factory=dict)
    progress: Callable[[str, float], None] = lambda text, fraction: None

    def frames(self, several: bool = False, names: Collection[str] | None = None) -> list[dict[str, Tensor]]:
        """Return the task's conditions of each frame that the user named; one frame unless ``several``.

        Args:
            names: of the conditions that what is written depends on; None: all of the task's. Others are refused.
        """
        specs = [spec for spec in self.run.task.conditions if names is None or spec.name in names]
        for name in self.conditions:
            if name not in [spec.name for spec in specs]:
                raise ConfigError(f"{condition_flag(name)}: what is written does not depend on it; expected none")
        return conditions_per_frame(specs, self.conditions, several)

    def number(self, name: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        """Return an option that is a finite number from ``low`` to ``high``, or None; raises ConfigError otherwise."""
        value: float | None = validate_value(self.options[name], Annotated[float, Range(low, high)] | None, name)
        return value

    def count(self, name: str, low: int, high: int) -> int | None:
        """Return an option that is a whole number, as :meth:`number`."""
        value: int | None = validate_value(self.options[name], Annotated[int, Range(low, high)] | None, name)
        return value

    def choice(self, name: str, *offered: str) -> str:
        """Return an option that is one of those offered; raises ConfigError otherwise."""
        return str(validate_value(self.options[name], Literal[offered], name))

    def flag(self, name: str) -> bool:
        """Return an option that is true or false; raises ConfigError otherwise."""
        return bool(validate_value(self.options[name], bool, name))


@dataclass(frozen=True)
class ExportReport:
    """What was written, and what it lost.

    Attributes:
        files: in order; each is :attr:`ExportJob.out`, in it, or beside it.
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
        options: option name -> (default, one line of help); shown by ``neuprim export --format NAME --help``.
        write: writes :attr:`ExportJob.out`; raises a :class:`~neuprim.core.errors.NeuprimError` for what the format
            cannot hold.
        conditions: whether it takes values of the task's conditions (``time=0.5``).
        read: for lossless formats, ``neuprim import``: reads what ``write`` wrote from an untrusted file; raises
            :class:`~neuprim.core.errors.DataError`. It is chosen by the file's suffix, which is the exporter's name.
        default: name of the file or folder in ``RUN_DIR/export``; "" for the exporter's name with the first suffix.
        suffixes: what the name of its one file may end in, as ``(".glb", ".ply")``; other names and folders are
            refused. Empty: it takes any name, also that of a folder.
    """

    api: int
    name: str
    summary: str
    write: Callable[[ExportJob], ExportReport]
    options: Mapping[str, tuple[Any, str]] = field(default_factory=dict)
    conditions: bool = False
    read: Callable[[Path], StoredModel] | None = None
    default: str = ""
    suffixes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inspector:
    """A way of showing a density in ``neuprim inspect --show NAME``; group ``neuprim.inspectors``.

    Attributes:
        layers: a :class:`~neuprim.inspect.field.InspectionFrame` -> a list of layers of :mod:`neuprim.inspect.layers`,
            which a window, a picture, a film and a page draw; called once per frame and panel.
        shows: "sigma" for the extinction on the frame's grid, shown a second time for the ground truth if there is
            one; "model" for the primitives; "primitive" for a single one, with a camera of its own; "both" for what
            needs the ground truth.
    """

    api: int
    name: str
    summary: str
    layers: Callable[[Any], Sequence[Any]]
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
        uses: the settings of :data:`neuprim.core.train.settings.OPTIONAL` under ``train`` that ``make`` reads.
    """

    api: int
    name: str
    summary: str
    make: Callable[[Mapping[str, Any]], Loss]
    options: Mapping[str, Option] = field(default_factory=dict)
    uses: tuple[str, ...] = ()

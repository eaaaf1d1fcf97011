"""Interfaces of plugins other than tasks: scenes and losses, export formats, and ways to show a density.

Each kind of plugin has its own entry-point group; :mod:`neuprim.plugins.registry` finds and loads plugins.
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

__all__ = ["ExportJob", "ExportReport", "Exporter", "Inspector", "StoredModel", "TrainedModel"]
__all__ += ["LossExtension", "SceneExtension"]


@dataclass(frozen=True)
class TrainedModel:
    """The model of a run with its task, scene and settings.

    Attributes:
        header: header of ``model.safetensors``: background, colour space, data source, iterations, ...
        dataset: loads the scene again; raises :class:`~neuprim.core.errors.DataError` if its files are gone.
        volume: opens the voxel files of the scene, or returns None for scenes without voxel files; raises the errors of
            ``dataset``.
    """

    directory: Path  # directory of the run
    task: TaskSpec  # the task of the run
    model: Primitives  # the trained model
    header: Mapping[str, Any]
    scene: Mapping[str, Any]  # settings of the scene
    settings: RenderSettings  # render settings of the run
    dataset: Callable[[], Dataset]
    volume: Callable[[], DensityGridSource | None] = lambda: None

    @property
    def world(self) -> World:
        """Transform between scene and world coordinates; exports are in world coordinates, as the user's files are."""
        return World.of(self.header, str(self.directory))

    @property
    def channels(self) -> Channels:
        """Channels of the model's colours."""
        return read_stored_channels(self.directory, self.header, self.task, self.model.colour.channels)


@dataclass(frozen=True)
class ExportJob:
    """One call of ``neuprim export``.

    Attributes:
        out: path of the file to write or folder to create, inside a temporary folder. If the export succeeds, neuprim
            moves everything in the temporary folder to its destination. So exporters need not handle ``--force`` or
            clean up after a failure.
        options: option name -> the user's value, or else the default. A value that reads as a number or boolean is
            converted.
        conditions: condition name -> text, already checked; empty unless the exporter takes conditions.
        progress: function to call with (text, fraction 0..1).
        frame: conditions of the single frame to write, if neuprim exports a sequence frame by frame. None means that
            ``conditions`` gives the frames.
    """

    run: TrainedModel  # the model to export
    out: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    conditions: Mapping[str, str] = field(default_factory=dict)
    progress: Callable[[str, float], None] = lambda text, fraction: None
    frame: Mapping[str, Tensor] | None = None

    def frames(self, several: bool = False, names: Collection[str] | None = None) -> list[dict[str, Tensor]]:
        """Return the conditions of each frame that the user asked for; one frame unless ``several``.

        Args:
            several: whether more than one frame is allowed.
            names: conditions that the export depends on; None for all conditions of the task. Other conditions are
                refused.
        """
        if self.frame is not None:
            return [dict(self.frame)]
        specs = [spec for spec in self.run.task.conditions if names is None or spec.name in names]
        for name in self.conditions:
            if name not in [spec.name for spec in specs]:
                raise ConfigError(f"{condition_flag(name)}: the export does not depend on this condition; leave it out")
        return conditions_per_frame(specs, self.conditions, several)

    def number(self, name: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        """Return option ``name``, a finite number from ``low`` to ``high`` or None; raise ConfigError otherwise."""
        value: float | None = validate_value(self.options[name], Annotated[float, Range(low, high)] | None, name)
        return value

    def count(self, name: str, low: int, high: int) -> int | None:
        """Return option ``name``, a whole number from ``low`` to ``high`` or None; raise ConfigError otherwise."""
        value: int | None = validate_value(self.options[name], Annotated[int, Range(low, high)] | None, name)
        return value

    def choice(self, name: str, *offered: str) -> str:
        """Return option ``name``, one of the texts ``offered``; raise ConfigError otherwise."""
        return str(validate_value(self.options[name], Literal[offered], name))

    def flag(self, name: str) -> bool:
        """Return option ``name``, true or false; raise ConfigError otherwise."""
        return bool(validate_value(self.options[name], bool, name))


@dataclass(frozen=True)
class ExportReport:
    """Files that an exporter wrote, and what the format lost.

    Attributes:
        files: the files, in order. Each file is :attr:`ExportJob.out` itself, inside this folder, or next to it.
        lossless: whether importing the files restores the model exactly.
        errors: metrics that compare the export with the model, by name: ``{"psnr": 31.2}``; may be empty.
        notes: lines for the user about conventions, frames and what is left out.
    """

    files: tuple[Path, ...]
    lossless: bool
    errors: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class StoredModel:
    """A model as :attr:`Exporter.read` returns it from a file of a lossless format; its values are unchecked."""

    header: Mapping[str, Any]  # header of model.safetensors
    tensors: Mapping[str, np.ndarray]  # name -> (N, ...) float32 array
    config: str  # text of config.yaml


@dataclass(frozen=True)
class Exporter:
    """An export format, ``neuprim export --format NAME``; entry-point group ``neuprim.exporters``.

    Attributes:
        write: function that writes :attr:`ExportJob.out`. It raises a :class:`~neuprim.core.errors.NeuprimError` if the
            format cannot hold the model.
        options: option name -> (default, one line of help); shown by ``neuprim export --format NAME --help``.
        read: for lossless formats, the function with which ``neuprim import`` reads a file that ``write`` wrote. The
            file is untrusted; a damaged file raises :class:`~neuprim.core.errors.DataError`. ``neuprim import`` finds
            the exporter by the file's suffix, which must be the exporter's name.
        default: default name of the file or folder in ``RUN_DIR/export``; "" for the exporter's name with the first
            suffix.
        suffixes: allowed suffixes, if the format is a single file: ``(".glb", ".ply")``; other names and folders are
            refused. If this is empty, the user may give any name of a file or folder.
        sequence: whether neuprim calls ``write`` once per frame if the user asks for several frames. The files
            NAME.0001.ply, ... are then in a folder.
    """

    api: int  # the API_VERSION that the exporter was written for
    name: str  # what the user types after --format
    summary: str  # one line for help texts
    write: Callable[[ExportJob], ExportReport]
    options: Mapping[str, tuple[Any, str]] = field(default_factory=dict)
    conditions: bool = False  # whether the exporter accepts conditions of the task, such as --time 0.5
    read: Callable[[Path], StoredModel] | None = None
    default: str = ""
    suffixes: tuple[str, ...] = ()
    sequence: bool = False


@dataclass(frozen=True)
class Inspector:
    """A way to show a density, ``neuprim inspect --show NAME``; entry-point group ``neuprim.inspectors``.

    Attributes:
        layers: function :class:`~neuprim.inspect.field.InspectionFrame` -> list of layers of
            :mod:`neuprim.inspect.layers`, called once per frame and panel. Windows, pictures, films and web pages draw
            these layers.
        shows: what the inspector shows. "sigma" is the extinction on the frame's grid, with a second panel for the
            ground truth if there is one. "model" is all primitives. "primitive" is a single primitive, with its own
            camera. "both" is the model together with the ground truth, which must exist.
    """

    api: int  # the API_VERSION that the inspector was written for
    name: str  # what the user types after --show
    summary: str  # one line for help texts
    layers: Callable[[Any], Sequence[Any]]
    shows: Literal["sigma", "model", "primitive", "both"] = "sigma"


@dataclass(frozen=True)
class SceneExtension:
    """A scene for a task of another package; entry point ``TASK.SCENE`` of the group ``neuprim.scenes``."""

    api: int  # the API_VERSION that the scene was written for
    task: str  # name of the task
    scene: SceneSpec  # the scene
    config_package: str  # importable package with scene/TASK/NAME.yaml


@dataclass(frozen=True)
class LossExtension:
    """A training loss for any task, ``train.loss=NAME``; entry-point group ``neuprim.losses``.

    Attributes:
        make: function (settings under ``train``, with the options of the loss as "options") -> the loss.
        options: name -> (default, one line of help). Users set an option as ``task.options.NAME``. The rules of
            :attr:`~neuprim.core.task.TaskSpec.options` apply.
        uses: the settings of :data:`neuprim.core.train.settings.OPTIONAL` under ``train`` that ``make`` reads.
    """

    api: int  # the API_VERSION that the loss was written for
    name: str  # what the user types after train.loss=
    summary: str  # one line for neuprim tasks
    make: Callable[[Mapping[str, Any]], Loss]
    options: Mapping[str, Option] = field(default_factory=dict)
    uses: tuple[str, ...] = ()

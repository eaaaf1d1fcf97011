"""What a task hands over: its conditions, fields, scenes, loss and presets. The core runs any of them alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from neuprim.core.data import Clip, Dataset, View
from neuprim.core.data.dataset import GroundTruth, SceneContext
from neuprim.core.environment import Environment, Illumination
from neuprim.core.layers import LayerSpec
from neuprim.core.model.fields import ColourField, ConditionSpec, DensityField, Field
from neuprim.core.model.primitives import Primitives
from neuprim.core.validation import Option
from neuprim.core.volumes.source import VolumeSource

API_VERSION = 1
"""Version of the interfaces in ``neuprim.core``; a plugin names the one it was written for."""


@dataclass(frozen=True)
class Supervision:
    """What a loss may look at beside the two images.

    Attributes:
        view: name, camera and conditions of the frame.
        mask: (H, W) bool of the pixels that count, None for all; where it is False, ``rendered`` already is ``truth``.
        alpha: (H, W) coverage 0..1 of the true image, which lies over this step's background; None for an opaque
        photograph. progress: used fraction of the budget, 0..1.
    """

    view: View
    mask: Tensor | None = None
    alpha: Tensor | None = None
    progress: float = 0.0


Loss = Callable[[Tensor, Tensor, Supervision], tuple[Tensor, dict[str, float]]]
"""(rendered (H, W, C), ground truth (H, W, C), :class:`Supervision`) -> (scalar loss with gradient, named parts for the
log)."""

Display = Callable[[Tensor], Tensor]
"""(H, W, C) colours in the data set's own colour space -> (H, W, 3) sRGB values 0..1, each pixel by itself."""

Illuminate = Callable[[Environment, int, Mapping[str, Any]], Illumination]
"""(light from all around, number of lights that stand for it, the "data" of the model's header: :attr:`TaskSpec.facts`)
-> frames to add up."""


@dataclass(frozen=True)
class Chunk:
    """A part of a scene that is fitted as a run of its own.

    Attributes:
        name: good as a folder's name.
        settings: dotted key -> value of what its run has other than the whole's: ``{"scene.span": "0:20"}``.
        primitives, steps: its shares of the whole's; those of all chunks add up to 1.
    """

    name: str
    settings: Mapping[str, Any]
    primitives: float
    steps: float


@dataclass(frozen=True)
class Chunks:
    """How a scene is fitted in chunks.

    Attributes:
        parts: two or more.
        join: the models of all parts, in their order, on the processor -> one model of the whole scene.
    """

    parts: tuple[Chunk, ...]
    join: Callable[[Sequence[Primitives]], Primitives]


@dataclass(frozen=True)
class SceneSpec:
    """One scene of a task.

    Attributes:
        name: what the user types after ``scene=``.
        summary: one line for ``neuprim tasks``.
        load: (scene settings, context) -> Dataset; raises :class:`~neuprim.core.errors.DataError` for bad input.
        volume: for scenes made of voxel files: (scene settings, context) -> these, without drawing anything.
        truth: for scenes whose images are rendered frame by frame: (scene settings, context, what another process knows
        of them or None) ->
            that work, which ``load`` does where nobody has done it before; see
            :class:`~neuprim.core.data.dataset.GroundTruth`.
        chunks: for scenes that can be fitted in chunks, which their setting ``chunks`` asks for: (the run's
        configuration in the layout of the
            command line's keys, context) -> how, or None where one run is better.
    """

    name: str
    summary: str
    load: Callable[[Mapping[str, Any], SceneContext], Dataset]
    volume: Callable[[Mapping[str, Any], SceneContext], VolumeSource] | None = None
    truth: Callable[[Mapping[str, Any], SceneContext, Mapping[str, Any] | None], GroundTruth] | None = None
    chunks: Callable[[Mapping[str, Any], SceneContext], Chunks | None] | None = None


@dataclass(frozen=True)
class TaskSpec:
    """A task, built in or third party, registered under the entry-point group ``neuprim.tasks``.

    Attributes:
        api: the :data:`API_VERSION` it was written for.
        name: what the user types after ``task=``.
        config_package: importable package holding its Hydra groups ``task/NAME.yaml``, ``scene/NAME/*.yaml`` and
            ``preset/NAME/*.yaml``.
        build: (model settings, dataset) -> the density and colour fields. Of the settings in
        :data:`neuprim.core.used_settings.OPTIONAL` it
            gets those that ``uses`` lists, and the task's options as "options".
        loss: loss settings -> the training loss, which ``train.loss`` may replace. Gets ``train`` and "options", as
        ``build``. check: (what ``build`` gets) raises :class:`~neuprim.core.errors.ConfigError` for choices the task
        does not have, before
            any data is loaded.
        options: name -> (default, one line of help) of the task's own settings, the only ones under ``task.options``;
        values are
            converted to the default's type, or to what stands third: ``Annotated[float, Range(0, 1)]``, ``("soft",
            "hard")`` (:mod:`neuprim.core.validation`). ``task/NAME.yaml`` may say other defaults.
        uses: the shared settings of :data:`neuprim.core.used_settings.OPTIONAL` that ``build`` (``model.…``) and ``loss``
        (``train.…``) read.
            Others are refused when somebody sets them.
        environment: what an image of the light all around means to the task (``neuprim render --environment``); None
        for tasks that
            have no light. Images must be linear in it, and their opacity independent of it.
    """

    api: int
    name: str
    summary: str
    config_package: str
    scenes: tuple[SceneSpec, ...]
    build: Callable[[Mapping[str, Any], Dataset], tuple[DensityField, ColourField]]
    loss: Callable[[Mapping[str, Any]], Loss]
    conditions: tuple[ConditionSpec, ...] = ()
    check: Callable[[Mapping[str, Any]], None] = lambda model: None
    fields: Mapping[str, type[Field]] | None = None
    """Class name -> field class, so that a saved model can be rebuilt from its header."""
    example: Callable[[], Dataset] | None = None
    """A tiny data set, made in memory, that the checks of :mod:`neuprim.conformance` use in place of their own: for
    tasks whose fields ask for something beside posed images and conditions within their ranges. Images of about 10 x 10
    pixels will do."""
    environment: Illuminate | None = None
    channels: tuple[str, ...] = ()
    """What the channels of its images are called, e.g. ``("450nm", "550nm")``, in files and wherever they are listed; a
    data set with another number of them is refused. Empty: R, G, B for three channels, Y for one, else c0, c1, ..."""
    display: Display | None = None
    """What pictures show: (H, W, C) colours in the data set's colour space -> (H, W, 3) sRGB values 0..1. It must take
    each pixel by itself, as it also gets the colours of primitives, as an image one pixel high. None: three channels
    are red, green and blue, one is grey, and of others the first three are shown."""
    layers: tuple[LayerSpec, ...] = ()
    """What ``neuprim render --format exr`` can write of its frames beside beauty, alpha, depth and density: see
    :class:`~neuprim.core.layers.LayerSpec`."""
    options: Mapping[str, Option] = field(default_factory=dict)
    uses: tuple[str, ...] = ()
    mask: Callable[[Dataset, int], Tensor | None] = lambda dataset, index: None
    """(data set, index of a test view) -> (H, W) bool, the part of the view whose error is worth reporting on its own;
    None: no such part."""
    judge: Callable[[Dataset, int, Tensor, Tensor], Mapping[str, float]] = lambda dataset, index, rendered, truth: {}
    """(data set, index of a test view, rendered (H, W, C), truth (H, W, C)) -> further numbers by name, which
    ``metrics.json`` gives per view and as means over the views that have them. Both images are in the data set's colour
    space, over its background. Means are plain, but ``mse_NAME`` becomes ``psnr_pooled_NAME``, the PSNR of the mean
    over views, each of which counts by its ``pixels_NAME`` where it says so; ``pixels_NAME`` becomes a sum."""
    diagnose: Callable[[Dataset, Primitives], Mapping[str, Any]] = lambda dataset, model: {}
    """(data set, model) -> further JSON-able numbers for ``metrics.json``: the model against what is known of the
    scene."""
    clips: Callable[[Dataset], Sequence[Clip]] = lambda dataset: ()
    """Films to make of the test views, or of views kept for films."""
    facts: Callable[[Dataset], Mapping[str, Any]] = lambda dataset: {}
    """JSON-able facts that drawing a model may need when the data are gone; kept in the model's header under "data",
    beside "up" and "center"."""
    orbit: Callable[[Dataset, int], list[View]] = Dataset.orbit
    """(data set, number of frames) -> views circling the scene, with every condition of the task; see
    :meth:`~neuprim.core.data.dataset.Dataset.orbit`, which is taken without one."""

    trade: Callable[[Mapping[str, Any]], Mapping[str, Sequence[Any]]] = lambda model: {}
    """(what ``build`` gets) -> settings of the model that trade quality for speed or size, as the user types them, with
    the values that are worth training: ``{"model.neurons": (0, 2, 4, 8)}``. ``neuprim tradeoff task=NAME`` turns them,
    beside the number of primitives and the length of the training, which every task has. Names begin with ``model.`` or
    ``task.options.``; values are numbers, texts, true or false."""

    def parameter_names(self) -> set[str]:
        """Names of the parameters that the task's fields have at any settings.

        A preset may give rates for all of them, although a model has only one of the densities and one of the colours.
        Fields that cannot be made without settings are left out.
        """
        names = set()
        for cls in (self.fields or {}).values():
            try:
                names |= {spec.name for spec in cls.every_parameter()}
            except TypeError:  # a required setting
                continue
        return names

    def scene(self, name: str) -> SceneSpec:
        """The scene of that name; KeyError if there is none."""
        return {s.name: s for s in self.scenes}[name]

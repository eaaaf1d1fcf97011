"""The interface of a task: its conditions, fields, scenes, loss and presets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from torch import Tensor

from neuprim.core.data import Clip, Dataset, View
from neuprim.core.data.dataset import DatasetImages, SceneContext
from neuprim.core.environment import Environment, Illumination
from neuprim.core.model.fields import ColourField, ConditionSpec, DensityField, Field
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.layer_frame import LayerSpec
from neuprim.core.validation import Option
from neuprim.core.volumes.density_truth import DensityGridSource

__all__ = ["API_VERSION", "Chunk", "Chunks", "Display", "Illuminate", "Loss", "SceneSpec", "Supervision", "TaskSpec"]

API_VERSION = 1
"""Version of the plugin interfaces in ``neuprim.core``; a plugin declares the version that it was written for."""


@dataclass(frozen=True)
class Supervision:
    """Input of a loss besides the rendered and the true image.

    Attributes:
        view: name, camera and conditions of the view.
        mask: (H, W) bool of the pixels that count; None for all. Where the mask is False, the rendered image equals the
            true image.
        alpha: (H, W) opacity 0..1 of the true image before it was composited over the background of this step; None for
            an opaque photograph.
        progress: used fraction of the training budget (steps or seconds), 0..1.
    """

    view: View
    mask: Tensor | None = None
    alpha: Tensor | None = None
    progress: float = 0.0


Loss = Callable[[Tensor, Tensor, Supervision], tuple[Tensor, Mapping[str, float | Tensor]]]
"""Function (rendered (H, W, C), truth (H, W, C), :class:`Supervision`) -> (scalar with gradient, numbers for the log by
name, as floats or tensors with one number).

An attribute ``recordable = True`` of the function allows the trainer to record training steps as CUDA graphs. Such a
function must never wait for a GPU, and must do the same in every step. So it must not read ``Supervision.progress``."""

Display = Callable[[Tensor], Tensor]
"""Function (H, W, C) colours in the data set's colour space -> (H, W, 3) sRGB values 0..1, pixel by pixel."""

Illuminate = Callable[[Environment, int, Mapping[str, Any]], Illumination]
"""Function (environment map, number of lights that approximate the map, :attr:`TaskSpec.facts` of the model) ->
conditions of the frames whose images add up to the lit image."""


@dataclass(frozen=True)
class Chunk:
    """A part of a scene that is trained as a run of its own.

    Attributes:
        settings: dotted key -> value of the settings that differ from the whole run: ``{"scene.span": "0:20"}``.
        primitives: fraction of the primitives of the whole run; the fractions of all chunks add up to 1.
        steps: fraction of the steps of the whole run; the fractions of all chunks add up to 1.
    """

    name: str  # name of the chunk, valid as the name of a folder
    settings: Mapping[str, Any]
    primitives: float
    steps: float


@dataclass(frozen=True)
class Chunks:
    """The parts (chunks) into which a scene is divided, each trained as a run of its own.

    Attributes:
        parts: the chunks, two or more.
        join: function (models of all chunks, in the order of ``parts``, on the CPU) -> one model of the whole scene.
    """

    parts: tuple[Chunk, ...]
    join: Callable[[Sequence[Primitives]], Primitives]


def lazy_function(place: str) -> Callable[..., Any]:
    """Return a wrapper of the function ``"MODULE:NAME"``; MODULE is imported when the wrapper is called."""

    def call(*arguments: Any) -> Any:
        module, name = place.split(":")
        return getattr(import_module(module), name)(*arguments)

    return call


@dataclass(frozen=True)
class SceneSpec:
    """One scene of a task.

    Attributes:
        name: what the user types after ``scene=``.
        summary: one line for ``neuprim tasks``.
        load: function (scene settings, context) -> Dataset; raises :class:`~neuprim.core.errors.DataError` for invalid
            data. The context has the seed, a cache folder and a function that shows the progress.
        volume: for scenes of voxel files: function (scene settings, context) -> the files, without rendering.
        truth: for scenes that render their images frame by frame: function (scene settings, context,
            :attr:`~neuprim.core.data.dataset.DatasetImages.known` of another process or None) -> the images to render.
        chunks: for scenes with a setting ``chunks``: function (configuration of the run by the keys of the command
            line, context) -> the chunks, or None if one run is better.
    """

    name: str
    summary: str
    load: Callable[[Mapping[str, Any], SceneContext], Dataset]
    volume: Callable[[Mapping[str, Any], SceneContext], DensityGridSource] | None = None
    truth: Callable[[Mapping[str, Any], SceneContext, Mapping[str, Any] | None], DatasetImages] | None = None
    chunks: Callable[[Mapping[str, Any], SceneContext], Chunks | None] | None = None


@dataclass(frozen=True)
class TaskSpec:
    """A task, built in or third party, registered under the entry-point group ``neuprim.tasks``.

    Attributes:
        api: the :data:`API_VERSION` that the task was written for.
        name: what the user types after ``task=``.
        config_package: importable package with ``task/NAME.yaml``, ``scene/NAME/*.yaml`` and ``preset/NAME/*.yaml``.
        build: function (model settings, dataset) -> the density field and the colour field. The model settings contain
            the options of the task as "options". Of the settings in :data:`neuprim.core.train.settings.OPTIONAL`, they
            contain only those that ``uses`` lists.
        loss: function (settings under ``train``, with the options of the task as "options") -> the loss. The user can
            choose another loss with ``train.loss``.
        check: function (model settings, as for ``build``) that raises :class:`~neuprim.core.errors.ConfigError` for
            settings that the task does not have; called before any data is loaded.
        conditions: the conditions that the fields depend on, such as the time.
        fields: class name -> field class, so that a saved model can be rebuilt from its header.
        example: function () -> a tiny data set for the tests in :mod:`neuprim.conformance`. Only a task whose fields
            need more than posed images and conditions within their ranges needs this function. Images of about 10 x 10
            pixels are enough.
        environment: function that converts an environment map to conditions, for ``neuprim render --environment``; None
            for tasks without light. Images must be linear in the light, and their opacity must not depend on the light.
        channels: names of the channels of the task's images, e.g. ``("450nm", "550nm")``; data sets with another number
            of channels are refused. Empty: R, G, B for three channels, Y for one, else c0, c1, ...
        display: function (H, W, C) colours in the data set's colour space -> (H, W, 3) sRGB values 0..1, pixel by
            pixel. Without this function, channels named R, G and B are shown as red, green and blue. Without these
            names, the first three channels are shown as red, green and blue, and a single channel as grey.
        layers: additional image layers that ``neuprim render --format exr`` can write for this task.
        options: name -> (default, one line of help) of the task's own settings under ``task.options``. Values are
            converted to the default's type, or to a third entry: ``Annotated[float, Range(0, 1)]``,
            ``("soft", "hard")`` (:mod:`neuprim.core.validation`). ``task/NAME.yaml`` may have other defaults.
        uses: the shared settings of :data:`neuprim.core.train.settings.OPTIONAL` that ``build`` (``model.…``) and
            ``loss`` (``train.…``) read. If a user sets any other of these shared settings, this is an error.
        mask: function (data set, index of a test view) -> (H, W) bool, the part of the view whose error is also
            reported separately, or None.
        metrics: function (data set, index of a test view, rendered (H, W, C), truth (H, W, C)) -> further metrics by
            name. ``metrics.json`` states them for each view and as means over the views. Images are in the data set's
            colour space, composited over the data set's background. Metrics ``mse_NAME`` give ``psnr_pooled_NAME``: the
            PSNR of the mean of ``mse_NAME`` over views, weighted by ``pixels_NAME``. Metrics ``pixels_NAME`` are summed
            over the views. Every other metric gives a plain mean over the views that have this metric.
        diagnose: function (data set, model) -> further JSON-able numbers for ``metrics.json``, such as errors against
            the ground truth of a volume.
        clips: films to make of test views or of other views of the data set.
        facts: JSON-able values that rendering needs without the data; stored in the model's header under "data",
            with "up" and "center".
        orbit: function (data set, number of frames) -> views on a circle around the scene, with every condition of the
            task.
        tunable_settings: function (model settings, as for ``build``) -> settings that trade quality for speed or size,
            with the values to try: ``{"model.neurons": (0, 2, 4, 8)}``. ``neuprim tradeoff task=NAME`` varies these
            settings, the number of primitives and the length of training. Names begin with ``model.`` or
            ``task.options.``.
    """

    api: int
    name: str
    summary: str  # one line for neuprim tasks
    config_package: str
    scenes: tuple[SceneSpec, ...]  # the scenes of the task
    build: Callable[[Mapping[str, Any], Dataset], tuple[DensityField, ColourField]]
    loss: Callable[[Mapping[str, Any]], Loss]
    conditions: tuple[ConditionSpec, ...] = ()
    check: Callable[[Mapping[str, Any]], None] = lambda model: None
    fields: Mapping[str, type[Field]] | None = None
    example: Callable[[], Dataset] | None = None
    environment: Illuminate | None = None
    channels: tuple[str, ...] = ()
    display: Display | None = None
    layers: tuple[LayerSpec, ...] = ()
    options: Mapping[str, Option] = field(default_factory=dict)
    uses: tuple[str, ...] = ()
    mask: Callable[[Dataset, int], Tensor | None] = lambda dataset, index: None
    metrics: Callable[[Dataset, int, Tensor, Tensor], Mapping[str, float]] = lambda dataset, index, rendered, truth: {}
    diagnose: Callable[[Dataset, Primitives], Mapping[str, Any]] = lambda dataset, model: {}
    clips: Callable[[Dataset], Sequence[Clip]] = lambda dataset: ()
    facts: Callable[[Dataset], Mapping[str, Any]] = lambda dataset: {}
    orbit: Callable[[Dataset, int], list[View]] = Dataset.orbit
    tunable_settings: Callable[[Mapping[str, Any]], Mapping[str, Sequence[Any]]] = lambda model: {}

    def parameter_names(self) -> set[str]:
        """Return the names of all parameters that the fields of the task can have.

        Fields whose constructor has required arguments are left out.
        """
        names = set()
        for cls in (self.fields or {}).values():
            try:
                names |= {spec.name for spec in cls.every_parameter()}
            except TypeError:  # a required setting
                continue
        return names

    def scene(self, name: str) -> SceneSpec:
        """Return the scene of this name; raises KeyError if there is none."""
        return {s.name: s for s in self.scenes}[name]

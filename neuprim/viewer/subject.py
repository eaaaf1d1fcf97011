"""What a page looks at: a model, how its task names and shows things, and the held-out views that it may be compared
with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, orbit
from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels
from neuprim.core.data import Dataset, View
from neuprim.core.io.images import to_uint8
from neuprim.core.metrics import psnr
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.core.task import TaskSpec
from neuprim.runs.measure import draw
from neuprim.runs.open import placed
from neuprim.runs.render_config import RenderConfig
from neuprim.viewer.frame import Look, Picture, draw_look
from neuprim.viewer.levels import Front
from neuprim.webpage.scene import held_out, start_of

__all__ = ["Comparison", "Subject"]

_ASKED = 8  # held-out views among which the first one is chosen
_FOV = 0.7  # radians, of a first view that no data set gives


@dataclass(frozen=True, eq=False)
class Comparison:
    """A held-out view beside its truth: (H, W, 3) uint8 sRGB each, and the model's PSNR there, dB, as ``metrics.json``
    has it."""

    truth: np.ndarray
    drawn: np.ndarray
    psnr: float


@dataclass(eq=False)
class Subject:
    """Everything here is called by one thread at a time, the one that has the model.

    Attributes:
        name: of the run.
        model: gives the model as it is now.
        settings: how the run draws.
        background: (C,) behind everything.
        up: (3,) upward in the scene.
        center: (3,) its middle, which a camera turns around.
        world: in whose coordinates a person types and reads positions, and files of cameras are written; everything
        else here is the scene's. dataset: for held-out views; None where its files are gone.
        front: of ``neuprim tradeoff``, where that was run.
    """

    name: str
    task: TaskSpec
    model: Callable[[], Primitives]
    channels: Channels
    settings: RenderSettings
    background: Tensor
    up: tuple[float, float, float]
    center: np.ndarray
    world: World = field(default_factory=World)
    dataset: Dataset | None = None
    front: Front = field(default_factory=Front)
    _kept: dict[tuple[object, ...], Primitives] = field(default_factory=dict)

    def prepared(self, point: RenderConfig, view: View) -> Primitives:
        """The model as a point draws it, where it is best drawn; the last few are kept."""
        model = self.model()
        key = (
            id(model),
            tuple(point.reduced.items()),
            tuple(point.storage.items()),
            point.settings.device,
            point.settings.backend,
        )
        if not point.reduced and not point.storage and model.device.type != "cpu":
            return model  # a training's, where it is
        if key not in self._kept:
            if len(self._kept) > 3:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = placed(point.prepare_model(model), point.settings, view)
        return self._kept[key]

    def draw(self, look: Look, point: RenderConfig) -> Picture:
        """A picture of the model as it is now.

        Raises:
            NeuprimError: what the renderer refuses.
        """
        model = self.prepared(point, View("", look.camera, look.conditions))
        return draw_look(model, look, point, self.background, self.channels)

    def view_names(self) -> list[str]:
        """Names of the held-out views that a pinhole saw, in their order."""
        return list(self._views())

    def view(self, name: str) -> View:
        """A held-out view of :meth:`view_names`."""
        assert self.dataset is not None
        return self.dataset.test.view(self._views()[name])

    def compare(self, name: str) -> Comparison:
        """A held-out view, drawn and true."""
        assert self.dataset is not None
        index = self._views()[name]
        view, pixels = self.dataset.test.view(index), self.dataset.test.pixels(index)
        truth = pixels.over(self.dataset.background)
        model = self.prepared(RenderConfig(self.settings), view)
        drawn = draw(model, view, self.settings, self.dataset.background)
        images = [np.asarray(to_uint8(self.channels.display(image)).numpy()) for image in (truth, drawn)]
        return Comparison(images[0], images[1], psnr(drawn, truth, pixels.mask))

    def _views(self) -> Mapping[str, int]:
        if self.dataset is None:
            return {}
        views = self.dataset.test
        return {view.name: i for i in range(len(views)) if isinstance((view := views.view(i)).camera, Camera)}

    @staticmethod
    def middle_of(model: Primitives) -> np.ndarray:
        """(3,) of a model whose scene's middle nobody says: the median of the stored centres."""
        means = model.params["means"].detach().double().cpu()
        return np.asarray(means.median(0).values.numpy()) if len(means) else np.zeros(3)

    def start(self) -> View:
        """Where a page begins: the held-out view in which most is to be seen, else all of the model from aside."""
        if self.dataset is not None:
            views = held_out(self.dataset, self.channels, _ASKED)
            if views:
                return View(views[0].name, views[0].camera, _floats(start_of(self.task.conditions, views, {})))
        conditions = _floats(start_of(self.task.conditions, [], {}))
        with torch.no_grad():
            means = self.model().active(conditions).geometry.means.double().cpu()
        middle = torch.from_numpy(np.asarray(self.center, np.float64))
        radius = (float((means - middle).norm(dim=1).quantile(0.9)) if len(means) else 0.0) or 1.0
        focal = 180 / math.tan(_FOV / 2)
        template = Camera(torch.eye(4, dtype=torch.float64), focal, focal, 320.0, 180.0, 640, 360)
        (camera,) = orbit(template, middle, torch.tensor(self.up, dtype=torch.float64), 3.5 * radius, 0.4, 1)
        return View("", camera, conditions)


def _floats(conditions: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.float() for name, value in conditions.items()}

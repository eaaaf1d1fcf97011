"""The model that a viewer shows: drawing it from a viewpoint, and comparing it with held-out views."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, orbit
from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels
from neuprim.core.data import Dataset, View
from neuprim.core.errors import ConfigError
from neuprim.core.io.images import to_uint8
from neuprim.core.metrics import psnr
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.task import TaskSpec
from neuprim.inspect.layers import colormap_bytes
from neuprim.runs.measure import render_image
from neuprim.runs.open import move_to_render_device
from neuprim.runs.render_config import RenderConfig
from neuprim.viewer.quality import Front
from neuprim.webpage import PageView
from neuprim.webpage.scene_page import held_out_webpage_views, initial_webpage_conditions

COLOUR, ALPHA, DEPTH = "colour", "alpha", "depth"

_MAX_RAYS = 2**26  # the renderer draws them at once in 2 GB
_MIN_ALPHA = 0.05  # below, a pixel has no meaningful depth
_START_CANDIDATES = 8
_START_FOV = 0.7  # radians
_CACHED_MODELS = 4


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """What a page shows: a camera, every condition of the task, and one of :func:`list_viewer_quantities`."""

    camera: Camera
    conditions: Mapping[str, Tensor] = field(default_factory=dict)
    quantity: str = COLOUR


@dataclass(frozen=True, eq=False)
class Picture:
    """A drawn image, (H, W, 3) uint8 sRGB at its rendered resolution; the meaning of its colours, may be empty."""

    image: np.ndarray
    caption: str
    seconds: float


@dataclass(frozen=True, eq=False)
class ViewComparison:
    """A held-out view: ground truth and rendering, (H, W, 3) uint8 sRGB, and their PSNR in dB."""

    truth: np.ndarray
    drawn: np.ndarray
    psnr: float


def list_viewer_quantities(channels: Channels) -> list[str]:
    """Colour, alpha, depth, and each channel if there are several."""
    return [COLOUR, ALPHA, DEPTH, *(f"channel {name}" for name in channels.names if channels.count > 1)]


def draw_viewer_picture(
    model: Primitives, viewpoint: Viewpoint, config: RenderConfig, background: Tensor, channels: Channels
) -> Picture:
    """Draw a model that the render configuration was applied to.

    Depth is camera z, averaged along each ray, shown from its 2nd to its 98th percentile.

    Raises:
        NeuprimError: the renderer refuses.
    """
    start = time.perf_counter()
    view = config.scale_view(View("", viewpoint.camera, viewpoint.conditions))
    settings = replace(config.settings, depth=viewpoint.quantity == DEPTH)
    width, height = view.camera.width, view.camera.height
    if width * height * settings.samples**2 > _MAX_RAYS:
        size = f"{width} x {height} pixels with renderer.samples={settings.samples}"
        raise ConfigError(f"{size} take more than {_MAX_RAYS:,} rays; lower either")
    with torch.no_grad():
        output = render(model, view.camera, view.conditions, settings, background)
    caption = ""
    if viewpoint.quantity == COLOUR:
        image = to_uint8(channels.display(output.rgb.cpu())).numpy()
    elif viewpoint.quantity == ALPHA:
        image = _to_viewer_grey(output.alpha.cpu())
    elif viewpoint.quantity == DEPTH:
        assert output.depth is not None
        image, caption = _colour_viewer_depth(output.depth.cpu().numpy(), output.alpha.cpu().numpy())
    else:
        index = [f"channel {name}" for name in channels.names].index(viewpoint.quantity)
        image = _to_viewer_grey(output.rgb[..., index].cpu())
        caption = f"{channels.names[index]}, 0 is black and 1 is white, {channels.color_space}"
    return Picture(image, caption, time.perf_counter() - start)


def _to_viewer_grey(values: Tensor) -> np.ndarray:
    return np.asarray(to_uint8(values[..., None].expand(-1, -1, 3)).numpy())


def _colour_viewer_depth(depth: np.ndarray, alpha: np.ndarray) -> tuple[np.ndarray, str]:
    """(H, W, 3) uint8, near is bright and empty is black; and a caption."""
    solid = alpha > _MIN_ALPHA
    image = np.zeros((*depth.shape, 3), np.uint8)
    if not solid.any():
        return image, "nothing is in sight"
    near, far = (float(x) for x in np.percentile(depth[solid], (2.0, 98.0)))
    part = np.clip((depth[solid] - near) / max(far - near, 1e-12), 0.0, 1.0)
    image[solid] = colormap_bytes("viridis")[np.minimum((256 * (1.0 - part)).astype(np.int64), 255)]
    return image, f"depth {near:.4g} (bright) to {far:.4g} scene units"


@dataclass(eq=False)
class ViewerScene:
    """A model with what its task and data say about it. One thread at a time may call the methods.

    Attributes:
        name: of the run.
        model: returns the current model.
        settings: render settings of the run.
        background: (C,) colour behind everything.
        up: (3,) upward direction.
        center: (3,) point that a camera turns around, scene units.
        world: coordinates in which positions are typed and shown.
        dataset: for held-out views; None if its files are gone.
        front: see :func:`~neuprim.viewer.quality.read_viewer_front`.
    """

    name: str
    task: TaskSpec
    model: Callable[[], Primitives]
    channels: Channels
    settings: RenderSettings
    background: Tensor
    up: tuple[float, ...]
    center: np.ndarray
    world: World = field(default_factory=World)
    dataset: Dataset | None = None
    front: Front = ()
    _cache: dict[tuple[object, ...], Primitives] = field(default_factory=dict)

    def prepare_model(self, config: RenderConfig, view: View) -> Primitives:
        """Return the model with a render configuration applied, on its device; a few are cached."""
        model = self.model()
        if not config.reduced and not config.storage and model.device.type != "cpu":
            return model  # of a training, which keeps it on its device
        changes = (tuple(config.reduced.items()), tuple(config.storage.items()))
        key = (id(model), *changes, config.settings.device, config.settings.backend)
        if key not in self._cache:
            if len(self._cache) >= _CACHED_MODELS:
                self._cache.pop(next(iter(self._cache)))
            self._cache[key] = move_to_render_device(config.prepare_model(model), config.settings, view)
        return self._cache[key]

    def draw(self, viewpoint: Viewpoint, config: RenderConfig) -> Picture:
        """Draw the current model; see :func:`draw_viewer_picture`."""
        model = self.prepare_model(config, View("", viewpoint.camera, viewpoint.conditions))
        return draw_viewer_picture(model, viewpoint, config, self.background, self.channels)

    def list_views(self) -> list[str]:
        """Return the names of the held-out views with a pinhole camera."""
        return list(self._view_indices())

    def load_view(self, name: str) -> View:
        """Return a held-out view of :meth:`list_views`."""
        assert self.dataset is not None
        return self.dataset.test.view(self._view_indices()[name])

    def compare_view(self, name: str) -> ViewComparison:
        """Draw a held-out view and compare it with its ground truth, as ``metrics.json`` does."""
        assert self.dataset is not None
        index = self._view_indices()[name]
        view, pixels = self.dataset.test.view(index), self.dataset.test.pixels(index)
        truth = pixels.over(self.dataset.background)
        model = self.prepare_model(RenderConfig(self.settings), view)
        drawn = render_image(model, view, self.settings, self.dataset.background)
        images = [np.asarray(to_uint8(self.channels.display(image)).numpy()) for image in (truth, drawn)]
        return ViewComparison(images[0], images[1], psnr(drawn, truth, pixels.mask))

    def _view_indices(self) -> Mapping[str, int]:
        if self.dataset is None:
            return {}
        views = self.dataset.test
        return {view.name: i for i in range(len(views)) if isinstance((view := views.view(i)).camera, Camera)}

    def start_view(self) -> View:
        """Return the first view: the held-out view with most contrast, else the whole model from the side."""
        if self.dataset is not None:
            views = held_out_webpage_views(self.dataset, self.channels, _START_CANDIDATES)
            if views:
                return View(views[0].name, views[0].camera, self._initial_conditions(views))
        conditions = self._initial_conditions([])
        with torch.no_grad():
            means = self.model().active(conditions).geometry.means.double().cpu()
        middle = torch.from_numpy(np.asarray(self.center, np.float64))
        radius = (float((means - middle).norm(dim=1).quantile(0.9)) if len(means) else 0.0) or 1.0
        focal = 180 / math.tan(_START_FOV / 2)
        template = Camera(torch.eye(4, dtype=torch.float64), focal, focal, 320.0, 180.0, 640, 360)
        (camera,) = orbit(template, middle, torch.tensor(self.up, dtype=torch.float64), 3.5 * radius, 0.4, 1)
        return View("", camera, conditions)

    def _initial_conditions(self, views: Sequence[PageView]) -> dict[str, Tensor]:
        return {c.spec.name: c.value.float() for c in initial_webpage_conditions(self.task.conditions, views, {})}

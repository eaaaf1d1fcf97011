"""The model that a viewer shows: render it from a viewpoint, compare held-out views, and list its primitives."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, orbit
from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels, read_stored_channels
from neuprim.core.data import Dataset, View
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.io.images import to_uint8
from neuprim.core.metrics import psnr
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.task import TaskSpec
from neuprim.inspect.field import measure_absorption
from neuprim.inspect.layers import colormap_bytes
from neuprim.runs.measure import render_image
from neuprim.runs.open import load_dataset, load_run, move_to_render_device
from neuprim.webpage.model_page import (
    PageView,
    held_out_webpage_views,
    initial_webpage_conditions,
    stored_up_axis,
)

COLOUR, ALPHA, DEPTH = "colour", "alpha", "depth"

_MAX_RAYS = 2**26  # the renderer draws them at once in 2 GB
_MIN_ALPHA = 0.05  # below, a pixel has no meaningful depth
_START_CANDIDATES = 8
_START_FOV = 0.7  # radians
_MAX_NUMBERS = 24  # values of a parameter that are written out


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """What a browser page shows: camera, values of the task's conditions (e.g. the time), and a quantity.

    The quantity is one of :func:`list_viewer_quantities`, e.g. "colour" or "depth".
    """

    camera: Camera
    conditions: Mapping[str, Tensor] = field(default_factory=dict)
    quantity: str = COLOUR


class Picture(NamedTuple):
    """A rendered image, (H, W, 3) uint8 sRGB, its caption, and the render time in seconds.

    The caption explains the colours of the image; "" if they need no explanation.
    """

    image: np.ndarray
    caption: str
    seconds: float


def list_viewer_quantities(channels: Channels) -> list[str]:
    """Return the quantities that a page can show: colour, alpha, depth, and each channel if there are several."""
    return [COLOUR, ALPHA, DEPTH, *(f"channel {name}" for name in channels.names if channels.count > 1)]


@dataclass(eq=False)
class ViewerScene:
    """A model to show, with facts from its task and data. Only one thread at a time may call the methods.

    Attributes:
        name: name of the run.
        model: function that returns the current model.
        settings: render settings of the run.
        background: (C,) colour behind everything.
        up: (3,) upward direction.
        center: (3,) point around which dragging turns the camera, scene units.
        world: coordinates in which positions are typed and shown.
        dataset: data set with the held-out views; None if its files cannot be read.
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

    def draw(self, viewpoint: Viewpoint, settings: RenderSettings) -> Picture:
        """Render the current model from a viewpoint.

        Depth is the camera's z, averaged along each ray. Its colours range from the 2nd to the 98th percentile.

        Raises:
            NeuprimError: the backend cannot render the model with these settings.
        """
        start = time.perf_counter()
        camera, channels = viewpoint.camera, self.channels
        if camera.width * camera.height * settings.samples**2 > _MAX_RAYS:
            size = f"{camera.width} x {camera.height} pixels with renderer.samples={settings.samples}"
            raise ConfigError(f"{size} need more than {_MAX_RAYS:,} rays; reduce the image size or renderer.samples")
        settings = replace(settings, depth=viewpoint.quantity == DEPTH)
        with torch.no_grad():
            output = render(self.model(), camera, viewpoint.conditions, settings, self.background)
        caption = ""
        if viewpoint.quantity == COLOUR:
            image = to_uint8(channels.display(output.rgb.cpu())).numpy()
        elif viewpoint.quantity == ALPHA:
            image = _to_viewer_grey(output.alpha.cpu())
        elif viewpoint.quantity == DEPTH:
            assert output.depth is not None
            image, caption = _colour_viewer_depth(output.depth.cpu().numpy(), output.alpha.cpu().numpy())
        else:
            index = list_viewer_quantities(channels).index(viewpoint.quantity) - 3
            image = _to_viewer_grey(output.rgb[..., index].cpu())
            caption = f"{channels.names[index]}, 0 is black and 1 is white, {channels.color_space}"
        return Picture(image, caption, time.perf_counter() - start)

    @cached_property
    def view_indices(self) -> Mapping[str, int]:
        """Held-out views with a pinhole camera: name -> index in the test split. Empty without a data set."""
        if self.dataset is None:
            return {}
        views = self.dataset.test
        return {view.name: i for i in range(len(views)) if isinstance((view := views.view(i)).camera, Camera)}

    def load_view(self, name: str) -> View:
        """Return the held-out view with this name, see :attr:`view_indices`."""
        assert self.dataset is not None
        return self.dataset.test.view(self.view_indices[name])

    def compare_view(self, name: str) -> tuple[np.ndarray, np.ndarray, float]:
        """Render a held-out view and compare the image with the ground truth, as for ``metrics.json``.

        Returns:
            Ground truth and rendering, (H, W, 3) uint8 sRGB, and the PSNR of the rendering in dB.
        """
        assert self.dataset is not None
        view, pixels = self.load_view(name), self.dataset.test.pixels(self.view_indices[name])
        truth = pixels.over(self.dataset.background)
        drawn = render_image(self.model(), view, self.settings, self.dataset.background)
        images = [np.asarray(to_uint8(self.channels.display(image)).numpy()) for image in (truth, drawn)]
        return images[0], images[1], psnr(drawn, truth, pixels.mask)

    @cached_property
    def start_view(self) -> View:
        """View with which a page opens: the held-out view with most contrast, else a view from the side."""
        if self.dataset is not None:
            views = held_out_webpage_views(self.dataset, self.channels, _START_CANDIDATES, truths=False)
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


def open_viewer_scene(
    run_dir: Path, warn: Callable[[str], None], progress: Callable[[str, float], None]
) -> ViewerScene:
    """Load a finished run for a viewer. If its data cannot be read, warn and offer no held-out views.

    Raises:
        CheckpointError, ConfigError: a file of the run is missing or damaged.
    """
    run = load_run(run_dir)
    task, model, header = run.task, run.model, run.header
    dataset: Dataset | None = None
    try:
        with run.plugins.attribute_errors():
            dataset = load_dataset(run, progress)
    except NeuprimError as error:
        warn(f"no held-out views: {error}")
    means = model.params["means"].detach().double().cpu()
    center = means.median(0).values if len(means) else torch.zeros(3)
    scene = ViewerScene(
        name=run_dir.resolve().name,
        task=task,
        model=lambda: model,
        channels=read_stored_channels(run_dir, header, task, model.colour.channels),
        settings=run.config.renderer,
        background=torch.tensor([float(x) for x in header.get("background", [0.0] * model.colour.channels)]),
        up=stored_up_axis(header) if dataset is None else tuple(dataset.up.tolist()),
        center=np.asarray((center if dataset is None else dataset.center).double().numpy()),
        world=World.of(header, str(run_dir)),
        dataset=dataset,
    )
    placed = move_to_render_device(model, scene.settings, scene.start_view)
    scene.model = lambda: placed
    return scene


def _to_viewer_grey(values: Tensor) -> np.ndarray:
    return np.asarray(to_uint8(values[..., None].expand(-1, -1, 3)).numpy())


def _colour_viewer_depth(depth: np.ndarray, alpha: np.ndarray) -> tuple[np.ndarray, str]:
    """Convert (H, W) depth to (H, W, 3) uint8 colours, bright if near, black if empty; return them and a caption."""
    solid = alpha > _MIN_ALPHA
    image = np.zeros((*depth.shape, 3), np.uint8)
    if not solid.any():
        return image, "nothing is in sight"
    near, far = (float(x) for x in np.percentile(depth[solid], (2.0, 98.0)))
    part = np.clip((depth[solid] - near) / max(far - near, 1e-12), 0.0, 1.0)
    image[solid] = colormap_bytes("viridis")[np.minimum((256 * (1.0 - part)).astype(np.int64), 255)]
    return image, f"depth {near:.4g} (bright) to {far:.4g} scene units"


# ---------------------------------------------------------------- primitives


class FrameEllipsoids(NamedTuple):
    """The ellipsoids of M primitives from one viewpoint, float32, scene units.

    Attributes:
        rows: (M,) indices of the primitives in the model.
        positions, scales: (M, 3) centres and (M, 3) semi-axes of the ellipsoids.
        wxyz: (M, 4) unit quaternions of the ellipsoids' orientations.
        colours: (M, 3) uint8 sRGB, colours at the centres, seen from the viewpoint's camera.
    """

    rows: np.ndarray
    positions: np.ndarray
    wxyz: np.ndarray
    scales: np.ndarray
    colours: np.ndarray


def list_viewer_ellipsoids(
    model: Primitives, viewpoint: Viewpoint, channels: Channels, limit: int, row: int | None = None
) -> FrameEllipsoids:
    """Return the ellipsoids of the ``limit`` primitives that absorb most light.

    If ``row`` is given, return only the ellipsoid of the primitive with this index, or none if it is not active.
    """
    with torch.no_grad():
        lowered = model.lower(viewpoint.camera, viewpoint.conditions)
        geometry = lowered.geometry
        rows = torch.arange(model.count) if lowered.rows is None else lowered.rows.cpu()
        chosen = torch.arange(len(rows)) if row is None else (rows == row).nonzero()[:, 0]
        if len(chosen) > limit:
            mass = measure_absorption(model.to(torch.device("cpu")).active(viewpoint.conditions))
            chosen = torch.from_numpy(np.sort(np.argsort(-mass, kind="stable")[:limit]))
        colours = lowered.center_colors(viewpoint.camera.position.to(geometry.means)).float().cpu()
        shown = np.rint(255 * channels.display_rows(colours.clamp_min(0)).numpy()).astype(np.uint8)
        means, scales, quats = (x.float().cpu()[chosen] for x in (geometry.means, geometry.scales, geometry.quats))
    wxyz = quats / quats.norm(dim=-1, keepdim=True)
    return FrameEllipsoids(rows[chosen].numpy(), means.numpy(), wxyz.numpy(), scales.numpy(), shown[chosen.numpy()])


def pick_primitive(
    model: Primitives, viewpoint: Viewpoint, direction: np.ndarray, settings: RenderSettings
) -> int | None:
    """Return the index of the primitive with the largest weight along a ray from the camera; None if the ray hits none.

    Args:
        direction: (3,) direction of the ray in scene coordinates, any length.
    """
    camera = viewpoint.camera
    x, y, z = (camera.viewmat[:3, :3].double() @ torch.as_tensor(np.asarray(direction, np.float64))).tolist()
    if z <= 0:
        return None
    ray = Camera(camera.viewmat, camera.fx, camera.fy, 0.5 - camera.fx * x / z, 0.5 - camera.fy * y / z, 1, 1)
    params = {name: value.detach().clone().requires_grad_() for name, value in model.params.items()}
    output = render(Primitives(model.density, model.colour, params), ray, viewpoint.conditions, settings)
    contributions = output.request_contributions(torch.ones(1, 1, device=output.rgb.device))
    output.rgb.sum().backward()
    weight, _ = contributions.of_all(model.count)
    return int(weight.argmax()) if len(weight) and float(weight.max()) > 0 else None


def describe_viewer_primitive(model: Primitives, row: int) -> str:
    """Return a text with a primitive's semi-axes and parameters, one per line.

    Raises:
        ConfigError: the model has no such primitive.
    """
    if not 0 <= row < model.count:
        raise ConfigError(f"primitive {row}: the model has {model.count} primitives, 0 to {model.count - 1}")
    axes = model.params["log_scales"][row].detach().double().exp().tolist()
    lines = [f"primitive {row} of {model.count}", f"semi-axes {' '.join(f'{x:.4g}' for x in axes)} scene units"]
    for spec in model.specs:
        values = model.params[spec.name][row].detach().double().flatten().tolist()
        more = f" … ({len(values)} numbers)" if len(values) > _MAX_NUMBERS else ""
        lines.append(f"{spec.name}: {' '.join(f'{x:.4g}' for x in values[:_MAX_NUMBERS])}{more}")
    return "\n".join(lines)

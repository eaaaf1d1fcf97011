"""Draw inspectors with pyvista, one panel each: in a window with a slider for frames, or as pictures off screen."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from neuprim.core.errors import BackendUnavailable
from neuprim.core.extensions import Inspector
from neuprim.inspect.field import InspectionFrame
from neuprim.inspect.layers import (
    Ellipsoids,
    InspectionGrid,
    Isosurfaces,
    Layer,
    Mesh,
    Scale,
    Slices,
    Text,
    Volume,
    layer_colours,
)
from neuprim.inspect.views import find_inspection_viewpoint, unit_sphere

Panel = tuple[Inspector, str]
_PANEL = (720, 640)


def list_inspection_panels(inspectors: Sequence[Inspector], with_truth: bool) -> list[Panel]:
    """List the panels of a picture as (inspector, side); side is "model" or "truth".

    If ``with_truth``, inspectors of the extinction on the grid get a second panel, which shows the ground truth.
    """
    return [
        (i, side)
        for i in inspectors
        for side in (("model", "truth") if with_truth and i.shows == "sigma" else ("model",))
    ]


class Window:
    """A pyvista window, or picture off screen, with one panel per (inspector, side); side is "model" or "truth".

    All panels that show the whole scene share one camera.

    Args:
        up: upward axis of the scene, "x", "y" or "z".
        size: size of the picture in pixels; None for 720 x 640 per panel.
    """

    def __init__(self, panels: Sequence[Panel], up: str, off_screen: bool, size: tuple[int, int] | None = None) -> None:
        import pyvista

        self.panels = list(panels)
        paired = any(side == "truth" for _, side in panels)  # then each row shows the model and the truth
        columns = len(panels) if len(panels) <= 3 else 2 if paired else -(-len(panels) // 2)
        self.shape = (-(-len(panels) // columns), columns)
        pixels = size or (columns * _PANEL[0], self.shape[0] * _PANEL[1])
        make: Any = pyvista.Plotter
        self.plotter = make(shape=self.shape, off_screen=off_screen, window_size=list(pixels), border_color="#39424c")
        self._up, self._cameras_placed = up, False
        for panel in range(self.shape[0] * self.shape[1]):
            self._select_panel(panel)
            self.plotter.set_background("#0d1117", top="#27303a", all_renderers=False)

    def _select_panel(self, panel: int) -> None:
        self.plotter.subplot(*divmod(panel, self.shape[1]))

    def draw(self, frame: InspectionFrame) -> None:
        """Draw an inspection frame in all panels."""
        for title in list(self.plotter.scalar_bars.keys()):
            self.plotter.remove_scalar_bar(title, render=False)
        for panel, (inspector, side) in enumerate(self.panels):
            self._select_panel(panel)
            self.plotter.renderer.clear_actors()
            part = frame.of_side(side)
            _add_pyvista_layers(self.plotter, inspector.layers(part), panel)
            if inspector.shows != "primitive":
                _add_pyvista_box(self.plotter, part.box)
            look = {"position": "upper_left", "font_size": 10, "color": "white", "name": "caption"}
            self.plotter.add_text(_inspection_caption(inspector, part), **look)
            self.plotter.add_axes(color="white", line_width=2)
        if not self._cameras_placed:
            self._place_cameras(frame)

    def _place_cameras(self, frame: InspectionFrame) -> None:
        linked = [i for i, (inspector, _) in enumerate(self.panels) if inspector.shows != "primitive"]
        for panel, (inspector, _) in enumerate(self.panels):
            self._select_panel(panel)
            point, camera = find_inspection_viewpoint(inspector, frame, self._up), self.plotter.camera
            camera.focal_point, camera.up = point.focus, point.up
            camera.position = point.focus + point.direction * point.radius / np.sin(np.radians(camera.view_angle) / 2)
            self.plotter.renderer.reset_camera_clipping_range()
        if len(linked) > 1:
            self.plotter.link_views(linked)
        self._cameras_placed = True

    def picture(self) -> np.ndarray:
        """Return what the window shows, (H, W, 3) uint8."""
        self.plotter.render()
        return np.asarray(self.plotter.screenshot(return_img=True))[..., :3]

    def interact(self, count: int, frame: Callable[[int], InspectionFrame]) -> None:
        """Show the window until the user closes it. If there are several frames, a slider selects the frame.

        ``frame`` returns the frame with a given index, from 0 to ``count`` - 1.
        """
        if count > 1:
            self.add_slider(count, frame)
        self.draw(frame(0))
        self.plotter.show()

    def add_slider(self, count: int, frame: Callable[[int], InspectionFrame]) -> None:
        """Add a slider over ``count`` frames. A frame is drawn when the slider reaches it."""
        shown = [0]

        def moved(value: float) -> None:
            wanted = min(max(round(value) - 1, 0), count - 1)
            if wanted != shown[0]:
                shown[0] = wanted
                self.draw(frame(wanted))

        self._select_panel(0)
        ends = {"pointa": (0.62, 0.93), "pointb": (0.95, 0.93)}
        look = {"title": "frame", "fmt": "%.0f", "color": "white", "title_height": 0.02}
        self.plotter.add_slider_widget(moved, (1, count), value=1, **ends, **look)

    def close(self) -> None:
        """Close the window and free its resources."""
        self.plotter.close()


def _inspection_caption(inspector: Inspector, frame: InspectionFrame) -> str:
    first = frame.truth_name or "ground truth" if frame.side == "truth" else frame.title or "model"
    lines = [f"{inspector.name}: {'ground truth, ' if frame.side == 'truth' else ''}{first}"]
    if frame.numbers and frame.side == "model" and inspector.shows in ("sigma", "both"):
        lines.append(f"correlation {frame.numbers['correlation']:.3f}   relative L2 {frame.numbers['relative_l2']:.3f}")
    return "\n".join(lines)


# ---------------------------------------------------------------- layers to VTK's objects

_OPACITY_STEPS = 256
_FINE_ELLIPSOIDS = 4000  # ellipsoids up to which each gets many triangles


def _add_pyvista_layers(plotter: Any, layers: Sequence[Layer], panel: int) -> None:
    """Draw valid layers and a colour bar for each scale into the plotter's current panel, number ``panel``."""
    scales: dict[Scale, None] = {}
    for layer in layers:
        if isinstance(layer, Text):
            plotter.add_text(layer.text, position=layer.corner, font_size=8, color="white")
            continue
        if isinstance(layer, InspectionGrid):
            _add_pyvista_grid(plotter, layer)
            scale: Scale | None = layer.scale
        else:
            _add_pyvista_shape(plotter, layer)
            scale = layer.scale if layer.values is not None else None
        if scale is not None and scale.title:
            scales[scale] = None
    for place, scale in enumerate(scales):
        _add_pyvista_bar(plotter, scale, panel, place)


def _add_pyvista_box(plotter: Any, box: np.ndarray) -> None:
    """Draw the edges of the box with corners ``box`` (2, 3)."""
    import pyvista

    plotter.add_mesh(pyvista.Box(box.T.ravel()).outline(), color="#8894a0", line_width=1, lighting=False)


def _add_pyvista_bar(plotter: Any, scale: Scale, panel: int, place: int) -> None:
    """Draw a colour bar for ``scale`` into panel number ``panel``; ``place`` 0 is the lowest bar of the panel."""
    import pyvista

    mapper = pyvista.DataSetMapper()
    mapper.lookup_table = pyvista.LookupTable(scale.colours, scalar_range=(scale.low, scale.high))
    look = {"title_font_size": 15, "label_font_size": 13, "n_labels": 2, "fmt": "%.3g", "color": "white"}
    size = {"width": 0.6, "height": 0.09, "position_x": 0.2, "position_y": 0.02 + 0.11 * place}
    title = scale.label + " " * panel + "\u200a" * place  # plotters identify bars by their titles only
    plotter.add_scalar_bar(title, mapper=mapper, render=False, **size, **look)


def _add_pyvista_grid(plotter: Any, layer: InspectionGrid) -> None:
    scale = layer.scale
    look = {"scalars": "values", "cmap": scale.colours, "clim": (scale.low, scale.high), "show_scalar_bar": False}
    if isinstance(layer, Volume):
        ramp = np.linspace(scale.low, scale.high, _OPACITY_STEPS)
        plotter.add_volume(
            _make_pyvista_image(layer, np.clip(layer.values, scale.low, scale.high)),
            opacity=np.rint(255 * (1.0 - np.exp(-np.abs(ramp) * layer.depth * layer.spacing))),
            opacity_unit_distance=layer.spacing,
            shade=False,
            mapper="smart",
            **look,
        )
    elif isinstance(layer, Isosurfaces):
        data, levels = _make_pyvista_image(layer, layer.values, around=1), sorted(layer.levels)
        for i, level in enumerate(levels):
            surface = data.contour([level], scalars="values")
            opacity = 0.95 if i == len(levels) - 1 else min(0.22 + 0.2 * i, 0.95)
            if surface.n_points:
                plotter.add_mesh(surface, opacity=opacity, smooth_shading=True, specular=0.25, **look)
    elif isinstance(layer, Slices):
        x, y, z = layer.box.mean(0) if layer.through is None else layer.through
        cut = _make_pyvista_image(layer, layer.values).slice_orthogonal(x=x, y=y, z=z)
        if any(part.n_points for part in cut):
            plotter.add_mesh(cut, lighting=False, **look)


def _make_pyvista_image(layer: InspectionGrid, values: np.ndarray, around: int = 0) -> Any:
    """Make ``pyvista.ImageData`` of values at the layer's grid points, padded by ``around`` layers of zeros."""
    import pyvista

    origin = np.asarray(layer.origin, np.float64) - around * layer.spacing
    spacing = (float(layer.spacing),) * 3
    found = pyvista.ImageData(dimensions=np.array(values.shape) + 2 * around, spacing=spacing, origin=origin)
    found.point_data["values"] = np.pad(values.astype(np.float32, copy=False), around).ravel(order="F")
    return found


def _add_pyvista_shape(plotter: Any, layer: Any) -> None:
    """Draw a layer (ellipsoids, a mesh or points) into the plotter's current panel, with one colour per vertex."""
    import pyvista

    vertices = layer.vertices if isinstance(layer, Mesh) else layer.centres
    colours = layer_colours(layer, len(vertices))
    look: dict[str, Any] = {"smooth_shading": True, "ambient": 0.5, "diffuse": 0.6}
    cells = {}
    if isinstance(layer, Mesh):
        cells["faces"] = np.c_[np.full(len(layer.faces), 3), layer.faces].ravel()
    elif isinstance(layer, Ellipsoids):
        points, triangles = unit_sphere(2 if len(vertices) <= _FINE_ELLIPSOIDS else 1)
        placed = vertices.astype(np.float64)[:, None] + np.einsum("nka,vk->nva", layer.axes.astype(float), points)
        faces = triangles + (np.arange(len(vertices)) * len(points))[:, None, None]
        vertices, colours = placed.reshape(-1, 3), colours.repeat(len(points), 0)
        cells["faces"] = np.c_[np.full(faces.size // 3, 3), faces.reshape(-1, 3)].ravel()
        look = {"smooth_shading": True, "ambient": 0.3, "diffuse": 0.8, "specular": 0.15}
    else:
        look = {"render_points_as_spheres": True, "point_size": layer.size}
    if len(vertices) and (not cells or len(cells["faces"])):
        data = pyvista.PolyData(np.ascontiguousarray(vertices, np.float32), **cells)  # type: ignore[arg-type]
        data.point_data["colours"] = colours
        plotter.add_mesh(data, scalars="colours", rgb=True, opacity=layer.opacity, show_scalar_bar=False, **look)


# ---------------------------------------------------------------- without a display

_PROBE = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(32, 32))
plotter.add_mesh(pyvista.Sphere())
print("drawn" if plotter.screenshot(return_img=True).std() > 0 else "black")
"""
_PROBE_SECONDS = 120.0


def require_pyvista() -> None:
    """Raise BackendUnavailable if the package pyvista is missing."""
    try:
        import pyvista  # noqa: F401
    except ImportError as error:
        raise BackendUnavailable(
            f"pyvista cannot be imported ({error}); pip install 'neuprim[viewer]', or --out FILE.html or .vdb"
        ) from None


def has_display() -> bool:
    """Return whether this machine has a display for windows."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@cache
def prepare_headless() -> None:
    """Check that VTK can draw off screen. The check is a subprocess, because a missing library crashes the process.

    Raises:
        BackendUnavailable: VTK cannot draw; the message names the packages to install.
    """
    try:
        done = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=_PROBE_SECONDS)
        failure = "" if "drawn" in done.stdout else "the picture is black"
        if done.returncode < 0:
            failure = f"ended by {signal.Signals(-done.returncode).name}"
        elif done.returncode:
            failure = (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1][:200]
    except subprocess.TimeoutExpired:
        failure = f"no picture after {_PROBE_SECONDS:.0f} s"
    if failure:
        raise BackendUnavailable(
            f"VTK cannot draw pictures here ({failure}); on Debian or Ubuntu: apt install libegl1 libgl1-mesa-dri; "
            "--out FILE.html and --out FILE.vdb work without these packages"
        )
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # no warning about the displays that it tried

"""Primitives in a page: drawn as ellipsoids, picked by number or by a click, and described."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.channels import Channels
from neuprim.core.errors import ConfigError
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.inspect.field import measure_absorption
from neuprim.inspect.views import unit_sphere
from neuprim.viewer.session import Session
from neuprim.viewer.viewer_scene import Viewpoint

_MAX_NUMBERS = 24  # of a parameter that are written out
_NONE, _WIRE, _SOLID = "none", "wire", "solid"
_MAX_ELLIPSOIDS, _DEFAULT_ELLIPSOIDS = 20_000, 1_000


class Ellipsoids(NamedTuple):
    """M ellipsoids of a frame: (M,) rows of the model; (M, 3) centres, (M, 4) unit quaternions and (M, 3) semi-axes,
    float32, scene units; (M, 3) uint8 sRGB colours at their centres, as seen from the frame's camera."""

    rows: np.ndarray
    positions: np.ndarray
    wxyz: np.ndarray
    scales: np.ndarray
    colours: np.ndarray


def list_ellipsoids(model: Primitives, viewpoint: Viewpoint, channels: Channels, limit: int) -> Ellipsoids:
    """Return the ellipsoids of a frame: at most ``limit``, those that absorb most."""
    with torch.no_grad():
        lowered = model.lower(viewpoint.camera, viewpoint.conditions)
        count = lowered.geometry.count
        keep = torch.arange(count)
        if count > limit:
            mass = measure_absorption(model.to(torch.device("cpu")).active(viewpoint.conditions))
            keep = torch.from_numpy(np.sort(np.argsort(-mass, kind="stable")[:limit]))
        colours = channels.display_rows(
            lowered.center_colors(viewpoint.camera.position.to(lowered.geometry.means)).float().cpu().clamp_min(0)
        )
        rows = torch.arange(count) if lowered.rows is None else lowered.rows.cpu()
        return _gather(lowered.geometry, keep, rows, np.rint(255 * colours.numpy()).astype(np.uint8))


def make_ellipsoid(model: Primitives, viewpoint: Viewpoint, row: int) -> Ellipsoids | None:
    """Return one primitive in yellow; None if it is not active in the frame.

    Raises:
        ConfigError: the model has no such primitive.
    """
    if not 0 <= row < model.count:
        raise ConfigError(f"primitive {row}: the model has {model.count} primitives, 0 to {model.count - 1}")
    with torch.no_grad():
        active = model.active(viewpoint.conditions)
    rows = torch.arange(model.count) if active.rows is None else active.rows.cpu()
    place = (rows == row).nonzero()[:, 0]
    if not len(place):
        return None
    return _gather(active.geometry, place, rows, np.tile(np.array([[255, 210, 0]], np.uint8), (len(rows), 1)))


def _gather(geometry: Geometry, keep: Tensor, rows: Tensor, colours: np.ndarray) -> Ellipsoids:
    means, scales, quats = (x.detach().float().cpu()[keep] for x in (geometry.means, geometry.scales, geometry.quats))
    quats = quats / quats.norm(dim=-1, keepdim=True)
    return Ellipsoids(rows[keep].numpy(), means.numpy(), quats.numpy(), scales.numpy(), colours[keep.numpy()])


def pick_primitive(
    model: Primitives, viewpoint: Viewpoint, direction: np.ndarray, settings: RenderSettings
) -> int | None:
    """Return the row of the primitive with the largest weight along a ray from the camera; None if the ray is empty.

    Args:
        direction: (3,) of the ray, scene axes, any norm.
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


def describe_primitive(model: Primitives, row: int) -> str:
    """Return a primitive's semi-axes and parameters, one a line."""
    lines = [f"primitive {row} of {model.count}"]
    axes = model.params["log_scales"][row].detach().double().exp().tolist()
    lines.append(f"semi-axes {' '.join(f'{x:.4g}' for x in axes)} scene units")
    for spec in model.specs:
        values = model.params[spec.name][row].detach().double().flatten().tolist()
        more = f" … ({len(values)} numbers)" if len(values) > _MAX_NUMBERS else ""
        lines.append(f"{spec.name}: {' '.join(f'{x:.4g}' for x in values[:_MAX_NUMBERS])}{more}")
    return "\n".join(lines)


class PrimitiveControls:
    """Controls that draw ellipsoids over the image and describe a chosen primitive."""

    def __init__(self, session: Session) -> None:
        self.session = session
        gui = session.client.gui
        self._drawn: Any = None
        self._mark: Any = None
        self._style = gui.add_dropdown("ellipsoids", [_NONE, _WIRE, _SOLID], initial_value=_NONE)
        hint = "those that absorb most"
        self._limit = gui.add_slider("at most", 100, _MAX_ELLIPSOIDS, 100, _DEFAULT_ELLIPSOIDS, hint=hint)
        hint = "the primitive that contributes most under the mouse"
        self._click = gui.add_checkbox("choose by a click", False, hint=hint)
        self._row = gui.add_number("primitive", -1, min=-1, step=1, hint="its number; -1 for none")
        self._text = gui.add_text("its parameters", "", multiline=True, disabled=True)
        for control in (self._style, self._limit):
            control.on_update(lambda _: self.refresh())
        self._row.on_update(lambda _: session.submit("primitive", self._describe))
        self._click.on_update(lambda _: self._toggle_click())

    def refresh(self) -> None:
        """Redraw the ellipsoids, as after a change of conditions."""
        self.session.submit("ellipsoids", self._draw)
        if int(self._row.value) >= 0:
            self.session.submit("primitive", self._describe)

    def _toggle_click(self) -> None:
        scene = self.session.client.scene
        if not self._click.value:
            scene.remove_click_callback()
            return

        @scene.on_click()
        def _(event: Any) -> None:
            direction = np.asarray(event.ray_direction, np.float64)
            self.session.submit("click", lambda: self._pick(direction))

    def _pick(self, direction: np.ndarray) -> None:
        session = self.session
        row = pick_primitive(session.scene.model(), session.viewpoint(), direction, session.settings)
        if row is None:
            session.set_status("nothing is there")
        else:
            self._row.value = row  # calls _describe

    def _draw(self) -> None:
        if self._drawn is not None:
            self._drawn.remove()
            self._drawn = None
        if self._style.value == _NONE:
            return
        scene, viewpoint = self.session.scene, self.session.viewpoint()
        found = list_ellipsoids(scene.model(), viewpoint, scene.channels, int(self._limit.value))
        if len(found.rows):
            self._drawn = self._add_meshes("/ellipsoids", found, wire=self._style.value == _WIRE)

    def _describe(self) -> None:
        if self._mark is not None:
            self._mark.remove()
            self._mark = None
        row, session = int(self._row.value), self.session
        if row < 0:
            self._text.value = ""
            return
        model = session.scene.model()
        found = make_ellipsoid(model, session.viewpoint(), row)
        self._text.value = describe_primitive(model, row) + ("" if found is not None else "\nnot active in this frame")
        if found is not None:
            self._mark = self._add_meshes("/chosen", found, wire=True)

    def _add_meshes(self, name: str, found: Ellipsoids, wire: bool) -> Any:
        points, faces = unit_sphere(2 if len(found.rows) == 1 else 1)
        return self.session.client.scene.add_batched_meshes_simple(
            name,
            points.astype(np.float32),
            faces.astype(np.uint32),
            batched_wxyzs=found.wxyz,
            batched_positions=found.positions,
            batched_scales=found.scales,
            batched_colors=found.colours,
            wireframe=wire,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

"""The controls of a viewer's browser page (conditions, render settings, held-out views, primitives).

:class:`SessionManager` adds the controls to each opened page.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.conditions import condition_flag, read_conditions
from neuprim.core.errors import NeuprimError
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.settings import SortOrder
from neuprim.inspect.views import unit_sphere
from neuprim.viewer.session import DEFAULT_LONGEST, RenderQueue, Session, ViewerPose
from neuprim.viewer.viewer_scene import (
    FrameEllipsoids,
    ViewerScene,
    describe_viewer_primitive,
    list_viewer_ellipsoids,
    list_viewer_quantities,
    pick_primitive,
)

_MAX_SLIDER_RANGE = 1e4
_PLAY_FPS = 12.0
_NUMBERS = ("samples", "alpha_max", "alpha_min", "transmittance_min", "near")
_NO_VIEW = "none"
_PANEL_HALF = 320  # pixels that half of the panel has at least, on a high-density screen
_NONE, _WIRE, _SOLID = "none", "wire", "solid"
_MAX_ELLIPSOIDS, _DEFAULT_ELLIPSOIDS = 20_000, 1_000
_YELLOW = np.array([[255, 210, 0]], np.uint8)


def format_viewer_condition(spec: ConditionSpec, value: Tensor, world: World) -> str:
    """Return the value of a condition, e.g. time or light position, as text that ``neuprim render`` accepts."""
    digits = 4 if spec.place is None or world.identity else 10
    return ",".join(f"{x:.{digits}g}" for x in spec.given(value, world).flatten().tolist())


class ConditionControls:
    """Controls of each condition of the task, e.g. time or light position: a text field and a play checkbox.

    A number with a bounded range also has a slider, and a position has a draggable handle.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self._updaters: dict[str, Callable[..., None]] = {}
        for spec in session.scene.task.conditions:
            self._add_condition(spec)

    def refresh_conditions(self) -> None:
        """Show the current conditions of the page's session in the controls."""
        for name, update in self._updaters.items():
            update(self.session.conditions[name])

    def _add_condition(self, spec: ConditionSpec) -> None:
        gui, name = self.session.client.gui, spec.name
        low, high = spec.range
        slider: Any = None
        if not spec.shape and high - low <= _MAX_SLIDER_RANGE:
            start = float(self.session.conditions[name].clamp(low, high))
            slider = gui.add_slider(name, low, high, (high - low) / 1000, start)
            slider.on_update(lambda _: self._on_slider(spec, slider.value))
        hint = f"{spec.unit}; as `neuprim render` takes it"
        text = gui.add_text(condition_flag(name), self._format(spec), hint=hint)
        handle = self._add_handle(spec)
        hint = f"{condition_flag(name)} {spec.sweep}, or the values above where they are several"
        play = gui.add_checkbox(f"play {name}", False, hint=hint)

        def update(value: Tensor, typed: bool = False) -> None:
            # Setting a control calls its callback. Controls that already have the value are left alone.
            if slider is not None:
                near = float(value.clamp(low, high))
                if not math.isclose(slider.value, near, abs_tol=1e-6):
                    slider.value = near
            written = format_viewer_condition(spec, value, self.session.scene.world)
            if text.value != written and not play.value and not typed:
                text.value = written
            if handle is not None:
                handle.position = tuple(value.tolist())

        self._updaters[name] = update
        text.on_update(lambda _: self._on_text(spec, text.value))
        play.on_update(lambda _: self._play(spec, text.value, play) if play.value else None)

    def _format(self, spec: ConditionSpec) -> str:
        return format_viewer_condition(spec, self.session.conditions[spec.name], self.session.scene.world)

    def _add_handle(self, spec: ConditionSpec) -> Any:
        """Add a draggable handle to the 3D scene if the condition is a position. Return the handle, or None."""
        if spec.shape != (3,) or "scene units" not in spec.unit:
            return None
        value, scene = self.session.conditions[spec.name], self.session.client.scene
        size = 0.15 * (float(value.norm()) or 1.0)
        scene.add_icosphere(f"/{spec.name}/ball", 0.15 * size, color=(255, 220, 90))
        handle = scene.add_transform_controls(
            f"/{spec.name}", scale=size, disable_rotations=True, disable_sliders=True, position=value.tolist()
        )
        handle.on_update(lambda _: self._set_condition(spec, torch.tensor(handle.position, dtype=torch.float32)))
        return handle

    def _on_slider(self, spec: ConditionSpec, value: float) -> None:
        # A value beyond the slider's range leaves the slider at its end; that is no input.
        if not math.isclose(value, float(self.session.conditions[spec.name].clamp(*spec.range)), abs_tol=1e-6):
            self._set_condition(spec, torch.tensor(value, dtype=torch.float32).clamp(*spec.range))

    def _on_text(self, spec: ConditionSpec, text: str) -> None:
        if text == self._format(spec):
            return
        try:
            self._set_condition(spec, self._parse(spec, text)[0], typed=True)
        except NeuprimError as error:
            self.session.set_status(str(error))  # the text may be incomplete

    def _parse(self, spec: ConditionSpec, text: str) -> list[Tensor]:
        values = read_conditions([spec], {spec.name: text}, self.session.set_status)[spec.name]
        return [value.float() for value in values]

    def _set_condition(self, spec: ConditionSpec, value: Tensor, typed: bool = False) -> None:
        if not torch.equal(value, self.session.conditions[spec.name]):
            self.session.set_conditions({spec.name: value})
            self._updaters[spec.name](value, typed)

    def _play(self, spec: ConditionSpec, text: str, box: Any) -> None:
        """Animate the condition until the user clears the checkbox."""
        session = self.session
        try:
            values = self._parse(spec, text)
            if len(values) == 1 and spec.sweep:
                values = self._parse(spec, spec.sweep)
        except NeuprimError as error:
            box.value = False
            session.report_error(error)
            return
        turn = 0

        def step() -> None:
            nonlocal turn
            if not box.value:
                session.redraw()
                return
            value = values[turn % len(values)]
            turn += 1
            session.conditions |= {spec.name: value}
            session.draw()
            self._updaters[spec.name](value)
            session.submit(f"play {spec.name}", step, 1 / _PLAY_FPS)

        session.submit(f"play {spec.name}", step)


class RenderControls:
    """Controls of the rendered quantity, the resolution and the render settings."""

    def __init__(self, session: Session) -> None:
        self.session = session
        gui, settings = session.client.gui, session.settings
        quantities = list_viewer_quantities(session.scene.channels)
        quantity = gui.add_dropdown("show", quantities, initial_value=session.quantity)
        quantity.on_update(lambda _: self._set_session("quantity", quantity.value))
        hint = "on the longer side of the full picture"
        longest = gui.add_slider("pixels", 128, 2048, 32, DEFAULT_LONGEST, hint=hint)
        longest.on_update(lambda _: self._set_session("longest", int(longest.value)))
        with gui.add_folder("accuracy", expand_by_default=False):
            inputs = {"sort": gui.add_dropdown("sort", list(get_args(SortOrder)), initial_value=settings.sort)}
            for name in _NUMBERS:
                value = getattr(settings, name)
                step = 1 if isinstance(value, int) else min(1e-6, 1e-3 * value or 1e-6)
                inputs[name] = gui.add_number(name, value, step=step)
            for name, control in inputs.items():
                control.on_update(lambda event, name=name: self._set_setting(name, event.target.value))

    def _set_session(self, name: str, value: Any) -> None:
        setattr(self.session, name, value)
        self.session.redraw()

    def _set_setting(self, name: str, value: Any) -> None:
        # Only the setting that was changed here: a page rounds numbers to its own steps.
        settings = self.session.settings
        try:
            self.session.set_settings(replace(settings, **{name: type(getattr(settings, name))(value)}))
        except NeuprimError as error:
            self.session.set_status(str(error))  # the number may be incomplete


class ViewControls:
    """List of held-out views. Choosing a view moves the camera there and shows ground truth, rendering and PSNR."""

    def __init__(self, session: Session, on_jump: Callable[[], None]) -> None:
        self.session, self._on_jump = session, on_jump
        self._image: Any = None
        names, gui = list(session.scene.view_indices), session.client.gui
        if not names:
            return
        self._choice = gui.add_dropdown("held-out view", [_NO_VIEW, *names], initial_value=_NO_VIEW)
        self._choice.on_update(lambda _: self._choose_view(self._choice.value))
        self._folder = gui.add_folder("held-out view", visible=False)
        session.on_full_image.append(self._update_comparison)

    def _choose_view(self, name: str) -> None:
        if name == _NO_VIEW:
            self._folder.visible = False
        else:
            self.session.submit("jump", lambda: self._jump(name))

    def _jump(self, name: str) -> None:
        view = self.session.scene.load_view(name)
        self.session.set_camera(ViewerPose.from_camera(view.camera))
        self.session.set_conditions({key: value.float() for key, value in view.conditions.items()})
        self._on_jump()
        self._show_comparison(name)

    def _update_comparison(self) -> None:
        if self.session.training and self._folder.visible and self._choice.value != _NO_VIEW:
            self._show_comparison(self._choice.value)

    def _show_comparison(self, name: str) -> None:
        truth, drawn, psnr = self.session.scene.compare_view(name)
        times = max(_PANEL_HALF // truth.shape[1], 1)  # each image fills half of the panel
        image = np.concatenate([truth, drawn], axis=1).repeat(times, 0).repeat(times, 1)
        if self._image is None:
            gui = self.session.client.gui
            with self._folder:
                self._image = gui.add_image(image, label="ground truth, and the model", format="jpeg", jpeg_quality=95)
                self._psnr = gui.add_text("PSNR", "", disabled=True)
        self._image.image, self._psnr.value = image, f"{psnr:.2f} dB"
        self._folder.visible = True


class PrimitiveControls:
    """Controls that draw the primitives' ellipsoids over the image and describe a chosen primitive."""

    def __init__(self, session: Session) -> None:
        self.session = session
        gui = session.client.gui
        self._meshes: dict[str, Any] = {}
        self._style = gui.add_dropdown("ellipsoids", [_NONE, _WIRE, _SOLID], initial_value=_NONE)
        hint = "those that absorb most"
        self._limit = gui.add_slider("at most", 100, _MAX_ELLIPSOIDS, 100, _DEFAULT_ELLIPSOIDS, hint=hint)
        hint = "the primitive that contributes most under the mouse"
        self._click = gui.add_checkbox("choose by a click", False, hint=hint)
        self._row = gui.add_number("primitive", -1, min=-1, step=1, hint="its number; -1 for none")
        self._text = gui.add_text("its parameters", "", multiline=True, disabled=True)
        for control in (self._style, self._limit):
            control.on_update(lambda _: self._refresh_primitives())
        self._row.on_update(lambda _: session.submit("primitive", self._describe_chosen))
        self._click.on_update(lambda _: self._toggle_click())

    def _refresh_primitives(self) -> None:
        self.session.submit("ellipsoids", self._draw_ellipsoids)
        if int(self._row.value) >= 0:
            self.session.submit("primitive", self._describe_chosen)

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
            self._row.value = row  # calls _describe_chosen

    def _draw_ellipsoids(self) -> None:
        found = None
        if self._style.value != _NONE:
            scene, limit = self.session.scene, int(self._limit.value)
            found = list_viewer_ellipsoids(scene.model(), self.session.viewpoint(), scene.channels, limit)
        self._show_meshes("/ellipsoids", found, wire=self._style.value == _WIRE)

    def _describe_chosen(self) -> None:
        row, scene, found, text = int(self._row.value), self.session.scene, None, ""
        self._show_meshes("/chosen", None, wire=True)
        if row >= 0:
            text = describe_viewer_primitive(scene.model(), row)
            found = list_viewer_ellipsoids(scene.model(), self.session.viewpoint(), scene.channels, 1, row)
            found = found._replace(colours=_YELLOW.repeat(len(found.rows), 0))
            text += "" if len(found.rows) else "\nnot active in this frame"
        self._text.value = text
        self._show_meshes("/chosen", found, wire=True)

    def _show_meshes(self, name: str, found: FrameEllipsoids | None, wire: bool) -> None:
        """Replace the ellipsoids of viser's scene node ``name`` by ``found``; None only removes the old ellipsoids."""
        if name in self._meshes:
            self._meshes.pop(name).remove()
        if found is None or not len(found.rows):
            return
        points, faces = unit_sphere(2 if len(found.rows) == 1 else 1)
        self._meshes[name] = self.session.client.scene.add_batched_meshes_simple(
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


# ---------------------------------------------------------------- open pages


class SessionManager:
    """Manager of the open pages: it creates a session for each opened page and drops the session of a closed page.

    ``sessions`` maps the id of an open page to its session.
    """

    def __init__(
        self,
        server: Any,
        scene: ViewerScene,
        queue: RenderQueue,
        add_training: Callable[[Session], None] | None = None,
    ) -> None:
        """Start accepting pages.

        Args:
            server: a :class:`~neuprim.viewer.server.ViewerServer`.
            add_training: function that adds the controls of a running training to a page.
        """
        self.server, self.scene, self.queue, self._add_training = server, scene, queue, add_training
        self.sessions: dict[int, Session] = {}
        server.viser.scene.set_up_direction(scene.up)
        server.on_client(self._connect, self._disconnect, self._report_refusal)

    def _connect(self, client: Any) -> None:
        def report(error: Exception) -> None:
            client.add_notification("neuprim", str(error), color="red")
            if not isinstance(error, NeuprimError):
                raise error

        self.queue.submit((client.client_id, "open"), lambda: self._open_session(client), report)

    def _disconnect(self, client: Any) -> None:
        session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()
        self.queue.drop_client(client.client_id)

    def _report_refusal(self, client: int, reason: str) -> None:
        if (session := self.sessions.get(client)) is not None:
            session.set_status(f"refused: {reason}")

    def _open_session(self, client: Any) -> None:
        if client.client_id not in self.server.viser.get_clients():
            return  # closed before its turn
        session = Session(client, self.scene, self.queue, training=self._add_training is not None)
        self.sessions[client.client_id] = session
        tabs = client.gui.add_tab_group()
        if self._add_training is not None:
            with tabs.add_tab("Training"):
                self._add_training(session)
        with tabs.add_tab("View"):
            conditions = ConditionControls(session)
            RenderControls(session)
            ViewControls(session, conditions.refresh_conditions)
        with tabs.add_tab("Primitives"):
            PrimitiveControls(session)

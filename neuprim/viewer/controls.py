"""Controls of a page: conditions such as time and light, render settings, and held-out views."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.conditions import flag, read_conditions
from neuprim.core.errors import NeuprimError
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.settings import SortOrder
from neuprim.viewer.session import DEFAULT_LONGEST, Pose, Session
from neuprim.viewer.viewer_scene import list_quantities

_MAX_SLIDER_RANGE = 1e4
_PLAY_FPS = 12.0
_NUMBERS = ("samples", "alpha_max", "alpha_min", "transmittance_min", "near")
_NO_VIEW = "none"
_PANEL_HALF = 320  # pixels that half of the panel has at least, on a high-density screen


def format_condition(spec: ConditionSpec, value: Tensor, world: World) -> str:
    """Write a condition's value as ``neuprim render`` takes it."""
    digits = 4 if spec.place is None or world.identity else 10
    return ",".join(f"{x:.{digits}g}" for x in spec.given(value, world).flatten().tolist())


class ConditionControls:
    """Per condition: a text, a slider if its range is bounded, a handle if it is a position, and a play button."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._updaters: dict[str, Callable[..., None]] = {}
        for spec in session.scene.task.conditions:
            self._add(spec)

    def refresh(self) -> None:
        """Show the session's conditions in the controls."""
        for name, update in self._updaters.items():
            update(self.session.conditions[name])

    def _add(self, spec: ConditionSpec) -> None:
        gui, name = self.session.client.gui, spec.name
        low, high = spec.range
        slider: Any = None
        if not spec.shape and high - low <= _MAX_SLIDER_RANGE:
            slider = gui.add_slider(name, low, high, (high - low) / 1000, float(self._value(spec).clamp(low, high)))
            slider.on_update(lambda _: self._on_slider(spec, slider.value))
        hint = f"{spec.unit}; as `neuprim render` takes it"
        text = gui.add_text(flag(name), self._format(spec, self._value(spec)), hint=hint)
        handle = self._add_handle(spec)
        hint = f"{flag(name)} {spec.sweep}, or the values above where they are several"
        play = gui.add_checkbox(f"play {name}", False, hint=hint)

        def update(value: Tensor, typed: bool = False) -> None:
            # Setting a control calls its callback. Controls that already have the value are left alone.
            near = float(value.clamp(low, high)) if slider is not None else 0.0
            if slider is not None and not math.isclose(slider.value, near, abs_tol=1e-6):
                slider.value = near
            if text.value != self._format(spec, value) and not play.value and not typed:
                text.value = self._format(spec, value)
            if handle is not None:
                handle.position = tuple(value.tolist())

        self._updaters[name] = update
        text.on_update(lambda _: self._on_text(spec, text.value))
        play.on_update(lambda _: self._play(spec, text.value, play) if play.value else None)

    def _format(self, spec: ConditionSpec, value: Tensor) -> str:
        return format_condition(spec, value, self.session.scene.world)

    def _value(self, spec: ConditionSpec) -> Tensor:
        return self.session.conditions[spec.name]

    def _add_handle(self, spec: ConditionSpec) -> Any:
        """Add a draggable handle for a position in the scene."""
        if spec.shape != (3,) or "scene units" not in spec.unit:
            return None
        value, scene = self._value(spec), self.session.client.scene
        size = 0.15 * (float(value.norm()) or 1.0)
        scene.add_icosphere(f"/{spec.name}/ball", 0.15 * size, color=(255, 220, 90))
        handle = scene.add_transform_controls(
            f"/{spec.name}", scale=size, disable_rotations=True, disable_sliders=True, position=value.tolist()
        )
        handle.on_update(lambda _: self._set(spec, torch.tensor(handle.position, dtype=torch.float32)))
        return handle

    def _on_slider(self, spec: ConditionSpec, value: float) -> None:
        # A value beyond the slider's range leaves the slider at its end; that is no input.
        if not math.isclose(value, float(self._value(spec).clamp(*spec.range)), abs_tol=1e-6):
            self._set(spec, torch.tensor(value, dtype=torch.float32).clamp(*spec.range))

    def _on_text(self, spec: ConditionSpec, text: str) -> None:
        if text == self._format(spec, self._value(spec)):
            return
        try:
            self._set(spec, self._parse(spec, text)[0], typed=True)
        except NeuprimError as error:
            self.session.set_status(str(error))  # the text may be incomplete

    def _parse(self, spec: ConditionSpec, text: str) -> list[Tensor]:
        values = read_conditions([spec], {spec.name: text}, self.session.set_status)[spec.name]
        return [value.float() for value in values]

    def _set(self, spec: ConditionSpec, value: Tensor, typed: bool = False) -> None:
        if not torch.equal(value, self._value(spec)):
            self.session.set_conditions({spec.name: value})
            self._updaters[spec.name](value, typed)

    def _play(self, spec: ConditionSpec, text: str, box: Any) -> None:
        """Animate the condition until the box is cleared."""
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
    """Quantity, resolution and render settings; with ``overrides`` also those of a render configuration."""

    def __init__(self, session: Session, overrides: bool) -> None:
        self.session = session
        self._values: dict[str, Any] = {}
        gui, settings = session.client.gui, session.settings
        quantity = gui.add_dropdown("show", list_quantities(session.scene.channels), initial_value=session.quantity)
        quantity.on_update(lambda _: self._set_session("quantity", quantity.value))
        hint = "on the longer side of the full picture"
        longest = gui.add_slider("pixels", 128, 2048, 32, DEFAULT_LONGEST, hint=hint)
        longest.on_update(lambda _: self._set_session("longest", int(longest.value)))
        self._overrides: Any = None
        with gui.add_folder("accuracy", expand_by_default=False):
            inputs = {"sort": gui.add_dropdown("sort", list(get_args(SortOrder)), initial_value=settings.sort)}
            for name in _NUMBERS:
                value = getattr(settings, name)
                step = 1 if isinstance(value, int) else min(1e-6, 1e-3 * value or 1e-6)
                inputs[name] = gui.add_number(name, value, step=step)
            if overrides:
                hint = "as `neuprim render` takes it: resolution=0.5 density.neurons=1"
                self._overrides = gui.add_text("operating point", "", hint=hint)
                self._overrides.on_update(lambda _: self._apply())
            for name, control in inputs.items():
                control.on_update(lambda event, name=name: self._set_setting(name, event.target.value))

    def _set_session(self, name: str, value: Any) -> None:
        setattr(self.session, name, value)
        self.session.redraw()

    def _set_setting(self, name: str, value: Any) -> None:
        # Only settings that were changed here: a page rounds numbers to its own steps.
        self._values[name] = type(getattr(self.session.scene.settings, name))(value)
        self._apply()

    def _apply(self) -> None:
        try:
            words = tuple(self._overrides.value.split()) if self._overrides is not None else ()
            self.session.set_settings(replace(self.session.scene.settings, **self._values), words)
        except NeuprimError as error:
            self.session.set_status(str(error))  # the text may be incomplete


class ViewControls:
    """A list of held-out views. Choosing one moves the camera there and shows ground truth, rendering and PSNR."""

    def __init__(self, session: Session, on_jump: Callable[[], None]) -> None:
        self.session, self._on_jump = session, on_jump
        self._image: Any = None
        names, gui = session.scene.list_views(), session.client.gui
        if not names:
            return
        self._choice = gui.add_dropdown("held-out view", [_NO_VIEW, *names], initial_value=_NO_VIEW)
        self._choice.on_update(lambda _: self._choose(self._choice.value))
        self._folder = gui.add_folder("held-out view", visible=False)
        session.on_full_image.append(self._update)

    def _choose(self, name: str) -> None:
        if name == _NO_VIEW:
            self._folder.visible = False
        else:
            self.session.submit("jump", lambda: self._jump(name))

    def _jump(self, name: str) -> None:
        view = self.session.scene.load_view(name)
        self.session.set_camera(Pose.from_camera(view.camera))
        self.session.set_conditions({key: value.float() for key, value in view.conditions.items()})
        self._on_jump()
        self._compare(name)

    def _update(self) -> None:
        if self.session.training and self._folder.visible and self._choice.value != _NO_VIEW:
            self._compare(self._choice.value)

    def _compare(self, name: str) -> None:
        found = self.session.scene.compare_view(name)
        image = np.concatenate([_enlarge(found.truth), _enlarge(found.drawn)], axis=1)
        if self._image is None:
            gui = self.session.client.gui
            with self._folder:
                self._image = gui.add_image(image, label="ground truth, and the model", format="jpeg", jpeg_quality=95)
                self._psnr = gui.add_text("PSNR", "", disabled=True)
        self._image.image, self._psnr.value = image, f"{found.psnr:.2f} dB"
        self._folder.visible = True


def _enlarge(image: np.ndarray) -> np.ndarray:
    """Repeat pixels of a small image, so that it fills half of the panel."""
    times = max(_PANEL_HALF // image.shape[1], 1)
    return image.repeat(times, 0).repeat(times, 1)

"""Controls made of what a task's frames depend on: time, light and their like, in the grammar of ``--time`` and
``--light``."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.conditions import flag, read_conditions
from neuprim.core.errors import NeuprimError
from neuprim.core.model.fields import ConditionSpec
from neuprim.viewer.session import Session

__all__ = ["ConditionControls", "shown"]

_WIDE = 1e4
"""A range wider than this has no slider."""

_FPS = 12.0


def shown(spec: ConditionSpec, value: Tensor, world: World) -> str:
    """A condition's value as one types it."""
    digits = 4 if spec.place is None or world.identity else 10
    return ",".join(f"{x:.{digits}g}" for x in spec.given(value, world).flatten().tolist())


class ConditionControls:
    """A text per condition, a slider for a number within a range, a handle in the scene for a place, and a button that
    plays."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._shows: dict[str, Callable[..., None]] = {}
        for spec in session.subject.task.conditions:
            self._add(spec)

    def show(self) -> None:
        """Let the controls say what the page looks at, after something else changed it."""
        for name, show in self._shows.items():
            show(self.session.conditions[name])

    def _add(self, spec: ConditionSpec) -> None:
        gui, name = self.session.client.gui, spec.name
        low, high = spec.range
        slider: Any = None
        if not spec.shape and high - low <= _WIDE:
            slider = gui.add_slider(name, low, high, (high - low) / 1000, float(self._value(spec).clamp(low, high)))
            slider.on_update(lambda _: self._slid(spec, slider.value))
        text = gui.add_text(
            flag(name), self._shown(spec, self._value(spec)), hint=f"{spec.unit}; as `neuprim render` takes it"
        )
        handle = self._handle(spec)
        play = gui.add_checkbox(
            f"play {name}", False, hint=f"{flag(name)} {spec.sweep}, or the values above where they are several"
        )

        def show(value: Tensor, typed: bool = False) -> None:
            # Setting a value calls back as typing it does; what is there already is left alone, so that this ends.
            near = float(value.clamp(low, high)) if slider is not None else 0.0
            if slider is not None and not math.isclose(slider.value, near, abs_tol=1e-6):
                slider.value = near
            if (
                text.value != self._shown(spec, value) and not play.value and not typed
            ):  # a text of several values stays as it was typed
                text.value = self._shown(spec, value)
            if handle is not None:
                handle.position = tuple(value.tolist())

        self._shows[name] = show
        text.on_update(lambda _: self._typed(spec, text.value))
        play.on_update(lambda _: self._play(spec, text.value, play) if play.value else None)

    def _shown(self, spec: ConditionSpec, value: Tensor) -> str:
        return shown(spec, value, self.session.subject.world)

    def _value(self, spec: ConditionSpec) -> Tensor:
        return self.session.conditions[spec.name]

    def _handle(self, spec: ConditionSpec) -> Any:
        """Something to drag, of a condition that is a place in the scene."""
        if spec.shape != (3,) or "scene units" not in spec.unit:
            return None
        value = self._value(spec)
        size = 0.15 * (float(value.norm()) or 1.0)
        client = self.session.client
        client.scene.add_icosphere(f"/{spec.name}/ball", 0.15 * size, color=(255, 220, 90))
        handle = client.scene.add_transform_controls(
            f"/{spec.name}", scale=size, disable_rotations=True, disable_sliders=True, position=value.tolist()
        )
        handle.on_update(lambda _: self._set(spec, torch.tensor(handle.position, dtype=torch.float32)))
        return handle

    def _slid(self, spec: ConditionSpec, value: float) -> None:
        if not math.isclose(
            value, float(self._value(spec).clamp(*spec.range)), abs_tol=1e-6
        ):  # beyond its ends the slider says nothing
            self._set(spec, torch.tensor(value, dtype=torch.float32).clamp(*spec.range))

    def _typed(self, spec: ConditionSpec, text: str) -> None:
        if text == self._shown(spec, self._value(spec)):
            return
        try:
            self._set(spec, self._read(spec, text)[0], typed=True)
        except NeuprimError as error:
            self.session.say(str(error))  # it may not be typed to its end yet

    def _read(self, spec: ConditionSpec, text: str) -> list[Tensor]:
        """Raises ConfigError as a command would."""
        return [value.float() for value in read_conditions([spec], {spec.name: text}, self.session.say)[spec.name]]

    def _set(self, spec: ConditionSpec, value: Tensor, typed: bool = False) -> None:
        if not torch.equal(value, self._value(spec)):
            self.session.set_conditions({spec.name: value})
            self._shows[spec.name](value, typed)

    def _play(self, spec: ConditionSpec, text: str, box: Any) -> None:
        """Go through several values, again and again, as long as the box is ticked."""
        try:
            values = self._read(spec, text)
            if len(values) == 1:
                values = self._read(spec, spec.sweep) if spec.sweep else values
        except NeuprimError as error:
            box.value = False
            self.session.failed(error)
            return
        turn = 0

        def step() -> None:
            nonlocal turn
            if not box.value:
                self.session.changed()
                return
            value = values[turn % len(values)]
            turn += 1
            self.session.conditions |= {spec.name: value}
            self.session.draw()
            self._shows[spec.name](value)
            self.session.ask(f"play {spec.name}", step, 1 / _FPS)

        self.session.ask(f"play {spec.name}", step)

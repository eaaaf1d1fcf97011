"""Layers of an image: what ``neuprim render --format exr`` can write of a frame beside its beauty.

Every task's frames have those of :data:`COMMON`; a task says which others its frames have
(:attr:`neuprim.core.task.TaskSpec.layers`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from neuprim.core.errors import ConfigError
from neuprim.core.io.exr import channel_name_error
from neuprim.core.render.layer_frame import LayerFrame


@dataclass(frozen=True)
class LayerSpec:
    """One layer.

    Attributes:
        name: what the user types after ``--layers``, and the prefix of its channels in the file: letters, digits and _.
        summary: one line that says what a value is and in which unit; it is written into the file, too.
        draw: :class:`~neuprim.core.render.layer_frame.LayerFrame` -> (H, W, C) finite values; (H, W) where there is one
        channel. None where the frame's
            model has no such thing.
        channels: their names; empty: light, with the channels of the task's images, over black, that is premultiplied
        by alpha. Light is left
            to models whose colours are linear light, as sums of it mean nothing else; and it adds up over the lights of
            an environment.
    """

    name: str
    summary: str
    draw: Callable[[LayerFrame], Tensor | None]
    channels: tuple[str, ...] = ()

    @property
    def light(self) -> bool:
        """Whether its values are light."""
        return not self.channels


LIGHTS = "lights"
"""Stands for a layer per light, ``light_000`` and so on, where several are on."""

COMMON: tuple[LayerSpec, ...] = (
    LayerSpec("beauty", "the image, linear light, premultiplied by alpha", lambda frame: frame.drawn.rgb),
    LayerSpec("alpha", "accumulated opacity, 0 to 1", lambda frame: frame.drawn.alpha, ("A",)),
    LayerSpec(
        "depth",
        "distance from the camera's plane (camera z), in the units of the data's files: the mean over the chord middles of what the pixel shows, weighted by its "
        "part in the pixel; 0 where alpha is 0",
        lambda frame: frame.drawn.depth,
        ("Z",),
    ),
    LayerSpec(
        "density",
        "density integral: the optical depth of the whole ray behind the near plane, without unit",
        LayerFrame.integral,
        ("Y",),
    ),
)
"""Those of every task."""


def layer_fault(layers: object) -> str | None:
    """``"WHAT; expected WHAT"`` of the first fault of what a task says its layers are; None if all is well."""
    if not isinstance(layers, tuple | list):
        return f" is of type {type(layers).__name__}; expected a tuple of LayerSpec"
    taken = {spec.name for spec in COMMON} | {LIGHTS}
    for i, spec in enumerate(layers):
        if not isinstance(spec, LayerSpec):
            return f"[{i}] is of type {type(spec).__name__}; expected a LayerSpec"
        if (
            not isinstance(spec.name, str)
            or not spec.name.isidentifier()
            or not spec.name.isascii()
            or len(spec.name) > 31
        ):
            return f"[{i}].name is {spec.name!r}; expected at most 31 letters, digits and _"
        if spec.name in taken or spec.name.startswith("light_"):
            return f"[{i}].name is {spec.name!r}, which is taken; expected another name"
        if not isinstance(spec.summary, str) or not spec.summary.strip():
            return f"[{i}].summary is {spec.summary!r}; expected text"
        if not callable(spec.draw):
            return f"[{i}].draw is of type {type(spec.draw).__name__}; expected a function"
        if not isinstance(spec.channels, tuple | list):
            return f"[{i}].channels is of type {type(spec.channels).__name__}; expected a tuple of names"
        wrong = channel_name_error(spec.channels)
        if wrong:
            return f"[{i}].channels{wrong}"
        taken.add(spec.name)
    return None


def chosen_layers(text: str | None, own: Sequence[LayerSpec], several: bool) -> tuple[LayerSpec, ...]:
    """The layers that ``--layers`` names, in the order of the list of all; all of them without it.

    Args:
        text: names separated by commas, or None.
        own: the task's.
        several: whether several lights are on. Then what is not light and depends on one of them, a task's own numbers,
        is not offered.

    Raises:
        ConfigError: a name that is none of them, or nothing.
    """
    offered = (*COMMON, *(spec for spec in own if spec.light or not several))
    if text is None:
        return offered
    names = [part.strip() for part in text.split(",") if part.strip()]
    known = [spec.name for spec in offered] + [LIGHTS] * several
    for name in names:
        if name not in known:
            raise ConfigError(f"--layers {name}: no such layer; expected some of {', '.join(known)}")
    if not names:
        raise ConfigError(f"--layers {text!r}: names none; expected some of {', '.join(known)}")
    return tuple(spec for spec in offered if spec.name in names)

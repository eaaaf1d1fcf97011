"""Layers that ``neuprim render --format exr`` can write besides the image itself.

Every task has those of :data:`COMMON`; :attr:`neuprim.core.task.TaskSpec.layers` adds others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from neuprim.core.errors import ConfigError
from neuprim.core.render.layer_frame import LayerFrame


@dataclass(frozen=True)
class LayerSpec:
    """One layer.

    Attributes:
        name: what the user types after ``--layers``, and the prefix of its channels in the file: letters, digits, _.
        summary: one line with the meaning and unit of a value; it is written into the file, too.
        draw: :class:`~neuprim.core.render.layer_frame.LayerFrame` -> (H, W, C) finite values, or (H, W) for one
            channel; None if the frame's model has no such layer.
        channels: their names. Empty for layers of light, which have the channels of the task's images over black,
            premultiplied by alpha, and are sums over the lights of an environment. They need linear colours.
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
"""Stands for one layer per light, ``light_000`` and so on, if several are on."""

COMMON: tuple[LayerSpec, ...] = (
    LayerSpec("beauty", "the image, linear light, premultiplied by alpha", lambda frame: frame.drawn.rgb),
    LayerSpec("alpha", "accumulated opacity, 0 to 1", lambda frame: frame.drawn.alpha, ("A",)),
    LayerSpec(
        "depth",
        "distance from the camera's plane (camera z), in the units of the data's files: the mean over the chord "
        "middles "
        "of what the pixel shows, weighted by its part in the pixel; 0 where alpha is 0",
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
"""Layers of every task."""


def select_layers(text: str | None, own: Sequence[LayerSpec], several: bool) -> tuple[LayerSpec, ...]:
    """Select the layers that ``--layers`` names, in the order of the list of all; without it, all layers.

    Args:
        text: names separated by commas, or None.
        own: the task's layers.
        several: whether several lights are on. Then the task's layers that are not light are not offered.

    Raises:
        ConfigError: an unknown name, or no name.
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

"""An operating point: how a finished model is drawn, in words that one can paste.

    renderer.KEY=VALUE       any setting of the renderer, over the run's own
    resolution=0.5           drawn at half the width and height, and enlarged by bilinear interpolation
    density.NAME=N           a density that does with less of something, such as neurons (Field.reductions)
    colour.NAME=N            the same of a colour: bands of spherical harmonics, terms in time
    store.GROUP=FORMAT       means, shape, density or colour, or all, as a format of neuprim.runs.storage brings them
    back

``neuprim render``, ``neuprim eval`` and ``neuprim tradeoff`` take them after the run directory.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from neuprim.config.overrides import assigned, parse
from neuprim.core.cameras.rays import AnyCamera
from neuprim.core.checked import Range, checked, converted
from neuprim.core.data import View
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.reduction import KINDS, reduce_model, reduction_names, validate_reduction
from neuprim.core.render import RenderSettings, backends, render
from neuprim.runs.storage import ALL, FORMATS, FULL, GROUPS, rounded

__all__ = ["HEADS", "OperatingPoint", "read_point"]

HEADS = ("renderer", "resolution", "density", "colour", "store")
"""What the words of an operating point begin with."""

_Resolution = Annotated[float, Range(above=0, at_most=1, says="a factor above 0, at most 1")]


@dataclass(frozen=True)
class OperatingPoint:
    """How to draw a model.

    Attributes:
        settings: of the renderer.
        resolution: of width and height, above 0 and at most 1.
        reduced: ("density" or "colour", setting) -> its smaller value.
        stored: group of parameters -> name of a format.
    """

    settings: RenderSettings = field(default_factory=RenderSettings)
    resolution: float = 1.0
    reduced: Mapping[tuple[str, str], int] = field(default_factory=dict)
    stored: Mapping[str, str] = field(default_factory=dict)

    def words(self, usual: RenderSettings) -> tuple[str, ...]:
        """What :func:`read_point` makes it of again, over ``usual`` settings."""
        values = dataclasses.asdict(self.settings)
        before = dataclasses.asdict(usual)
        found = [_word(f"renderer.{name}", value) for name, value in values.items() if value != before[name]]
        found += [_word("resolution", self.resolution)] if self.resolution != 1.0 else []
        found += [f"{kind}.{name}={value}" for (kind, name), value in self.reduced.items()]
        formats = set(self.stored.values())
        if len(self.stored) == len(GROUPS) and len(formats) == 1 and formats != {FULL}:
            return (*found, f"store.{ALL}={formats.pop()}")
        return (*found, *(f"store.{group}={name}" for group, name in self.stored.items() if name != FULL))

    def applied(self, model: Primitives) -> Primitives:
        """The model as it is drawn, itself if nothing of it changes: fields reduced first, then numbers rounded.

        Raises:
            ConfigError: a format does not hold some value.
        """
        smaller = model
        for (kind, name), value in self.reduced.items():
            smaller = reduce_model(smaller, kind, name, value)
        return rounded(smaller, self.stored)

    def seen(self, view: View) -> View:
        """The view at the resolution that it is drawn at."""
        if self.resolution == 1.0:
            return view
        size = (max(1, round(self.resolution * side)) for side in (view.camera.width, view.camera.height))
        return replace(view, camera=view.camera.resized(*size))

    def enlarged(self, image: Tensor, camera: AnyCamera) -> Tensor:
        """(H, W, C) of the camera's own size."""
        if image.shape[:2] == (camera.height, camera.width):
            return image
        size = (camera.height, camera.width)
        return (
            interpolate(image.permute(2, 0, 1)[None], size, mode="bilinear", align_corners=False)[0]
            .permute(1, 2, 0)
            .contiguous()
        )

    def draw(
        self, model: Primitives, view: View, background: Tensor, drawn: Callable[[Tensor], None] = lambda alpha: None
    ) -> Tensor:
        """(H, W, C) image of a view of an :meth:`applied` model, without gradients; on the processor.

        Args:
            drawn: called with the image's alpha.
        """
        small = self.seen(view)
        with torch.no_grad():
            frame = render(model, small.camera, small.conditions, self.settings, background)
        drawn(frame.alpha)
        return self.enlarged(frame.rgb.cpu(), view.camera)


def read_point(words: Sequence[str], usual: RenderSettings, model: Primitives) -> OperatingPoint:
    """The operating point that words name, over ``usual`` settings, for a model.

    Raises:
        ConfigError: a word that is none of :data:`HEADS`, a setting or format that does not exist, something that the
        model's fields cannot
            do with less of, or a value that does not fit; one line with key, found and expected.
    """
    values: dict[str, Any] = dataclasses.asdict(usual)
    resolution, reduced, stored = 1.0, dict[tuple[str, str], int](), dict[str, str]()
    for assignment in parse(words):
        head, dot, name = assignment.key.partition(".")
        if head == "resolution" and not dot:
            resolution = converted(assignment.value, _Resolution, "resolution")
        elif head == "renderer" and dot:
            values[name] = assignment.value
        elif head in KINDS and dot:
            reduced[head, name] = validate_reduction(model.density, model.colour, head, name, assignment.value)
        elif head == "store" and dot:
            stored |= dict.fromkeys(GROUPS if name == ALL else [name], _format(name, assignment.value))
        else:
            known = [f"renderer.{name}" for name in values] + [
                "resolution",
                *(f"store.{name}" for name in (*GROUPS, ALL)),
                *reduction_names(model.density, model.colour),
            ]
            raise ConfigError(
                f"{assignment.key}: nothing that a finished run is drawn by{nearest(assignment.key, known)}"
            )
    settings = checked(RenderSettings, values, "renderer")
    if settings.near == "auto":
        settings = dataclasses.replace(settings, near=usual.near)  # what the run's training decided
    backends.check_name(settings.backend)
    backends.check_pair(settings)
    return OperatingPoint(settings, resolution, dict(sorted(reduced.items())), dict(sorted(stored.items())))


def _format(group: str, name: Any) -> str:
    if group not in (*GROUPS, ALL):
        raise ConfigError(f"store.{group}: no such group of parameters{nearest(group, (*GROUPS, ALL))}")
    if name not in FORMATS:
        raise ConfigError(f"store.{group}={name}: no such format{nearest(str(name), FORMATS)}")
    return str(name)


def _word(key: str, value: Any) -> str:
    """``key=value`` as the grammar of words reads it back; whole numbers without a point."""
    if isinstance(value, str):
        return assigned(key, value)
    return f"{key}={str(value).lower() if isinstance(value, bool) else repr(value).removesuffix('.0')}"

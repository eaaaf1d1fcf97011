"""What the user may set for a scene made of OpenVDB files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from neuprim.core.errors import ConfigError, DataError, nearest

__all__ = ["GRIDS", "VolumeSettings", "choose_frames"]

GRIDS = ("density", "temperature", "flames", "color")
"""What a grid may mean; ``scene.grids.MEANING=NAME`` says which grid of the files has it."""


@dataclass(frozen=True)
class VolumeSettings:
    """Settings of a volume scene.

    Attributes:
        vdb: folder of .vdb files, or None to simulate.
        simulation: name of the built-in simulation.
        resolution: voxels across the simulation's box.
        timesteps: of the simulation; None: as many as the scene has.
        frames: "all", "FIRST:LAST" or "FIRST:LAST:STEP" by number, LAST included.
        grids: meaning -> name in the files.
        look: name of a preset of the optics, or "auto"; optics: changes to its settings.
        size: width and height of the images in pixels.
        cameras: on the upper hemisphere; two are held out.
        field_of_view: of the cameras, degrees.
        samples: rays per pixel side.
        train_every: learn from every n-th frame only; the test views keep all.
        up: "y" or "z", the upward axis of the files.
    """

    vdb: Path | None = None
    simulation: str | None = None
    resolution: int = 64
    timesteps: int | None = None
    frames: str = "all"
    grids: Mapping[str, str] = field(default_factory=dict)
    look: str = "auto"
    optics: Mapping[str, Any] = field(default_factory=dict)
    size: int = 64
    cameras: int = 40
    field_of_view: float = 27.0
    samples: int = 2
    train_every: int = 1
    up: str = "z"

    @staticmethod
    def parse(settings: Mapping[str, Any]) -> VolumeSettings:
        """Settings from a mapping; :class:`ConfigError` for an unknown name or impossible value."""
        known = [f.name for f in fields(VolumeSettings)]
        for name in settings:
            if name not in known:
                raise ConfigError(f"scene.{name} is not a setting of this scene{nearest(str(name), known)}")
        made = VolumeSettings(**{**settings, "vdb": Path(settings["vdb"]) if settings.get("vdb") else None})
        limits = (("resolution", 16, 192), ("size", 8, 4096), ("cameras", 4, 1000), ("samples", 1, 16), ("train_every", 1, 1000))
        for name, lowest, highest in limits:
            value = getattr(made, name)
            if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= highest:
                raise ConfigError(f"scene.{name}={value!r}: expected a whole number from {lowest} to {highest}")
        if isinstance(made.field_of_view, bool) or not isinstance(made.field_of_view, int | float) or not 1 <= made.field_of_view <= 120:
            raise ConfigError(f"scene.field_of_view={made.field_of_view!r}: expected degrees from 1 to 120")
        if made.timesteps is not None and not (isinstance(made.timesteps, int) and 2 <= made.timesteps <= 1000):
            raise ConfigError(f"scene.timesteps={made.timesteps!r}: expected a whole number from 2 to 1000, or null")
        if made.up not in ("y", "z"):
            raise ConfigError(f"scene.up={made.up!r}: expected y or z")
        for meaning, grid in made.grids.items():
            if meaning not in GRIDS:
                raise ConfigError(f"scene.grids.{meaning}: no such meaning{nearest(meaning, GRIDS)}")
            if not isinstance(grid, str) or not grid:
                raise ConfigError(f"scene.grids.{meaning}={grid!r}: expected the name of a grid")
        if made.vdb is None and made.simulation is None:
            raise ConfigError("scene.vdb: required and not given; expected a folder of .vdb files")
        choose_frames(made.frames, [])
        return made


def choose_frames(text: str, numbers: Sequence[int], where: str = "the sequence") -> list[int]:
    """Those of the ascending frame ``numbers`` that ``text`` names; all that an empty sequence is asked is whether the text is right.

    Raises:
        ConfigError: another form than "all", "FIRST:LAST" or "FIRST:LAST:STEP".
        DataError: none of the frames exists.
    """
    if text == "all":
        return list(numbers)
    match = re.fullmatch(r"(\d{1,9}):(\d{1,9})(?::(\d{1,9}))?", text)
    if match is None or (step := int(match[3] or 1)) < 1 or int(match[1]) > int(match[2]):
        raise ConfigError(f"scene.frames={text}: expected all, FIRST:LAST or FIRST:LAST:STEP, as 0:100:2")
    wanted = range(int(match[1]), int(match[2]) + 1, step)
    chosen = [n for n in numbers if n in wanted]
    if numbers and not chosen:
        raise DataError(f"scene.frames={text}: {where} has frames {numbers[0]} to {numbers[-1]}, and none of these")
    return chosen

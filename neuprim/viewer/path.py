"""A camera path: keys that a person sets, a smooth way through them, and the file of cameras that ``neuprim render
--camera`` reads."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.errors import ConfigError
from neuprim.core.io.files import write_json
from neuprim.core.model.fields import ConditionSpec
from neuprim.viewer.poses import Pose

__all__ = ["CameraPath", "Key", "condition_texts"]

MOST = 10_000
"""Frames of a film."""


@dataclass(frozen=True, eq=False)
class Key:
    """Where the camera is at one moment of the film, and under which conditions."""

    pose: Pose
    conditions: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass
class CameraPath:
    """Keys at equal distances in time.

    Attributes:
        seconds: from the first key to the last one.
        fps: frames per second.
    """

    keys: list[Key] = field(default_factory=list)
    seconds: float = 4.0
    fps: float = 24.0

    @property
    def frames(self) -> int:
        """Of the film, the keys at both ends among them."""
        return min(max(round(self.seconds * self.fps), 2), MOST) if len(self.keys) > 1 else len(self.keys)

    def move(self, index: int, by: int) -> int:
        """Let a key change places with the one before (``by`` -1) or after it (1); its new index."""
        other = index + by
        if 0 <= index < len(self.keys) and 0 <= other < len(self.keys):
            self.keys[index], self.keys[other] = self.keys[other], self.keys[index]
            return other
        return index

    def poses(self, count: int) -> list[Pose]:
        """So many poses along the path: positions and fields of view on a natural cubic spline, orientations on a
        rotation spline.

        Raises:
            ConfigError: there is no key.
        """
        if not self.keys:
            raise ConfigError("the camera path has no keys; add some first")
        if len(self.keys) == 1:
            return [self.keys[0].pose] * count
        knots, at = np.arange(len(self.keys)), np.linspace(0, len(self.keys) - 1, count)
        positions = CubicSpline(knots, np.stack([key.pose.position for key in self.keys]), bc_type="natural")(at)
        fovs = np.interp(at, knots, [key.pose.fov for key in self.keys])
        turns = RotationSpline(knots, Rotation.concatenate([key.pose.rotation for key in self.keys]))(at)
        quats = turns.as_quat()[:, [3, 0, 1, 2]]
        return [Pose(q, p, float(f)) for q, p, f in zip(quats, positions, fovs, strict=True)]

    def conditions(self, specs: Sequence[ConditionSpec], count: int) -> list[dict[str, Tensor]]:
        """So many values of every condition, straight from key to key.

        Raises:
            ConfigError: there is no key.
        """
        if not self.keys:
            raise ConfigError("the camera path has no keys; add some first")
        at = np.linspace(0, len(self.keys) - 1, count)
        frames: list[dict[str, Tensor]] = [{} for _ in at]
        for spec in specs:
            values = torch.stack([key.conditions[spec.name].double() for key in self.keys])
            for frame, t in zip(frames, at, strict=True):
                i = min(int(t), max(len(values) - 2, 0))
                part = values[i] if len(values) == 1 else torch.lerp(values[i], values[i + 1], float(t) - i)
                frame[spec.name] = part.float()
        return frames

    def to_json(self, size: tuple[int, int], world: World) -> dict[str, Any]:
        """What :func:`~neuprim.core.cameras.file.read_cameras` reads, one frame per image of the film, in the
        coordinates of ``world``.

        Raises:
            ConfigError: there is no key.
        """
        width, height = size
        return {
            "w": width,
            "h": height,
            "fps": self.fps,
            "frames": [_frame(pose, size, world) for pose in self.poses(self.frames)],
        }

    def write(self, path: Path, size: tuple[int, int], world: World) -> None:
        """Write the file, whole or not at all, with images of ``size`` (width, height) pixels."""
        write_json(path, self.to_json(size, world))


def condition_texts(
    frames: Sequence[Mapping[str, Tensor]], specs: Sequence[ConditionSpec], world: World
) -> dict[str, str]:
    """What ``neuprim render`` is given for the conditions of a film's frames: ``{"time": "0,0.1,0.2"}``, or one value
    where they are equal.

    Raises:
        ConfigError: a condition of several numbers changes, for which the command has no list.
    """
    texts: dict[str, str] = {}
    for spec in specs:
        values = [frame[spec.name] for frame in frames]
        same = all(torch.equal(value, values[0]) for value in values)
        if not same and math.prod(spec.shape) != 1:
            raise ConfigError(
                f"{spec.name}: changes along the path; a film has one {spec.name}, or several that are single numbers"
            )
        shown = values[:1] if same else values
        digits = 6 if spec.place is None or world.identity else 12
        texts[spec.name] = ",".join(
            f"{x:.{digits}g}" for value in shown for x in spec.given(value, world).flatten().tolist()
        )
    return texts


def _frame(pose: Pose, size: tuple[int, int], world: World) -> dict[str, Any]:
    """A frame of the file: camera-to-world with OpenGL axes, focal length in pixels."""
    width, height = size
    if not world.identity:
        pose = Pose.of(world.world_camera(pose.camera(width, height)))
    matrix = np.eye(4)
    matrix[:3, :3] = pose.rotation.as_matrix() @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = pose.position
    focal = 0.5 * height / math.tan(0.5 * pose.fov)
    return {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "transform_matrix": matrix.tolist()}

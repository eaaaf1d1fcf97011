"""Transform between the coordinates of the user's files (world) and the coordinates of the model (scene)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import Camera, RayCamera
from neuprim.core.errors import DataError
from neuprim.core.io.json_reader import JsonReader

__all__ = ["World"]

_ROTATION = 1e-6  # how far a matrix over its scale may be from a rotation

_Camera = TypeVar("_Camera", Camera, RayCamera)


@dataclass(frozen=True, eq=False)
class World:
    """Transform between world coordinates (of the user's files) and scene coordinates (of the model).

    The transform is a rotation, one scale and an offset. Models are in scene units, mostly float32. Coordinates that
    users give or get (cameras, lights, boxes, exported positions) are world coordinates in float64.

    Attributes:
        scene_from_world: (4, 4) float64 matrix that maps world to scene coordinates.
        up: (3,) upward direction in scene coordinates.
    """

    scene_from_world: Tensor = field(default_factory=lambda: torch.eye(4, dtype=torch.float64))  # (4, 4) float64
    up: Tensor = field(default_factory=lambda: torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))  # (3,) scene's

    @staticmethod
    def at(origin: Sequence[float]) -> World:
        """Return the transform that moves the world point ``origin`` to the scene's origin; axes and units stay."""
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, 3] = -torch.tensor(origin, dtype=torch.float64)
        return World(matrix)

    @cached_property
    def identity(self) -> bool:
        """Whether scene and world coordinates are equal."""
        return torch.equal(self.scene_from_world, torch.eye(4, dtype=torch.float64))

    @cached_property
    def scale(self) -> float:
        """Scene units per world unit."""
        return 1.0 if self.identity else float(torch.linalg.det(self.scene_from_world[:3, :3])) ** (1 / 3)

    @cached_property
    def rotation(self) -> Tensor | None:
        """Rotation from world to scene axes, (3, 3); None if the axes are equal."""
        turn = self.scene_from_world[:3, :3] / self.scale
        return None if bool((turn - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-12) else turn

    @cached_property
    def inverse(self) -> World:
        """The inverse transform, a World.

        The methods ``scene_...`` of the inverse convert from scene to world coordinates.
        """
        back = torch.eye(4, dtype=torch.float64)
        back[:3, :3] = torch.linalg.inv(self.scene_from_world[:3, :3])
        back[:3, 3] = -back[:3, :3] @ self.scene_from_world[:3, 3]
        return World(back)

    @property
    def world_from_scene(self) -> Tensor:
        """Inverse of ``scene_from_world``, (4, 4) float64."""
        return self.inverse.scene_from_world

    def scene_points(self, points: Tensor) -> Tensor:
        """Convert (..., 3) points from world to scene coordinates, float64; the identity returns the same tensor."""
        if self.identity:
            return points
        return points.double() @ self.scene_from_world[:3, :3].T + self.scene_from_world[:3, 3]

    def world_points(self, points: Tensor) -> Tensor:
        """Convert (..., 3) points from scene to world coordinates, float64; the identity returns the same tensor."""
        return self.inverse.scene_points(points)

    def scene_camera(self, camera: _Camera) -> _Camera:
        """Convert a camera from world coordinates to scene coordinates."""
        if self.identity:
            return camera
        view, back = camera.viewmat.detach().double(), self.world_from_scene
        moved = torch.eye(4, dtype=torch.float64)
        moved[:3, :3] = view[:3, :3] if self.rotation is None else view[:3, :3] @ self.rotation.T
        moved[:3, 3] = self.scale * (view[:3, :3] @ back[:3, 3] + view[:3, 3])
        return replace(camera, viewmat=moved)

    def world_camera(self, camera: _Camera) -> _Camera:
        """Convert a camera from scene coordinates to world coordinates."""
        return self.inverse.scene_camera(camera)

    def world_box(self, box: np.ndarray) -> np.ndarray:
        """Return the smallest (2, 3) box along the world axes around a (2, 3) ``box`` along the scene axes."""
        return self.inverse.scene_box(box)

    def scene_box(self, box: np.ndarray) -> np.ndarray:
        """Return the smallest (2, 3) box along the scene axes around a (2, 3) ``box`` along the world axes."""
        if self.identity:
            return box
        corners = np.stack(np.meshgrid(*np.asarray(box, np.float64).T, indexing="ij"), -1).reshape(-1, 3)
        moved = self.scene_points(torch.from_numpy(corners)).numpy()
        return np.stack([moved.min(0), moved.max(0)])

    def to_json(self) -> dict[str, Any]:
        """Return the transform as the entry "world" of a model's header; :meth:`of` restores it exactly."""
        return {"scene_from_world": self.scene_from_world.tolist()}

    @staticmethod
    def of(header: Mapping[str, Any], where: str) -> World:
        """Return the transform that a model's ``header`` stores; the identity if the header has no transform.

        The upward direction comes from the header, too; without an entry, it is +z. Raises DataError, which names the
        file ``where``, if the header is damaged.
        """
        record, facts = header.get("world"), header.get("data")
        world = World()
        if isinstance(facts, dict) and "up" in facts:
            data = JsonReader(facts, f"{where}: header field 'data'")
            world = World(up=data.array("up", (3,), "3 numbers"))
            if not bool(world.up.any()):
                raise data.fail("up", "a direction")
        if record is None:
            return world
        where = f"{where}: header field 'world'"
        try:
            matrix = torch.tensor(record["scene_from_world"], dtype=torch.float64)
            return replace(world, scene_from_world=matrix).validate(where)
        except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise DataError(f"{where} is damaged ({type(error).__name__})") from None

    def validate(self, where: str) -> World:
        """Return this transform; raise DataError unless the matrix is a rotation, one scale and an offset.

        ``where`` names the matrix in the error.
        """
        matrix = self.scene_from_world
        fits = isinstance(matrix, Tensor) and matrix.shape == (4, 4) and matrix.dtype == torch.float64
        if fits and bool(matrix.isfinite().all()) and matrix[3].tolist() == [0, 0, 0, 1]:
            square = matrix[:3, :3] @ matrix[:3, :3].T
            scale = float(square.diagonal().mean())
            fits = scale > 0 and bool((square / scale - torch.eye(3, dtype=torch.float64)).abs().max() < _ROTATION)
            if fits and float(torch.linalg.det(matrix[:3, :3])) > 0:
                return self
        raise DataError(f"{where} is damaged; expected a (4, 4) float64 matrix of rotation, uniform scale and offset")

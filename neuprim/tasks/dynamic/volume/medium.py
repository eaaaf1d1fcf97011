"""An absorbing, emitting medium on a voxel grid: what the ground-truth renderer integrates."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.errors import DataError

__all__ = ["Medium"]

_NEGLIGIBLE = 1e-7
"""Below this optical depth across a cell, and this fraction of the strongest source, a voxel counts as empty."""


@dataclass(frozen=True, eq=False)
class Medium:
    """Extinction and source on voxel centres, trilinear between them.

    The radiance along a ray is L = ∫ T(s) σ(s) c(s) ds with T(s) = exp(-∫₀ˢ σ), and alpha = 1 - T at its end.

    Attributes:
        values: (X, Y, Z, 4) float32, C-contiguous: σ, σ·c_R, σ·c_G, σ·c_B at voxel centres. σ is extinction in 1/scene
        unit,
            c the source radiance in linear RGB. The outermost layer of voxels is zero, so that the field is continuous
            where it ends; :meth:`padded` adds that layer. No voxels at all is an empty medium.
        scene_from_index: (4, 4) float64, affine and invertible: the centre of voxel (i, j, k) is at it @ (i, j, k, 1).
        non_finite: how many voxels of the source were NaN or infinite and count as 0.
        scattering: (X, Y, Z) float32, the part of σ that the extinction grid makes, where flames add to it; None where
        all of it is that part.
    """

    values: np.ndarray
    scene_from_index: np.ndarray
    non_finite: int = 0
    scattering: np.ndarray | None = None
    _elsewhere: dict[torch.device, tuple[Tensor, Tensor]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        v, m = self.values, self.scene_from_index
        if v.ndim != 4 or v.shape[3] != 4 or v.dtype != np.float32 or not v.flags.c_contiguous:
            raise DataError(
                f"medium: values are {v.dtype} of shape {v.shape}; expected contiguous float32 (X, Y, Z, 4)"
            )
        if m.shape != (4, 4) or m.dtype != np.float64 or not np.isfinite(m).all() or (m[3] != (0, 0, 0, 1)).any():
            raise DataError(
                f"medium: scene_from_index is {m.dtype} of shape {m.shape}; expected a finite affine float64 (4, 4)"
            )
        if self.empty:
            return
        edges = np.linalg.norm(m[:3, :3], axis=0)
        if (edges == 0).any() or abs(np.linalg.det(m[:3, :3] / edges)) < 1e-9:
            raise DataError("medium: scene_from_index is singular; expected voxels with a volume")
        if not np.isfinite(v).all() or float(v[..., 0].min()) < 0:
            raise DataError("medium: values are NaN, infinite or of negative extinction; expected finite ones")
        if any(face.any() for face in (v[0], v[-1], v[:, 0], v[:, -1], v[:, :, 0], v[:, :, -1])):
            raise DataError("medium: the outermost voxels are not zero; Medium.padded adds a layer that is")

    @staticmethod
    def padded(
        values: np.ndarray, scene_from_index: np.ndarray, non_finite: int = 0, scattering: np.ndarray | None = None
    ) -> Medium:
        """The medium of (X, Y, Z, 4) ``values`` inside one layer of empty voxels; ``scene_from_index`` is of
        ``values``."""
        shift = np.eye(4)
        shift[:3, 3] = -1.0
        around = np.zeros((*(n + 2 for n in values.shape[:3]), 4), np.float32)
        around[1:-1, 1:-1, 1:-1] = values
        own = None if scattering is None else np.pad(scattering, 1)
        return Medium(around, np.asarray(scene_from_index, np.float64) @ shift, non_finite, own)

    @staticmethod
    def nothing() -> Medium:
        """An empty medium."""
        return Medium(np.zeros((0, 0, 0, 4), np.float32), np.eye(4))

    @property
    def empty(self) -> bool:
        """No voxels, or not enough for a cell between them."""
        return min(self.values.shape[:3]) < 2

    @property
    def bytes(self) -> int:
        """Memory of the voxels and of the skips through empty space."""
        return self.values.nbytes + (0 if self.empty else int(np.prod([n - 1 for n in self.values.shape[:3]])))

    def on(self, where: torch.device) -> tuple[Tensor, Tensor]:
        """``values`` and ``skips`` as tensors there; kept, as many cameras look at them."""
        if where not in self._elsewhere:
            values, skips = (device.copy_from_host(torch.from_numpy(x), where) for x in (self.values, self.skips))
            self._elsewhere[where] = values, skips
        return self._elsewhere[where]

    @cached_property
    def index_from_scene(self) -> np.ndarray:
        """(4, 4) float64 inverse of ``scene_from_index``."""
        return np.linalg.inv(self.scene_from_index)

    @cached_property
    def skips(self) -> np.ndarray:
        """(X-1, Y-1, Z-1) uint8: chessboard distance in cells to the nearest one that holds anything; 0 for those, 255
        if far or none.

        A ray in a cell of distance d may leave the cube of 2d-1 cells around it at once.
        """
        if self.empty:
            return np.zeros((0, 0, 0), np.uint8)
        diagonal = float(np.abs(self.scene_from_index[:3, :3]).sum())
        source = np.abs(self.values[..., 1:]).max(-1)
        filled = (self.values[..., 0] * diagonal > _NEGLIGIBLE) | (source > _NEGLIGIBLE * float(source.max()))
        for axis in range(3):  # a cell holds something if one of its eight corners does
            filled = np.delete(filled, -1, axis) | np.delete(filled, 0, axis)
        if not filled.any():
            return np.full(filled.shape, 255, np.uint8)
        return np.minimum(ndimage.distance_transform_cdt(~filled, "chessboard"), 255).astype(np.uint8)

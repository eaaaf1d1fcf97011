"""Where the photographs are taken from: a hand-held walk of two rounds about the subject, the first low, the second
high."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from neuprim.core.cameras import look_at

__all__ = ["FARTHEST", "HIGHEST", "LOWEST", "NEAREST", "camera_matrices", "places"]

NEAREST, FARTHEST = 2.6, 4.5
"""Bounds of the distance to the subject's middle, the origin; scene units."""

LOWEST, HIGHEST = 0.3, 2.0
"""Bounds of the height above it."""

_ROUNDS = 2
_SEEDS = {"train": 20250311, "test": 20250312}


def places(train: int, test: int) -> dict[str, NDArray[np.float64]]:
    """Where on the walk, 0 to 1, the photographs of each split are taken: (train,) and (test,).

    The test ones divide the walk evenly, whatever the training ones are; these fill the gaps, evenly in each.
    """
    held_out = (np.arange(test) + 0.5) / test
    gap = np.arange(train) * test // train
    first = np.searchsorted(gap, gap)
    within = (np.arange(train) - first + 1) / (np.bincount(gap, minlength=test)[gap] + 1)
    return {"train": (gap - 0.5 + within) / test, "test": held_out}


def camera_matrices(train: int, test: int) -> dict[str, list[NDArray[np.float64]]]:
    """Camera-to-world matrices (4, 4), OpenGL axes, of both splits. Those of the test split depend on their own number
    alone."""
    return {split: _walk(t, _SEEDS[split]) for split, t in places(train, test).items()}


def _walk(times: NDArray[np.float64], seed: int) -> list[NDArray[np.float64]]:
    shake = 2 * np.random.default_rng(seed).random((len(times), 7)) - 1
    return [_pose(float(t), s) for t, s in zip(times, shake, strict=True)]


def _pose(t: float, shake: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) at ``t`` of the walk; ``shake`` (7,) of -1..1 moves the hand, the aim and the horizon."""
    turn = 2 * math.pi
    distance = 3.55 + 0.8 * math.sin(turn * (5 * t + 0.15)) + 0.12 * shake[0]
    height = 1.1 - 0.6 * math.cos(turn * t) + 0.1 * math.sin(turn * 7 * t) + 0.06 * shake[1]
    azimuth = turn * _ROUNDS * t + 0.06 * shake[2]
    across = math.sqrt(distance**2 - height**2)
    eye = np.array([across * math.cos(azimuth), across * math.sin(azimuth), height])
    aim = 0.14 * shake[3:6] + [0, 0, -0.05]
    roll = math.radians(2.5) * shake[6]
    sideways = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    up = math.cos(roll) * np.array([0, 0, 1.0]) + math.sin(roll) * sideways
    view = look_at(*(torch.from_numpy(np.asarray(v, dtype=np.float64)) for v in (eye, aim, up)))
    return torch.linalg.inv(view).numpy() @ np.diag([1.0, -1.0, -1.0, 1.0])

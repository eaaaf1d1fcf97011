"""Where the cameras and lights of the built-in scene are: fixed lists, whatever the seed.

Cameras look at the origin from 4 to 5 units, at most 75 degrees from the zenith; lights are as far away, at most 60
degrees from it. Directions are spread evenly over their part of the sphere, distances evenly over their range. A
training image has a camera and a light of its own. The test split has three parts of equal size:

    new_view_03    a camera never seen, the light of a training image
    new_light_03   the camera of a training image, a light never seen
    new_both_03    neither seen

and beside it, for a film, ``circle``: one new camera and a light that goes round once, 45 degrees from the zenith.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuprim.scenes.poses import direction

__all__ = ["CIRCLE_FRAMES", "DISTANCE", "NEAR_LIGHTS", "PARTS", "LitView", "splits"]

DISTANCE = (4.0, 5.0)
CAMERA_POLAR = math.radians(75.0)
LIGHT_POLAR = math.radians(60.0)
PARTS = ("new_view", "new_light", "new_both")
CIRCLE_FRAMES = 36

NEAR_LIGHTS = 25
"""The baseline "nearest light" knows the lights of this many training images, the first ones."""


@dataclass(frozen=True)
class LitView:
    """One image to take.

    Attributes:
        camera, light: (3,) float64 positions, scene units.
        near_light: (3,) the one of the baseline's lights in the direction nearest to the light's; test views only.
    """

    name: str
    camera: NDArray[np.float64]
    light: NDArray[np.float64]
    near_light: NDArray[np.float64] | None = None


def splits(train_views: int, test_views: int) -> dict[str, list[LitView]]:
    """All views by split: "train", "test", "circle"."""
    digits = max(4, len(str(train_views)))
    cameras, lights = _draw(1, train_views)
    train = [LitView(f"r_{i:0{digits}d}", cameras[i], lights[i]) for i in range(train_views)]
    known = lights[:NEAR_LIGHTS]
    new_cameras, new_lights = _draw(2, test_views)
    # The baseline's own lights are no test of it, so seen ones come from the rest where there is one.
    first = NEAR_LIGHTS if train_views > NEAR_LIGHTS else 0
    counts = [(test_views + 2 - part) // 3 for part in range(3)]
    test = []
    for part, name in enumerate(PARTS):
        for i in range(counts[part]):
            fresh = sum(counts[:part]) + i
            seen = first + i * (train_views - first) // max(counts[part], 1)
            camera = cameras[seen] if name == "new_light" else new_cameras[fresh]
            light = lights[seen] if name == "new_view" else new_lights[fresh]
            test.append(
                LitView(f"{name}_{i:0{max(2, len(str(test_views)) - 1)}d}", camera, light, _nearest(known, light))
            )
    middle = sum(DISTANCE) / 2
    eye = middle * direction(math.cos(math.radians(58.0)), -1.1)
    turns = [2 * math.pi * i / CIRCLE_FRAMES for i in range(CIRCLE_FRAMES)]
    circle = [
        LitView(f"light_{i:02d}", eye, middle * direction(math.cos(math.radians(45.0)), turn))
        for i, turn in enumerate(turns)
    ]
    return {"train": train, "test": test, "circle": circle}


def _draw(key: int, count: int) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Positions of ``count`` cameras and lights; a longer list begins with the shorter one."""
    numbers = np.random.default_rng([20241208, key]).random((count, 6))
    return [_position(n[:3], CAMERA_POLAR) for n in numbers], [_position(n[3:], LIGHT_POLAR) for n in numbers]


def _position(numbers: NDArray[np.float64], polar: float) -> NDArray[np.float64]:
    """Three numbers 0..1 as a point whose direction is uniform on the cap of half-angle ``polar`` about the zenith."""
    cosine = 1.0 - numbers[0] * (1.0 - math.cos(polar))
    return (DISTANCE[0] + numbers[2] * (DISTANCE[1] - DISTANCE[0])) * direction(cosine, 2 * math.pi * numbers[1])


def _nearest(lights: list[NDArray[np.float64]], light: NDArray[np.float64]) -> NDArray[np.float64]:
    cosines = [float(known @ light / np.linalg.norm(known)) for known in lights]
    return lights[int(np.argmax(cosines))]

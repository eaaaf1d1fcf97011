"""The script that the documentation gives to users of Blender, run with a stand-in for Blender's module."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from neuprim.core.cameras.camera_files import read_camera_file
from tests.docs.pages import ROOT, blocks

PAGE = ROOT / "docs" / "data_formats.md"


def script() -> str:
    """The block of the page that imports bpy."""
    (found,) = (block for block in blocks(PAGE) if block.language == "python" and "import bpy" in block.text)
    assert len([line for line in found.text.splitlines() if line.strip()]) <= 18, "short enough to be typed"
    return found.text


class Matrix(list[list[float]]):
    """As much of mathutils.Matrix as the script needs."""

    def normalized(self) -> Matrix:
        a = np.array(self)
        a[:3, :3] /= np.linalg.norm(a[:3, :3], axis=0)
        return Matrix(a.tolist())


class Camera:
    """A camera of Blender: lens and sensor in millimetres, shifts in parts of the larger side, sensor_fit AUTO."""

    def __init__(self, lens: float, sensor: float, shift: tuple[float, float], scale: float = 1.0) -> None:
        self.data = SimpleNamespace(type="PERSP")
        self.lens, self.sensor, self.shift, self.scale, self.x = lens, sensor, shift, scale, 0.0

    @property
    def matrix_world(self) -> Matrix:
        """At (x, -4, 0.25), looking along +y with z up."""
        s = self.scale
        return Matrix([[s, 0, 0, self.x], [0, 0, -s, -4], [0, s, 0, 0.25], [0, 0, 0, 1]])

    def calc_matrix_camera(self, depsgraph: Any, *, x: int, y: int, scale_x: float, scale_y: float) -> Matrix:
        """The projection of OpenGL, for what Blender's manual says of lens, sensor and shift."""
        assert depsgraph == "depsgraph" and scale_x == scale_y == 1.0
        side = self.sensor / self.lens  # of the view plane at distance 1: its larger side
        wide, high = (side, side * y / x) if x >= y else (side * x / y, side)
        left, right = (-0.5 * wide + self.shift[0] * side, 0.5 * wide + self.shift[0] * side)
        bottom, top = (-0.5 * high + self.shift[1] * side, 0.5 * high + self.shift[1] * side)
        across = [2 / (right - left), 0, (right + left) / (right - left), 0]
        down = [0, 2 / (top - bottom), (top + bottom) / (top - bottom), 0]
        return Matrix([across, down, [0, 0, -1, -0.2], [0, 0, -1, 0]])


def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, camera: Camera, size: tuple[int, int]) -> Path:
    width, height = size
    render = SimpleNamespace(resolution_x=width, resolution_y=height, resolution_percentage=100, fps=24, fps_base=1.0)
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
    scene = SimpleNamespace(camera=camera, render=render, frame_start=3, frame_end=7, frame_step=2)
    scene.frame_set = lambda frame: setattr(camera, "x", float(frame))
    bpy = ModuleType("bpy")
    bpy.context = SimpleNamespace(scene=scene, evaluated_depsgraph_get=lambda: "depsgraph")  # type: ignore[attr-defined]
    bpy.path = SimpleNamespace(abspath=lambda text: str(tmp_path / text.removeprefix("//")))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    exec(compile(script(), str(PAGE), "exec"), {})
    return tmp_path / "cameras.json"


@pytest.mark.parametrize("size", [(640, 480), (300, 500)])
def test_points_are_where_blender_shows_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]
) -> None:
    found = read_camera_file(run(tmp_path, monkeypatch, Camera(50.0, 36.0, (0.1, -0.05), scale=2.0), size))
    assert len(found.named) == 3 and found.fps == 24 and found.notes == ()
    (width, height), larger = size, max(size)
    for x, (_, camera) in zip((3.0, 5.0, 7.0), found.named, strict=True):
        assert (camera.width, camera.height) == size and camera.position.tolist() == pytest.approx([x, -4, 0.25])
        # 1 right, 2 ahead, 0.5 up; a shift of the camera to the right moves what it shows to the left
        pixels, depth = camera.project(camera.position + camera.position.new_tensor([[1.0, 2.0, 0.5]]))
        focal = 50 / 36 * larger
        expected = [width / 2 + focal * 0.5 - 0.1 * larger, height / 2 - focal * 0.25 + (-0.05) * larger]
        assert pixels[0].tolist() == pytest.approx(expected) and float(depth) == pytest.approx(2.0)

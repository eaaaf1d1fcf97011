"""One open page: its camera, what it shows, and the images that it is sent."""

from __future__ import annotations

import math
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.data import View
from neuprim.core.errors import NeuprimError
from neuprim.core.render import RenderSettings
from neuprim.viewer.quality import SMOOTH_SECONDS, QualityLadder, QualityLevel
from neuprim.viewer.render_queue import RenderQueue
from neuprim.viewer.viewer_scene import COLOUR, ViewerScene, Viewpoint

_STILL_SECONDS = 0.2  # without a change before the full image is drawn
_REDRAW_SECONDS, _REDRAW_SHARE = 1.0, 9.0  # a growing model is redrawn after this time, or this many drawing times
_FULL_QUALITY, _FAST_QUALITY = 95, 75  # of JPEG

DEFAULT_LONGEST = 960  # pixels


@dataclass(frozen=True, eq=False)
class ViewerPose:
    """A camera as a page knows it, without its window.

    Attributes:
        wxyz: (4,) unit quaternion, camera to world, OpenCV axes (x right, y down, z forward).
        position: (3,) scene units.
        fov: vertical field of view, radians.
    """

    wxyz: np.ndarray
    position: np.ndarray
    fov: float

    @classmethod
    def from_camera(cls, camera: Camera) -> ViewerPose:
        """Convert a camera; its principal point is lost."""
        view = camera.viewmat.detach().double().cpu().numpy()
        x, y, z, w = Rotation.from_matrix(view[:3, :3].T).as_quat()
        position, fov = -view[:3, :3].T @ view[:3, 3], 2 * math.atan(0.5 * camera.height / camera.fy)
        return cls(np.array([w, x, y, z]), position, fov)

    @property
    def rotation(self) -> Rotation:
        """Camera to world."""
        w, x, y, z = self.wxyz
        return Rotation.from_quat([x, y, z, w])

    def to_camera(self, width: int, height: int) -> Camera:
        """Return the pinhole camera of a window of this size, with a centred principal point."""
        turn = self.rotation.as_matrix().T
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = torch.from_numpy(turn)
        viewmat[:3, 3] = torch.from_numpy(-turn @ np.asarray(self.position, np.float64))
        focal = 0.5 * height / math.tan(0.5 * self.fov)
        return Camera(viewmat, focal, focal, width / 2, height / 2, width, height)


def fit_viewer_size(size: Sequence[int], longest: int) -> tuple[int, int]:
    """Scale (width, height) down to at most ``longest`` pixels a side, at least 1."""
    scale = min(1.0, longest / max(*size, 1))
    return max(1, round(scale * size[0])), max(1, round(scale * size[1]))


class Session:
    """State of one page. Methods are thread-safe; whatever uses the model goes through the queue.

    Attributes:
        client: a ``viser.ClientHandle``.
        quantity: one of :func:`~neuprim.viewer.viewer_scene.list_viewer_quantities`.
        conditions: every condition of the task.
        settings: of the full image.
        longest: pixels on the longer side of the full image.
        training: whether the model changes by itself.
        closed: whether the page was closed.
        on_full_image: called after every full image, on the thread that has the model.
    """

    def __init__(
        self, client: Any, scene: ViewerScene, queue: RenderQueue, start: View, training: bool = False
    ) -> None:
        self.client, self.scene, self.queue, self.training = client, scene, queue, training
        self.closed = False
        self.quantity, self.longest = COLOUR, DEFAULT_LONGEST
        self.conditions: dict[str, Tensor] = dict(start.conditions)
        self.settings: RenderSettings = scene.settings
        self.on_full_image: list[Callable[[], None]] = []
        self._ladder: QualityLadder | None = None
        self._lock = threading.Lock()
        self._status: Any = None

    def open(self, start: View) -> None:
        """Show the start view, then follow the page's camera."""
        self._status = self.client.gui.add_text("status", "", disabled=True)
        self.set_camera(ViewerPose.from_camera(start.camera))
        self.client.camera.on_update(lambda _: self.redraw())
        self.redraw()

    def close(self) -> None:
        """Drop the jobs of a closed page."""
        self.closed = True
        self.queue.drop_client(self.client.client_id)

    def set_status(self, text: str) -> None:
        """Show one line of text in the page."""
        if self._status is not None and not self.closed:
            self._status.value = text

    def notify(self, text: str, colour: str = "blue") -> None:
        """Show a notification that stays until it is closed."""
        if not self.closed:
            self.client.add_notification("neuprim", " ".join(text.split()), color=colour, with_close_button=True)

    def report_error(self, error: Exception) -> None:
        """Show an error in the page, and the traceback of an unexpected one on the console."""
        if isinstance(error, NeuprimError | OSError):
            self.notify(str(error), "red")
        else:
            traceback.print_exception(error)
            self.notify(f"{type(error).__name__}: {error}", "red")

    def set_camera(self, pose: ViewerPose) -> None:
        """Move the page's camera. Dragging then turns it around the point ahead that is closest to the scene's
        centre."""
        forward = pose.rotation.as_matrix()[:, 2]
        offset = self.scene.center - pose.position
        ahead = max(float(forward @ offset), 1e-2 * float(np.linalg.norm(offset))) or 1.0
        camera = self.client.camera
        with self.client.atomic():
            camera.position = pose.position
            camera.wxyz = pose.wxyz
            camera.look_at = pose.position + ahead * forward
            camera.fov = pose.fov

    def viewpoint(self) -> Viewpoint:
        """Return what the page shows now."""
        camera = self.client.camera
        pose = ViewerPose(camera.wxyz.copy(), camera.position.copy(), float(camera.fov))
        width, height = fit_viewer_size((camera.image_width or 1, camera.image_height or 1), self.longest)
        with self._lock:
            return Viewpoint(pose.to_camera(width, height), dict(self.conditions), self.quantity)

    def set_conditions(self, values: Mapping[str, Tensor]) -> None:
        """Change conditions and redraw."""
        with self._lock:
            self.conditions |= values
        self.redraw()

    def set_settings(self, settings: RenderSettings, overrides: tuple[str, ...] = ()) -> None:
        """Change the render settings, with overrides of a render configuration.

        Raises:
            ConfigError: the overrides do not fit the model.
        """
        ladder = QualityLadder.build(self.scene.model(), settings, self.scene.front, self.notify, overrides)
        with self._lock:
            self.settings, self._ladder = settings, ladder
        self.redraw()

    def submit(self, kind: str, run: Callable[[], None], delay: float = 0.0, replace: bool = True) -> None:
        """Queue a job for the thread that has the model; its errors appear in the page."""
        self.queue.submit((self.client.client_id, kind), run, self.report_error, delay, replace)

    def redraw(self) -> None:
        """Draw as well as time allows, and fully once nothing changes any more."""
        self.submit("picture", self._draw_fast)

    def draw(self, level: QualityLevel | None = None) -> None:
        """Draw and send an image, by default at the best smooth level; on the thread that has the model."""
        ladder, viewpoint = self.ladder(), self.viewpoint()
        pixels = viewpoint.camera.width * viewpoint.camera.height
        level = level or ladder.best_within(SMOOTH_SECONDS, pixels)
        picture = self.scene.draw(viewpoint, level.config)
        ladder.add_timing(level, picture.seconds, pixels)
        if self.closed:
            return
        quality = _FULL_QUALITY if level is ladder.full else _FAST_QUALITY
        self.client.scene.set_background_image(picture.image, format="jpeg", jpeg_quality=quality)
        height, width = picture.image.shape[:2]
        caption = f"; {picture.caption}" if picture.caption else ""
        self.set_status(f"{width} x {height} in {1e3 * picture.seconds:.0f} ms{caption}")

    def ladder(self) -> QualityLadder:
        """Return the quality levels by the current settings."""
        if self._ladder is None:
            self._ladder = QualityLadder.build(self.scene.model(), self.settings, self.scene.front, self.notify)
        return self._ladder

    def _draw_fast(self) -> None:
        ladder, camera = self.ladder(), self.viewpoint().camera
        level = ladder.best_within(SMOOTH_SECONDS, camera.width * camera.height)
        self.draw(level)
        follow = self._finish_full if level is ladder.full else self._draw_full
        self.submit("picture", follow, _STILL_SECONDS, replace=False)

    def _draw_full(self) -> None:
        self.draw(self.ladder().full)
        self._finish_full()

    def _finish_full(self) -> None:
        for callback in self.on_full_image:
            callback()
        if self.training:
            camera = self.viewpoint().camera
            seconds = (self.ladder().full.pace or 0.0) * camera.width * camera.height
            self.submit("picture", self._draw_full, max(_REDRAW_SECONDS, _REDRAW_SHARE * seconds), replace=False)

"""One open page of the viewer: its camera, conditions and settings, and the queue of jobs that render its images.

While camera or conditions change, the resolution of images is reduced so far that motion is smooth. When the changes
stop, the image is rendered at full resolution.
"""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import NeuprimError
from neuprim.core.render import RenderSettings
from neuprim.viewer.viewer_scene import COLOUR, ViewerScene, Viewpoint

DEFAULT_LONGEST = 960  # pixels

_SMOOTH_SECONDS = 0.05  # largest time of an image while the camera moves
_STILL_SECONDS = 0.2  # time without a change after which the full image is drawn
_REDRAW_SECONDS, _REDRAW_SHARE = 1.0, 9.0  # a growing model is redrawn after this time, or this many drawing times
_FULL_QUALITY, _FAST_QUALITY = 95, 75  # of JPEG
_MIN_RESOLUTION = 1 / 16


class _Job(NamedTuple):
    due: float  # earliest start, time.monotonic()
    run: Callable[[], None]
    on_error: Callable[[Exception], None]


class RenderQueue:
    """Queue of jobs: functions that use the model, e.g. to render an image.

    A new job replaces a waiting job with the same key, so a moving camera causes no backlog. All methods are
    thread-safe. Only one thread may use the model; this thread calls :meth:`work` to run the jobs.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._jobs: dict[tuple[Hashable, str], _Job] = {}

    def submit(
        self,
        key: tuple[Hashable, str],
        run: Callable[[], None],
        on_error: Callable[[Exception], None],
        delay: float = 0.0,
        replace: bool = True,
    ) -> None:
        """Add a job to the queue.

        Args:
            key: (page id, kind of work).
            run: function that does the work.
            on_error: called with the exception that ends the job.
            delay: seconds to wait before the job may run.
            replace: whether the new job replaces a waiting job with the same key. If False, the new job is dropped
                when such a job waits.
        """
        with self._changed:
            if replace or key not in self._jobs:
                self._jobs[key] = _Job(time.monotonic() + delay, run, on_error)
                self._changed.notify_all()

    def drop_client(self, client: Hashable) -> None:
        """Remove all waiting jobs of a page."""
        with self._changed:
            self._jobs = {key: job for key, job in self._jobs.items() if key[0] != client}

    @property
    def pending(self) -> bool:
        """Whether any job waits in the queue, even if its delay has not passed."""
        return bool(self._jobs)

    def work(self, timeout: float) -> bool:
        """Run one job whose delay has passed; return whether a job ran.

        If there is no such job yet, wait up to ``timeout`` seconds for a job.
        """
        job = self._take(timeout)
        if job is None:
            return False
        try:
            job.run()
        except Exception as error:  # a failed image must end neither a training nor the drawing thread
            job.on_error(error)
        return True

    def _take(self, timeout: float) -> _Job | None:
        """Remove and return the job whose delay passed first; None if no delay passes within ``timeout`` seconds."""
        end = time.monotonic() + timeout
        with self._changed:
            while True:
                now = time.monotonic()
                key = min(self._jobs, key=lambda k: self._jobs[k].due, default=None)
                if key is not None and self._jobs[key].due <= now:
                    return self._jobs.pop(key)
                if now >= end:
                    return None
                self._changed.wait(min(end, self._jobs[key].due if key is not None else end) - now)


def next_resolution(resolution: float, seconds: float) -> float:
    """Return the factor, at most 1, on the resolution of the next image during motion.

    ``resolution`` is the factor of the last image, and ``seconds`` the time that rendering the last image took.
    """
    if seconds > _SMOOTH_SECONDS:
        return max(resolution / 2, _MIN_RESOLUTION)
    return min(resolution * 2, 1.0) if seconds < _SMOOTH_SECONDS / 4 else resolution


@dataclass(frozen=True, eq=False)
class ViewerPose:
    """Camera of a browser page, without an image size: pose and field of view.

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
        """Return the pose and vertical field of view of a pinhole camera; the principal point is dropped."""
        view = camera.viewmat.detach().double().cpu().numpy()
        x, y, z, w = Rotation.from_matrix(view[:3, :3].T).as_quat()
        position, fov = -view[:3, :3].T @ view[:3, 3], 2 * math.atan(0.5 * camera.height / camera.fy)
        return cls(np.array([w, x, y, z]), position, fov)

    @property
    def rotation(self) -> np.ndarray:
        """Rotation matrix from camera to world, (3, 3)."""
        w, x, y, z = self.wxyz
        return np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix())

    def to_camera(self, width: int, height: int) -> Camera:
        """Return the pinhole camera for a window of this size, with a centred principal point."""
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = torch.from_numpy(self.rotation.T)
        viewmat[:3, 3] = torch.from_numpy(-self.rotation.T @ np.asarray(self.position, np.float64))
        focal = 0.5 * height / math.tan(0.5 * self.fov)
        return Camera(viewmat, focal, focal, width / 2, height / 2, width, height)


def fit_viewer_size(size: Sequence[int], longest: float) -> tuple[int, int]:
    """Scale (width, height) down so that the longer side has at most ``longest`` pixels; each side keeps at least 1."""
    scale = min(1.0, longest / max(*size, 1))
    return max(1, round(scale * size[0])), max(1, round(scale * size[1]))


class Session:
    """State of one open browser page. Methods are thread-safe; every use of the model is a job in the queue.

    Attributes:
        client: a ``viser.ClientHandle``.
        training: whether the model is being trained.
        closed: whether the page was closed.
        quantity: one of :func:`~neuprim.viewer.viewer_scene.list_viewer_quantities`.
        conditions: name -> value, for every condition of the task.
        settings: render settings of the image.
        longest: pixels on the longer side of the image at full resolution.
        on_full_image: called after every full-resolution image, on the thread that may use the model.
    """

    def __init__(self, client: Any, scene: ViewerScene, queue: RenderQueue, training: bool = False) -> None:
        """Move the page's camera to the scene's start view, then follow the camera."""
        self.client, self.scene, self.queue, self.training = client, scene, queue, training
        self.closed = False
        self.quantity, self.longest = COLOUR, DEFAULT_LONGEST
        self.conditions: dict[str, Tensor] = dict(scene.start_view.conditions)
        self.settings: RenderSettings = scene.settings
        self.on_full_image: list[Callable[[], None]] = []
        self._resolution = _MIN_RESOLUTION  # of an image while something moves
        self._full_seconds = 0.0
        self._status = client.gui.add_text("status", "", disabled=True)
        self.set_camera(ViewerPose.from_camera(scene.start_view.camera))
        client.camera.on_update(lambda _: self.redraw())
        self.redraw()

    def close(self) -> None:
        """Mark the page as closed and drop its waiting jobs."""
        self.closed = True
        self.queue.drop_client(self.client.client_id)

    def set_status(self, text: str) -> None:
        """Show one line of status text in the page."""
        if not self.closed:
            self._status.value = text

    def notify(self, text: str, colour: str = "blue") -> None:
        """Show a notification in the page that stays until the user closes it."""
        if not self.closed:
            self.client.add_notification("neuprim", " ".join(text.split()), color=colour, with_close_button=True)

    def report_error(self, error: Exception) -> None:
        """Show an error in the page; print the traceback of an unexpected error on the console."""
        if isinstance(error, NeuprimError | OSError):
            self.notify(str(error), "red")
        else:
            traceback.print_exception(error)
            self.notify(f"{type(error).__name__}: {error}", "red")

    def set_camera(self, pose: ViewerPose) -> None:
        """Move the page's camera to ``pose``.

        Dragging then turns the camera around the point of the viewing axis that is closest to the scene's centre.
        """
        forward = pose.rotation[:, 2]
        offset = self.scene.center - pose.position
        ahead = max(float(forward @ offset), 1e-2 * float(np.linalg.norm(offset))) or 1.0
        camera = self.client.camera
        with self.client.atomic():
            camera.position = pose.position
            camera.wxyz = pose.wxyz
            camera.look_at = pose.position + ahead * forward
            camera.fov = pose.fov

    def viewpoint(self, resolution: float = 1.0) -> Viewpoint:
        """Return the page's current viewpoint; ``resolution`` is a factor on the size of the image."""
        camera = self.client.camera
        pose = ViewerPose(camera.wxyz.copy(), camera.position.copy(), float(camera.fov))
        size = fit_viewer_size((camera.image_width or 1, camera.image_height or 1), self.longest)
        reduced = fit_viewer_size(size, resolution * max(size))
        return Viewpoint(pose.to_camera(*reduced), dict(self.conditions), self.quantity)

    def set_conditions(self, values: Mapping[str, Tensor]) -> None:
        """Change values of conditions, e.g. the time, and render the page's image again."""
        self.conditions.update(values)
        self.redraw()

    def set_settings(self, settings: RenderSettings) -> None:
        """Change the render settings and render the page's image again."""
        self.settings = settings
        self.redraw()

    def submit(self, kind: str, run: Callable[[], None], delay: float = 0.0, replace: bool = True) -> None:
        """Queue a job for the thread that may use the model; the page shows errors. See :class:`RenderQueue`."""
        self.queue.submit((self.client.client_id, kind), run, self.report_error, delay, replace)

    def redraw(self) -> None:
        """Queue an image at a resolution that keeps motion smooth. A full image follows when changes stop."""
        self.submit("picture", self._draw_fast)

    def draw(self, full: bool = False) -> bool:
        """Render an image and send it to the page. Only call this on the thread that may use the model.

        Args:
            full: render at full resolution. If False, render at a resolution that keeps motion smooth.

        Returns:
            Whether the image had full resolution.
        """
        resolution = 1.0 if full else self._resolution
        picture = self.scene.draw(self.viewpoint(resolution), self.settings)
        if resolution == 1.0:
            self._full_seconds = picture.seconds
        if not full or picture.seconds <= _SMOOTH_SECONDS:
            self._resolution = next_resolution(resolution, picture.seconds)
        if not self.closed:
            quality = _FULL_QUALITY if resolution == 1.0 else _FAST_QUALITY
            self.client.scene.set_background_image(picture.image, format="jpeg", jpeg_quality=quality)
            height, width = picture.image.shape[:2]
            caption = f"; {picture.caption}" if picture.caption else ""
            self.set_status(f"{width} x {height} in {1e3 * picture.seconds:.0f} ms{caption}")
        return resolution == 1.0

    def _draw_fast(self) -> None:
        follow = self._finish_full if self.draw() else self._draw_full
        self.submit("picture", follow, _STILL_SECONDS, replace=False)

    def _draw_full(self) -> None:
        self.draw(full=True)
        self._finish_full()

    def _finish_full(self) -> None:
        for callback in self.on_full_image:
            callback()
        if self.training:
            delay = max(_REDRAW_SECONDS, _REDRAW_SHARE * self._full_seconds)
            self.submit("picture", self._draw_full, delay, replace=False)

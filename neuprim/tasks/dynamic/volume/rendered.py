"""The frames of a capture in their place: which are there, and how one is made."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property

from neuprim.core.data.dataset import GroundTruth
from neuprim.core.errors import DataError
from neuprim.core.io.files import write_json
from neuprim.core.io.store import Store
from neuprim.core.notices import warn_once
from neuprim.tasks.dynamic.volume.capture import LAST, Capture
from neuprim.tasks.dynamic.volume.optics import FOLLOWING

__all__ = ["RenderedFrames"]

Progress = Callable[[str, float], None]

_SCENE = "scene.json"


class RenderedFrames(GroundTruth):
    """Ground truth of a volume sequence: every frame from every camera.

    A frame's files get their name together when all are written, so that an interrupted run goes on with the frames
    that are missing, and of two runs that render one frame the slower one finds that it is there.

    Args:
        store: where ground truth is kept; the images lie in ``volumes/KEY`` of it.

    Attributes:
        store: the place of these images.
    """

    def __init__(self, capture: Capture, store: Store) -> None:
        self.capture = capture
        self.frames = [capture.name(frame) for frame in capture.frames]
        self.known = {
            "normalisation": capture.normalisation.to_json(),
            "bounds": capture.bounds.tolist(),
            "look": {key: getattr(capture.look, key) for key in FOLLOWING},
            "grids": dict(capture.reader.names),
        }
        self._root = store

    @cached_property
    def key(self) -> str:  # type: ignore[override]
        return self.capture.key()

    @cached_property
    def store(self) -> Store:
        return self._root.at("volumes", self.key)

    @property
    def place(self) -> str:  # type: ignore[override]
        return self.store.address

    def missing(self) -> list[int]:
        there = self.store.complete_folders(LAST)
        return [i for i, name in enumerate(self.frames) if name not in there]

    def begin(self) -> None:
        with _told(self.store):
            self.store.prepare()

    def make(self, frame: int, tell: Callable[[str], None] = warn_once) -> None:
        if not self.store.has_file(f"{self.frames[frame]}/{LAST}"):
            self.write(frame, tell)

    def write(self, frame: int, tell: Callable[[str], None] = warn_once) -> None:
        """Render a frame, and keep it unless it is there by then."""

        def attempt() -> None:
            self.store.write_folder(
                self.frames[frame], lambda folder: self.capture.render(self.capture.frames[frame], folder), LAST
            )

        with _told(self.store):
            self.store.retry(attempt, tell)

    def complete(self) -> None:
        with _told(self.store):
            if not self.store.has_file(_SCENE):
                self.store.write_file(_SCENE, lambda path: write_json(path, self.capture.describe()))

    def take(self, progress: Progress) -> Store:
        """Render what is missing, here; returns where the images are.

        Raises:
            DataError: a file cannot be read, or the place cannot be written.
        """
        missing = self.missing()
        if missing:
            self.begin()
        text = f"rendering the ground truth: {len(self.frames)} frames, {len(self.capture.cameras)} cameras"
        for i in missing:
            progress(text, i / len(self.frames))
            self.make(i)
        self.complete()
        return self.store


@contextmanager
def _told(store: Store) -> Iterator[None]:
    """What a disk refuses, as an error of the data in one line."""
    try:
        yield
    except (OSError, DataError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        if not isinstance(cause, OSError) or (isinstance(error, DataError) and str(store.path) not in str(error)):
            raise
        why = cause.strerror or cause
        raise DataError(
            f"cannot write the rendered images to {store.address}: {why}; frames that are there are kept"
        ) from error

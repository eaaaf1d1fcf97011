"""Ground truth that a loader renders frame by frame, as work that can be shared out before anything is learned from
it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

__all__ = ["GroundTruth"]


class GroundTruth(ABC):
    """The images of a scene, as they will be when all frames are made. Any process that has the scene's settings can
    make any frame.

    Attributes:
        frames: their names, in order.
        key: of everything that the images depend on; another process must come to the same one, or it sees other files.
        place: folder or URL where they are kept.
        known: plain values that spare another process work that was done here; given to the scene's ``truth`` there.
    """

    frames: Sequence[str]
    key: str
    place: str
    known: Mapping[str, Any]

    @abstractmethod
    def missing(self) -> list[int]:
        """Places in ``frames`` of those that are not there, in order."""

    @abstractmethod
    def begin(self) -> None:
        """Make the place ready; before the first frame is made, by whoever hands them out."""

    @abstractmethod
    def make(self, frame: int, tell: Callable[[str], None]) -> None:
        """Make a frame, unless it is there by now. Whole or not at all; two that make the same one do no harm.

        Args:
            tell: told that the place is gone and waited for.

        Raises:
            DataError: its file cannot be read, or the place cannot be written.
        """

    @abstractmethod
    def complete(self) -> None:
        """What is to be written when all frames are there, if anything."""

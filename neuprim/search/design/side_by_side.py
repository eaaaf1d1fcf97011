"""Trained models measured together: images of each once, then frames of all in turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from neuprim.core.data import Dataset
from neuprim.search.design.record import Model
from neuprim.search.tradeoff.measure import Drawing, Models, look, take_turns
from neuprim.search.tradeoff.record import Measured
from neuprim.search.tradeoff.subject import Subject, exact_images, load_subject
from neuprim.search.truths import Truth

__all__ = ["SideBySide"]


class SideBySide:
    """The models of a set, opened when first asked for.

    Args:
        folder: of the set.
        dataset, truths: theirs.
    """

    def __init__(
        self,
        folder: Path,
        dataset: Dataset,
        truths: list[Truth],
        lpips: Path | None,
        progress: Callable[[str, float], None],
    ) -> None:
        self.folder, self.dataset, self.truths, self.lpips, self.progress = folder, dataset, truths, lpips, progress
        self._open: dict[Path, tuple[Subject, Models]] = {}

    def subject(self, run_dir: Path) -> tuple[Subject, Models]:
        """A model's run directory as it is measured."""
        if run_dir not in self._open:
            subject = load_subject(run_dir, (), len(self.truths), self.lpips, (self.dataset, self.truths))
            self._open[run_dir] = subject, Models(subject)
        return self._open[run_dir]

    @property
    def backend_name(self) -> str:
        """Of the backend that draws the first model opened; empty before that."""
        return next((subject.backend(subject.reference).name for subject, _ in self._open.values()), "")

    def look(
        self, run_dir: Path, knob: str, allowed: float, float64: bool | None
    ) -> tuple[Measured, dict[str, object]]:
        """Images, bytes and memory of a model, against its own exact images, and how these were drawn.

        Args:
            allowed: seconds that the exact images may take in float64.
            float64: whether that is how they are drawn, where it is decided already.
        """
        subject, models = self.subject(run_dir)
        exact = exact_images(subject, allowed, float64)
        measured, _ = look(subject, models, knob, subject.reference, exact)
        return measured, exact.record()

    def ready(self, model: Model) -> Drawing:
        """What draws a model's views."""
        subject, models = self.subject(self.folder / model.run_dir)
        return models.ready(subject.reference)

    def take_times(self, found: Sequence[Model], repeats: int, deadline: float, done: Callable[[], None]) -> None:
        """Rounds of all that have fewer than ``repeats``; the first model is the one that others are compared with."""
        if all(len(model.ms) >= repeats for model in found):
            return

        def tell(number: int, count: int) -> None:
            self.progress(f"round {number} of {count}, {len(found)} models", (number - 1) / count)

        take_turns(
            self.truths, self.ready, [(model, model) for model in found], lambda model: repeats, deadline, tell, done
        )

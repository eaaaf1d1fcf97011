"""The curve of a run: lines of ``metrics.jsonl``, and the few held-out views behind its ``eval_psnr``."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import TracebackType

from neuprim.core.io.files import write_text
from neuprim.core.io.plain import load_json
from neuprim.core.metrics import psnr
from neuprim.core.train.trainer import Trainer
from neuprim.runs.measure import render_image

_VIEWS = 5  # held-out views behind the curve's eval_psnr
_PSNR_MAX = 200.0  # dB; equal images have an infinite one


class Curve:
    """``metrics.jsonl``, to which lines are added whole or not at all: those that a full disk did not take are gone."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = open(path, "ab", buffering=0)

    def add(self, line: str) -> None:
        """Raises OSError; what was there is intact."""
        data, end = line.encode(), os.fstat(self._file.fileno()).st_size
        try:
            if self._file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            os.truncate(self._file.fileno(), end)
            raise

    def __enter__(self) -> Curve:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def open_curve(path: Path, step: int) -> Curve:
    """metrics.jsonl, cut back to what the checkpoint knows."""
    kept = []
    if step and path.exists():
        for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                if load_json(text, infinite=True)["step"] <= step:
                    kept.append(text)
            except (ValueError, KeyError, TypeError, RecursionError):
                continue  # a line that a kill cut short
    write_text(path, "".join(f"{text}\n" for text in kept))
    return Curve(path)


def next_evaluation_progress(trainer: Trainer) -> float:
    """The progress at which the curve gets its next point."""
    every = trainer.settings.eval_every
    return (int(trainer.progress / every + 1e-9) + 1) * every if every > 0 else float("inf")


def evaluate_curve_point(trainer: Trainer) -> float:
    """Mean PSNR of a few held-out views as :func:`~neuprim.runs.measure.measure_views` has it, but at most 200 dB, so
    that a
    line of JSON can hold it; does not touch the training state."""
    views = trainer.dataset.test
    picks = sorted({i * len(views) // _VIEWS for i in range(_VIEWS)})

    total = 0.0
    for i in picks:
        pixels = views.pixels(i)
        rendered = render_image(trainer.model, views.view(i), trainer.renderer, trainer.dataset.background)
        total += min(psnr(rendered, pixels.over(trainer.dataset.background), pixels.mask), _PSNR_MAX)
    return total / len(picks)

"""What is measured of a point: once what its images are like, then, in turns with all others, how long they take."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from neuprim.core.data import View
from neuprim.core.metrics import psnr, ssim, ssim_3dgs
from neuprim.core.model.primitives import Primitives
from neuprim.runs.render_config import RenderConfig, estimate_file_bytes
from neuprim.search.tradeoff.memory import peak_bytes
from neuprim.search.tradeoff.record import Measured
from neuprim.search.tradeoff.subject import Exact, Subject
from neuprim.search.truths import Truth, masked

__all__ = ["Drawing", "Models", "look", "take_turns"]

_KEPT = 1 << 29
"""Bytes of models that are kept between rounds."""

_BESIDE = 6
"""Points to each drawing of the reference in a round."""

_TINY = 16
"""Pixels on a side of an image that is drawn beforehand, so that what is compiled and loaded at a first one is no part
of a frame."""


Drawing = Callable[[View], Tensor]
"""A view -> its (H, W, C) image."""

P = TypeVar("P")
M = TypeVar("M", bound=Measured)


class Models:
    """Models as points draw them, kept while there is room."""

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._kept: dict[tuple[tuple[str, ...], str], Primitives] = {}

    def of(self, point: RenderConfig) -> Primitives:
        own = RenderConfig(reduced=point.reduced, storage=point.storage).to_overrides(RenderConfig().settings)
        key = own, f"{point.settings.backend} {point.settings.device}"
        if key not in self._kept:
            found = self._subject.prepared(point)
            size = sum(v.numel() * v.element_size() for m in (*self._kept.values(), found) for v in m.params.values())
            if size > _KEPT:
                self._kept.clear()
            self._kept[key] = found
        return self._kept[key]

    def ready(self, point: RenderConfig) -> Drawing:
        """What draws the views of a point, with its model at hand."""
        model = self.of(point)
        return lambda view: point.render_view(model, view, self._subject.background)


def look(subject: Subject, models: Models, knob: str, point: RenderConfig, exact: Exact) -> tuple[Measured, float]:
    """A point's images against ground truth and exact images, its size and memory; and the seconds that all images took
    together.

    Numbers are means over views; PSNR against the exact images is that of the mean squared error over all of them, and
    no more than the exact images themselves are known to.
    """
    model = models.of(point)
    card = model.device if model.device.type != "cpu" else None
    rows: list[dict[str, float]] = []
    peaks: list[int] = []
    seconds = 0.0
    _warm(models.ready(point), subject.truths[0].view)
    for truth, ideal in zip(subject.truths, exact.images, strict=True):
        start = time.perf_counter()
        image, peak = peak_bytes(lambda: point.render_view(model, truth.view, subject.background), card)  # noqa: B023 - called at once
        seconds += time.perf_counter() - start
        peaks += [] if peak is None else [peak]
        seen, wanted = masked(image, truth), truth.image
        shown, goal = (subject.channels.display(x).clamp(0.0, 1.0) for x in (seen, wanted))
        row = {"psnr": psnr(seen, wanted, truth.mask), "ssim": ssim(seen, wanted), "ssim_3dgs": ssim_3dgs(shown, goal)}
        row |= {"mse_exact": float((image.double() - ideal).square().mean()), "ssim_exact": ssim(image.double(), ideal)}
        if subject.lpips is not None and min(shown.shape[:2]) >= subject.lpips.least:
            row |= {"lpips": subject.lpips(shown, goal), "lpips_3dgs": subject.lpips.unmapped(shown, goal)}
        rows.append(row)
    quality = {
        name: float(np.mean([row[name] for row in rows])) for name in rows[0] if all(name in row for row in rows)
    }
    error = quality.pop("mse_exact")
    against = -10.0 * math.log10(error) if error > 0 else math.inf
    quality["psnr_exact"] = against if exact.error is None else min(against, exact.error)
    size = estimate_file_bytes(subject.file, subject.model, model, point.storage)
    return Measured(knob, subject.words(point), quality, size, max(peaks, default=None)), seconds


def take_turns(
    truths: Sequence[Truth],
    ready: Callable[[P], Drawing],
    points: Sequence[tuple[P, M]],
    rounds: Callable[[M], int],
    deadline: float,
    tell: Callable[[int, int], None],
    done: Callable[[], None],
) -> None:
    """Time points in rounds: of every view every point once and the reference several times, in another order each
    time; then the next view.

    Before a frame that counts the same one is drawn, so that it finds what it would in a film: its own model in the
    processor's caches, and not that of whatever came before it. A round gives each point its mean milliseconds per
    frame, and a ratio: of each view its time over the median of the reference's beside it, of these the median over the
    views, so that what else the machine does for a moment decides nothing.

    Args:
        truths: of the views to draw.
        ready: a point -> what draws it; finding that is no part of a frame's time.
        points: what is drawn, an operating point or a model, and its numbers; the reference first. It is drawn in every
        round; others until they have their ``rounds``. rounds: how many a point is to have.
        deadline: of :func:`time.monotonic`, after which no round is begun; but one always is.
        tell: called with (round, of how many) before each.
        done: called after each.
    """
    reference, order = points[0], torch.Generator().manual_seed(len(points[0][1].ms))
    most = max(rounds(m) - len(m.ms) for _, m in points)
    warm = False
    for number in range(most):
        due = [pair for pair in points[1:] if len(pair[1].ms) < rounds(pair[1])]
        if number and not due:
            return
        tell(number + 1, most)
        start = time.monotonic()
        turn = [reference, *due]
        if not warm:
            for point, _ in turn:
                _warm(ready(point), truths[0].view)
            warm = True
        often = 1 + len(due) // _BESIDE
        slots = torch.tensor([0] * often + list(range(1, len(turn))))
        milliseconds: list[list[float]] = [[] for _ in turn]
        ratios: list[list[float]] = [[] for _ in turn]
        for truth in truths:
            times: list[list[float]] = [[] for _ in turn]
            for i in slots[torch.randperm(len(slots), generator=order)].tolist():
                draw = ready(turn[i][0])
                draw(truth.view)
                begin = time.perf_counter()
                draw(truth.view)
                times[i].append(time.perf_counter() - begin)
            beside = statistics.median(times[0])
            for i, own in enumerate(times):
                milliseconds[i].append(1e3 * statistics.median(own))
                ratios[i].append(statistics.median(own) / beside)
        for i, (_, measured) in enumerate(turn):
            measured.ms.append(statistics.mean(milliseconds[i]))
            measured.ratios.append(statistics.median(ratios[i]))
        done()
        if time.monotonic() + (time.monotonic() - start) > deadline:
            return


def _warm(draw: Drawing, view: View) -> None:
    draw(replace(view, camera=view.camera.resized(_TINY, _TINY)))

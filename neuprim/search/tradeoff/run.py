"""Measure a finished run's operating points, find the front, and write ``RUN_DIR/tradeoff/``; what is measured already
is kept."""

from __future__ import annotations

import hashlib
import math
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.config.target import parse_duration
from neuprim.core.compute import device
from neuprim.core.compute.threads import core_count, cpu_name
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.render import backends
from neuprim.core.render.quadrature import compare_quadrature
from neuprim.report.tradeoff import write_tradeoff
from neuprim.runs.fit import use_one_torch_thread
from neuprim.runs.open import LOGS
from neuprim.runs.render_config import RenderConfig, parse_render_config
from neuprim.search.tradeoff.combine import fronts, size_points, speed_points
from neuprim.search.tradeoff.knobs import COMBINED, Candidate, LeftOut, candidates, check_knobs
from neuprim.search.tradeoff.measure import Models, look, take_turns
from neuprim.search.tradeoff.memory import UNKNOWN
from neuprim.search.tradeoff.pictures import pictures
from neuprim.search.tradeoff.record import Measured, Record, command, read_record, write_csv
from neuprim.search.tradeoff.subject import Exact, Subject, exact_images, load_subject
from neuprim.version import __version__

__all__ = ["FOLDER", "Request", "seconds_of", "tradeoff_run"]

FOLDER = "tradeoff"
"""Of a run directory."""

_EXACT, _SEEN, _TIMED, _COMBINED = 0.2, 0.45, 0.65, 0.85
"""Parts of the budget by which the exact images, the single knobs' images and their times, and the combinations' images
are to be there."""

_ONE_POINT = 0.1
"""Part of the budget that one point's times may take."""

_CHORDS = 96
"""Pixels on the longer side of the image whose chords are sampled."""


def seconds_of(budget: str, said: str = "--budget ") -> float:
    """Seconds of a budget such as 90s, 5m or 1h; ``said`` stands before it in messages.

    Raises:
        ConfigError: it is something else.
    """
    return parse_duration(budget, f"{said}{budget}")


@dataclass(frozen=True)
class Request:
    """What to measure.

    Attributes:
        views: held-out views, evenly spread.
        repeats: rounds of timing.
        knobs: names of those to turn; empty for all.
        budget: seconds, about; points that do not fit are left out.
        words: of the operating point that others are compared with, over how the run draws.
        lpips: weights for LPIPS; without, those that the run names.
    """

    run_dir: Path
    views: int = 5
    repeats: int = 15
    knobs: Sequence[str] = ()
    budget: float = 300.0
    words: Sequence[str] = ()
    lpips: Path | None = None


Progress = Callable[[str, float], None]


@dataclass
class _Work:
    """One session of measuring."""

    request: Request
    subject: Subject
    record: Record
    progress: Progress
    begun: float = field(default_factory=time.monotonic)
    points: dict[tuple[str, ...], RenderConfig] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.models, self.file = Models(self.subject), self.request.run_dir / FOLDER / "tradeoff.json"
        self._exact: Exact | None = None

    def deadline(self, part: float) -> float:
        return self.begun + part * self.request.budget

    @property
    def exact(self) -> Exact:
        """Drawn when the first point needs them."""
        if self._exact is None:
            self.progress("exact images", 0.0)
            known = self.record.facts.get("exact", {}).get("float64")
            self._exact = exact_images(self.subject, _EXACT * self.request.budget, known)
            self.record.facts.setdefault("exact", self._exact.record())
        return self._exact

    def leave_out(self, candidate: Candidate, reason: str) -> None:
        self.record.left_out.append(LeftOut(candidate.knob, self.subject.words(candidate.point), reason))

    def look_at(self, wanted: Sequence[Candidate], part: float) -> None:
        """Images, bytes and memory of those that are not in the record yet."""
        for number, candidate in enumerate(wanted):
            words = self.subject.words(candidate.point)
            self.points[words] = candidate.point
            if self.record.find(words) is not None:
                continue
            if self.record.points and time.monotonic() > self.deadline(part):
                self.leave_out(candidate, f"no time left of the budget of {self.request.budget:g} s")
                continue
            reason = self.too_slow(candidate)
            if reason is not None:
                self.leave_out(candidate, reason)
                continue
            self.progress(f"images of point {number + 1} of {len(wanted)}", number / len(wanted))
            try:
                measured, seconds = look(self.subject, self.models, candidate.knob, candidate.point, self.exact)
            except ConfigError as error:  # a format that does not hold the model's values
                self.leave_out(candidate, str(error))
                continue
            most = max(1, int(_ONE_POINT * self.request.budget / max(seconds, 1e-9)))
            measured.rounds = most if most < self.request.repeats else None
            self.record.points.append(measured)
            self.record.write(self.file)

    def too_slow(self, candidate: Candidate) -> str | None:
        """Why a point is not drawn at all: images of the oracle may take a thousand times as long as the run's own."""
        if self.subject.backend(candidate.point).name != backends.REFERENCE or candidate.knob == "reference":
            return None
        if self.subject.backend(self.subject.reference).name == backends.REFERENCE:
            return None
        known = self.record.facts.get("exact")
        seconds = (known["oracle_seconds"] if known else self.exact.oracle_seconds) * len(self.subject.truths)
        allowed = _ONE_POINT * self.request.budget
        return (
            f"its images would take about {seconds:.0f} s, of {allowed:.0f} s that a point may have"
            if seconds > allowed
            else None
        )

    def take_times(self, part: float) -> None:
        """Rounds of all points that lack some."""
        pairs = [(self.points[m.words], m) for m in self.record.points if m.words in self.points]
        reference = next(i for i, (_, m) in enumerate(pairs) if m is self.record.reference)
        pairs.insert(0, pairs.pop(reference))

        def wanted(measured: Measured) -> int:
            return min(self.request.repeats, measured.rounds or self.request.repeats)

        def tell(number: int, count: int) -> None:
            self.progress(f"round {number} of {count}, {len(pairs)} points", (number - 1) / count)

        if any(len(m.ms) < wanted(m) for _, m in pairs):
            take_turns(
                *(self.subject.truths, self.models.ready, pairs, wanted, self.deadline(part), tell),
                lambda: self.record.write(self.file),
            )


def tradeoff_run(
    request: Request,
    tell: Callable[[str], None] = lambda text: None,
    progress: Progress = lambda text, fraction: None,
) -> Record:
    """Measure, and write ``tradeoff.json``, ``tradeoff.csv``, ``tradeoff.html`` and ``front.png`` into the run's folder
    :data:`FOLDER`.

    Args:
        tell: called with lines for the user.
        progress: called with (text, fraction 0..1 of what the text names).

    Raises:
        NeuprimError: no such run or knob, no held-out views, words that do not fit, or a damaged record.
    """
    subject = load_subject(request.run_dir, request.words, request.views, request.lpips)
    check_knobs(request.knobs, subject.model)
    folder = request.run_dir / FOLDER
    record = _kept(folder / "tradeoff.json", _same(subject), tell)
    record.left_out.clear()
    work = _Work(request, subject, record, progress)
    with subject.suspects.watch(request.run_dir / LOGS), use_one_torch_thread():
        reference = subject.reference
        fault = subject.fault(reference)
        if fault is not None:
            raise ConfigError(fault)
        singles, out = candidates(request.knobs, reference, subject.model, subject.fault, subject.config.renderer)
        record.left_out += out
        singles = [Candidate("reference", reference), *(one for one in singles if subject.differs(one))]
        _describe(record, subject)
        work.look_at(singles, _SEEN)
        work.take_times(_TIMED)
        found = [(parse_render_config(m.words, subject.config.renderer, subject.model), m) for m in record.points]
        together = {
            subject.words(p): p for p in (*speed_points(reference, found), *size_points(reference, found, subject))
        }
        work.look_at([Candidate(COMBINED, point) for point in together.values()], _COMBINED)
        work.take_times(1.0)
        if not record.marching:
            record.marching = _marching(subject)
        record.speed, record.size = fronts(
            reference,
            [parse_render_config(m.words, subject.config.renderer, subject.model) for m in record.points],
            record,
        )
        record.write(work.file)
        write_csv(folder / "tradeoff.csv", record, lambda number: subject.model.count)
        progress("pictures of the front", 0.0)
        shown = pictures(subject, record, work.models)
    write_tradeoff(folder, record.to_dict(), shown, lambda words: command(str(request.run_dir), words))
    return record


# ---------------------------------------------------------------- what is kept


def _same(subject: Subject) -> dict[str, Any]:
    """What makes an earlier point worth keeping; JSON-able."""
    camera = subject.truths[0].view.camera
    model = hashlib.sha256(subject.file.read_bytes()).hexdigest()
    return {
        "model": model,
        "settings": asdict(subject.config.renderer),
        "reference": list(subject.words(subject.reference)),
        "scene": {
            "name": subject.config.scene_name,
            **{key: str(value) for key, value in subject.config.scene.items()},
        },
        "views": [truth.view.name for truth in subject.truths],
        "image_size": [camera.width, camera.height],
        "lpips": None if subject.lpips is None else subject.lpips.network,
        "machine": {
            "cpu": cpu_name(),
            "cores": core_count(),
            "device": subject.backend(subject.reference).computing_on(subject.reference.settings),
        },
        "versions": {
            "neuprim": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
    }


def _kept(path: Path, same: dict[str, Any], tell: Callable[[str], None]) -> Record:
    """The record so far, if it is of the same; else an empty one."""
    before = read_record(path)
    if before is None:
        return Record(same)
    changed = [name for name in same if before.same.get(name) != same[name]]
    if changed:
        tell(f"{path}: measured with {' and '.join(changed)} of before; all is measured anew")
        return Record(same)
    if before.points:
        tell(f"{path}: {len(before.points)} points measured already are kept; delete it to measure anew")
    return before


def _describe(record: Record, subject: Subject) -> None:
    """Facts that do not depend on what is measured."""
    record.facts |= {
        "task": subject.config.task,
        "scene": subject.config.scene_name,
        "dataset": subject.dataset.name,
        "data_source": subject.dataset.data_source,
        "primitives": subject.model.count,
        "backend": subject.backend(subject.reference).name,
        "shown": subject.channels.shown,
        "not_measured": {} if subject.lpips is not None else {"lpips": "no weights were given (--lpips FILE)"},
    }
    if not Path("/proc/self/clear_refs").exists() and subject.prepared(subject.reference).device.type == device.CPU:
        record.facts["not_measured"]["peak_bytes"] = UNKNOWN


def _marching(subject: Subject) -> dict[str, Any]:
    """Closed form against sampled chords on one small view of the model in float64."""
    view = subject.small(_CHORDS)
    camera = view.camera
    lowered = subject.double.lower(camera, view.conditions, subject.reference.settings)
    try:
        found = compare_quadrature(lowered, camera, subject.reference.settings)
    except NeuprimError as error:
        return {"not_measured": str(error)}
    rows = [
        {
            "samples": way.samples,
            "psnr": None if math.isinf(way.psnr) else way.psnr,
            "max_abs": way.max_abs,
            "seconds": way.seconds,
        }
        for way in found
    ]
    return {"image_size": [camera.width, camera.height], "chords": found[0].chords, "rows": rows}

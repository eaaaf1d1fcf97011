"""Short trainings that a search compares, each in a folder that is a run directory without report and pictures.

``trial.json`` beside the run's files says what was asked for and, once it is known, what came out. A trial that is done
is read back; one that was interrupted goes on from its checkpoint; one whose folder was made with other settings is
trained anew there.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.config import RunConfig, made_now, suspects_of, task_of
from neuprim.core.data import Dataset
from neuprim.core.errors import DataError
from neuprim.core.io.files import read_json, write_json
from neuprim.core.metrics import from_json, psnr, ssim, to_json
from neuprim.runs.curve import read_curve
from neuprim.runs.events import Events, Finishing, Note, ignore_event
from neuprim.runs.fit import Fitted
from neuprim.runs.measure import render_image
from neuprim.runs.open import LOGS
from neuprim.runs.run_directory import lock_directory
from neuprim.runs.training import train_in_directory
from neuprim.search.truths import masked, truths_of

__all__ = ["FILE", "Outcome", "Trial", "read_outcome", "run_trial"]

FILE = "trial.json"
"""Of a trial's folder."""

FORMAT = 1

_OWN = ("output_dir", "resume", "overrides", "non_default")
"""Of a configuration, what does not change what is trained."""


@dataclass(frozen=True)
class Trial:
    """What a search asks for.

    Attributes:
        config: composed; its ``output_dir`` is the trial's folder, its budget in ``train.iterations`` or
        ``train.max_seconds``. hold_out: n > 1: judged by every n-th training view, which it does not learn from; 0: by
        the test views. views: at most so many of the views that judge are measured, evenly spread.
    """

    config: RunConfig
    hold_out: int = 0
    views: int = 8


@dataclass(frozen=True)
class Outcome:
    """What came out of a trial.

    Attributes:
        psnr, ssim: means over the judged views, in the data set's own colour space.
        parameters_per_primitive: numbers that one primitive has.
        bytes: of ``model.safetensors``.
        steps, seconds: of training.
        ms_per_frame: median over the judged views.
        curve: (used fraction of the budget, PSNR of a few judged views, dB), a pair every ``train.eval_every``.
    """

    psnr: float
    ssim: float
    primitives: int
    parameters_per_primitive: int
    bytes: int
    steps: int
    seconds: float
    ms_per_frame: float
    curve: tuple[tuple[float, float], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {**asdict(self), **to_json("psnr", self.psnr), "curve": [list(point) for point in self.curve]}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Outcome:
        """What :meth:`to_dict` gave; KeyError, TypeError or ValueError for anything else."""
        quality = from_json(data, "psnr")
        if quality is None:
            raise ValueError("psnr is no number")
        curve = tuple((float(progress), float(value)) for progress, value in data["curve"])
        return cls(
            psnr=quality,
            ssim=float(data["ssim"]),
            primitives=int(data["primitives"]),
            parameters_per_primitive=int(data["parameters_per_primitive"]),
            bytes=int(data["bytes"]),
            steps=int(data["steps"]),
            seconds=float(data["seconds"]),
            ms_per_frame=float(data["ms_per_frame"]),
            curve=curve,
        )


def run_trial(trial: Trial, dataset: Dataset | None = None, events: Events = ignore_event) -> Outcome:
    """Train and judge, or read back what is there already.

    Ctrl-C while it trains finishes the step, writes a checkpoint and raises KeyboardInterrupt; the same call goes on
    from there.

    Args:
        dataset: the scene of the configuration, whole, if it is loaded already.
        events: told what happens.

    Raises:
        DataError: the folder holds a run that is no trial, or a damaged ``trial.json``.
        NeuprimError: as :func:`neuprim.runs.run.run`.
    """
    with lock_directory(trial.config.output_dir, "trial"):
        return _run_trial(trial, dataset, events)


def _run_trial(trial: Trial, dataset: Dataset | None, events: Events) -> Outcome:
    folder = trial.config.output_dir
    asked = _asked(trial)
    before = _read(folder / FILE)
    if before is None and (folder / "config.yaml").exists():
        raise DataError(f"{folder}: holds a run and no {FILE}; expected a new folder, or that of a trial")
    same = before is not None and before["asked"] == asked
    if before is not None and not same:
        changed = sorted(_names(before["asked"], asked))
        events(Note(f"{folder}: tried with another {', '.join(changed)}; trained anew"))
        (folder / "checkpoint.safetensors").unlink(missing_ok=True)
    if (
        same
        and before is not None
        and before["outcome"] is not None
        and before["views"] == trial.views
        and _whole(folder)
    ):
        return _outcome(folder / FILE, before["outcome"])
    record = {"format": FORMAT, "asked": asked, "views": trial.views, "outcome": None}
    write_json(folder / FILE, record)
    suspects = suspects_of(trial.config)
    with suspects.watch(folder / LOGS):
        fitted, interrupted = train_in_directory(
            replace(trial.config, resume=same), suspects, events, dataset, trial.hold_out
        )
        if interrupted:
            raise KeyboardInterrupt
        events(Finishing("measuring views that judge"))
        outcome = _judged(fitted, trial.views)
    write_json(folder / FILE, {**record, "outcome": outcome.to_dict()})
    return outcome


def read_outcome(folder: Path) -> Outcome | None:
    """What came out of the trial in a folder; None where there is none, or none yet.

    Raises:
        DataError: ``trial.json`` is damaged.
    """
    found = _read(folder / FILE)
    return None if found is None or found["outcome"] is None else _outcome(folder / FILE, found["outcome"])


def _judged(fitted: Fitted, views: int) -> Outcome:
    fitted.unlock()
    model, dataset, config = fitted.model, fitted.dataset, fitted.config
    truths = truths_of(dataset, views)
    rows, seconds = [], []
    render_image(
        model, truths[0].view, config.renderer, dataset.background
    )  # whatever a first frame loads is no part of its time
    for truth in truths:
        start = time.perf_counter()
        drawn = render_image(model, truth.view, config.renderer, dataset.background)
        seconds.append(time.perf_counter() - start)
        image = masked(drawn, truth)
        rows.append((psnr(image, truth.image, truth.mask), ssim(image, truth.image)))
    quality, structure = (float(np.mean(column)) for column in zip(*rows, strict=True))
    return Outcome(
        psnr=quality,
        ssim=structure,
        primitives=model.count,
        parameters_per_primitive=model.parameters_per_primitive,
        bytes=(config.output_dir / "model.safetensors").stat().st_size,
        steps=fitted.trainer.step,
        seconds=fitted.trainer.elapsed,
        ms_per_frame=1e3 * statistics.median(seconds),
        curve=read_curve(config.output_dir / "metrics.jsonl", config.train),
    )


# ---------------------------------------------------------------- what is kept


def _asked(trial: Trial) -> dict[str, Any]:
    """What must be the same for a folder to be the trial's, as JSON brings it back."""
    config = replace(trial.config, made_by=made_now(trial.config, task_of(trial.config)))
    settings = {name: value for name, value in config.to_dict().items() if name not in _OWN}
    kept: dict[str, Any] = json.loads(json.dumps({**settings, "hold_out": trial.hold_out}))
    return kept


def _names(a: Mapping[str, Any], b: Mapping[str, Any], where: str = "") -> set[str]:
    """Dotted names of what differs."""
    found = set()
    for key in a.keys() | b.keys():
        before, after, name = a.get(key), b.get(key), f"{where}{key}"
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            found |= _names(before, after, f"{name}.")
        elif before != after:
            found.add(name)
    return found


def _whole(folder: Path) -> bool:
    return all((folder / name).exists() for name in ("config.yaml", "model.safetensors"))


def _read(file: Path) -> dict[str, Any] | None:
    data = read_json(file, "the record of a trial", "delete its folder to train anew")
    if data is None:
        return None
    if (
        not isinstance(data, dict)
        or not isinstance(data.get("asked"), dict)
        or "outcome" not in data
        or "views" not in data
    ):
        raise DataError(f"{file}: not the record of a trial; delete its folder to train anew")
    if data.get("format") != FORMAT:
        raise DataError(
            f"{file}: format {data.get('format')!r}; this neuprim reads {FORMAT}; delete its folder to train anew"
        )
    return data


def _outcome(file: Path, data: Any) -> Outcome:
    try:
        return Outcome.from_dict(data)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = f"{type(error).__name__}: {error}"
        raise DataError(f"{file}: not the record of a trial ({what}); delete its folder to train anew") from error

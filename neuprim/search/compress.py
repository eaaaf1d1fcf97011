"""``neuprim compress``: a run's model in few bits, in one file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from neuprim.config import RunConfig, suspects_of
from neuprim.core.checkpoint import extra_of, load_model, save_compressed
from neuprim.core.compression import DEFAULT_LEVEL, bit_table
from neuprim.core.data import Dataset
from neuprim.core.data.dataset_check import check_dataset
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.io.files import refuse_existing
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import TaskSpec
from neuprim.runs.measure import measure_quality
from neuprim.runs.open import COMPRESSED, LOGS, load_dataset, load_run
from neuprim.search.few_bits import Fewer, train_for, train_within

__all__ = ["TOLERANCE", "Compression", "StoredParameter", "compress_run"]

Progress = Callable[[str, float], None]

TOLERANCE = 0.1
"""dB that judged training views may lose, unless said otherwise."""


@dataclass(frozen=True)
class StoredParameter:
    """A parameter's bits for a number, as text, its bytes in float32 and those in the file."""

    name: str
    bits: str
    before: int
    after: int


@dataclass(frozen=True)
class Compression:
    """What became of a model.

    Attributes:
        file: where it is; before: bytes of its numbers in float32; after: of the file.
        measured: "psnr" and "ssim" -> means over the held-out views before and after; empty where the run's data are
        not there. seconds: of training, taking apart and writing; steps: of training.
    """

    file: Path
    parameters: tuple[StoredParameter, ...]
    before: int
    after: int
    measured: dict[str, tuple[float, float]]
    seconds: float
    steps: int = 0
    notes: tuple[str, ...] = ()


def compress_run(
    run_dir: Path,
    level: int | None = None,
    bits: Iterable[str] = (),
    out: Path | None = None,
    overwrite: bool = False,
    progress: Progress = lambda text, fraction: None,
    seconds: float = 0.0,
    steps: int | None = None,
    tolerance: float | None = None,
) -> Compression:
    """Write a run's model as a compressed file, whole or not at all, and measure what that costs where the run's data
    are there.

    Unless a level or bits are given, training views decide how coarse every number may be: as coarse as ``tolerance``
    allows. Where the run's data are not there, it is :data:`~neuprim.core.compression.DEFAULT_LEVEL`.

    With ``seconds`` or ``steps`` the numbers are trained for the few bits first: every image of a step is drawn of what
    will be read back, and gradients go to the numbers themselves (straight through). What training views say is better,
    trained or not, is written.

    Args:
        level: 1 (nearly everything) to 5 (very little), see :data:`neuprim.core.compression.LEVELS`.
        bits: words NAME=BITS over the level's own, or over those of :data:`~neuprim.core.compression.DEFAULT_LEVEL`.
        out: the file; None: ``model.neuprim`` in the run directory.
        overwrite: whether a file that exists may be replaced.
        progress: called with (text, fraction 0..1).
        seconds: of fine-tuning, about; steps: so many instead, which gives the same file again.
        tolerance: dB that training views may lose, :data:`TOLERANCE` unless given; neither with a level nor with bits.

    Raises:
        NeuprimError: no such run, level or parameter, numbers that cannot be stored, or a file in the way.
    """
    bits = tuple(bits)
    if tolerance is not None and (level is not None or bits):
        raise ConfigError(
            f"--tolerance {tolerance:g}: decides the bits of every number; expected no {'--bits' if bits else '--level'} beside it"
        )
    final = run_dir / COMPRESSED if out is None else out
    if final.is_dir():
        raise ConfigError(f"--out {final}: is a folder; expected the name of a file")
    refuse_existing(final, overwrite)
    config, task, model, header = load_run(run_dir)
    config = replace(config, output_dir=run_dir)
    table = bit_table(DEFAULT_LEVEL if level is None else level, bits, model.specs)
    extra = extra_of(header)
    notes = ["its primitives are in another order than the run's"]
    dataset: Dataset | None = None
    try:
        progress("reading the run's data", 0.0)
        dataset = _dataset(run_dir, config, task)
    except NeuprimError as error:
        training = " and it was not trained for few bits" if steps or (steps is None and seconds > 0) else ""
        notes.append(f"what this costs was not measured{training}, as the run's data cannot be read: {error}")
    start = time.perf_counter()
    with suspects_of(config).watch(run_dir / LOGS):
        fewer: Fewer | None = None
        if dataset is not None and level is None and not bits:
            allowed = TOLERANCE if tolerance is None else tolerance
            fewer = train_within(config, task, dataset, model, allowed, seconds, steps, progress)
        elif dataset is not None and (steps or (steps is None and seconds > 0)):
            fewer = train_for(config, task, dataset, model, table, seconds, steps, progress)
        elif level is None and not bits:
            notes.append(f"no training views say how coarse its numbers may be; they are of --level {DEFAULT_LEVEL}")
        notes += () if fewer is None else fewer.notes
        text = (run_dir / "config.yaml").read_text(encoding="utf-8")
        whole, coded = (model, table) if fewer is None else (fewer.model, fewer.made)
        stored = save_compressed(final, whole, task.name, extra, coded, text)
    taken = time.perf_counter() - start
    parameters = tuple(
        StoredParameter(s.name, stored[s.name].bits, 4 * model.count * s.size, stored[s.name].size)
        for s in model.specs
        if s.size
    )
    again, _ = load_model(final, task)
    measured: dict[str, tuple[float, float]] = {}
    if dataset is not None:
        measured = _costs(run_dir, config, task, dataset, model, again, progress)
    before = sum(p.before for p in parameters)
    return Compression(
        final,
        parameters,
        before,
        final.stat().st_size,
        measured,
        taken,
        0 if fewer is None else fewer.steps,
        tuple(notes),
    )


def _dataset(run_dir: Path, config: RunConfig, task: TaskSpec) -> Dataset:
    dataset = load_dataset(config, task, run_dir=run_dir)
    with suspects_of(config).watch(run_dir / LOGS):
        check_dataset(dataset, task.conditions)
    return dataset


def _costs(
    run_dir: Path,
    config: RunConfig,
    task: TaskSpec,
    dataset: Dataset,
    model: Primitives,
    again: Primitives,
    progress: Progress,
) -> dict[str, tuple[float, float]]:
    """PSNR and SSIM before and after, as in ``metrics.json``."""
    suspects = suspects_of(config)
    found = []
    with suspects.watch(run_dir / LOGS):
        suspects.know(dataset)
        for i, (text, tried) in enumerate((("before", model), ("after", again))):
            progress(f"measuring {text}", i / 2)
            found.append(measure_quality(tried, task, dataset, config.renderer))
    return {name: (found[0][i], found[1][i]) for i, name in enumerate(("psnr", "ssim"))}

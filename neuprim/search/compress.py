"""Write a run's model as a quantized file, ``neuprim compress``, and measure what that costs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from neuprim.config import Job
from neuprim.core.checkpoint import load_model_checkpoint, read_header_extra, save_compressed
from neuprim.core.compression import DEFAULT_LEVEL, BitTable, Quantizers, bit_table
from neuprim.core.data.dataset_check import check_dataset_views
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.io.files import refuse_existing
from neuprim.core.model.primitives import Primitives
from neuprim.runs.fit import use_one_torch_thread_for_run
from neuprim.runs.measure import measure_quality
from neuprim.runs.open import COMPRESSED, load_dataset, load_run
from neuprim.runs.training import count_run_finetune_steps
from neuprim.search.quantized_finetune import (
    Progress,
    QuantizedModel,
    TrainingData,
    finetune_for_table,
    search_fewest_bits,
)

DEFAULT_TOLERANCE = 0.1  # dB that training views may lose


@dataclass(frozen=True)
class CompressRequest:
    """What to compress.

    Unless a level or bits are given, training views decide how coarse every number may be, within ``tolerance``.
    Without the run's data the level is :data:`~neuprim.core.compression.DEFAULT_LEVEL`.

    Attributes:
        level: 1 (nearly lossless) to 5 (very small), see :data:`neuprim.core.compression.LEVELS`.
        bits: overrides NAME=BITS of a level.
        out: the file; None for ``model.neuprim`` in the run directory.
        overwrite: whether an existing file may be replaced.
        seconds: of fine-tuning for few bits, about; steps: so many instead, for the same file on every machine.
        tolerance: dB that training views may lose; neither with a level nor with bits.
    """

    run_dir: Path
    level: int | None = None
    bits: Sequence[str] = ()
    out: Path | None = None
    overwrite: bool = False
    seconds: float = 0.0
    steps: int | None = None
    tolerance: float | None = None

    @property
    def by_level(self) -> bool:
        return self.level is not None or bool(self.bits)

    @property
    def trains(self) -> bool:
        return bool(self.steps) or (self.steps is None and self.seconds > 0)


class StoredParameter(NamedTuple):
    """A parameter's bits per number, as text, its bytes in float32 and in the file."""

    name: str
    bits: str
    before: int
    after: int


@dataclass(frozen=True)
class Compression:
    """Result of compressing.

    Attributes:
        before: bytes of the numbers in float32; after: bytes of the file.
        measured: "psnr" and "ssim" -> means over test views before and after; empty without the run's data.
        seconds: of training, encoding and writing; steps: of training.
    """

    file: Path
    parameters: tuple[StoredParameter, ...]
    before: int
    after: int
    measured: dict[str, tuple[float, float]]
    seconds: float
    steps: int
    notes: tuple[str, ...]


def compress_run(request: CompressRequest, progress: Progress = lambda text, fraction: None) -> Compression:
    """Write a run's model as a compressed file, atomically, and measure the loss where the run's data are available.

    Fine-tuning renders every image from quantized numbers (straight-through gradients). The trained or the untrained
    model is written, whichever training views prefer.

    Raises:
        NeuprimError: no such run, level or parameter, numbers that cannot be stored, or an existing file.
    """
    run_dir = request.run_dir
    if request.tolerance is not None and request.by_level:
        other = "--bits" if request.bits else "--level"
        raise ConfigError(f"--tolerance {request.tolerance:g}: decides the bits of every number; expected no {other}")
    final = request.out or run_dir / COMPRESSED
    if final.is_dir():
        raise ConfigError(f"--out {final}: is a folder; expected the name of a file")
    refuse_existing(final, request.overwrite)
    run = load_run(run_dir)
    config, task, model, header = replace(run.config, output_dir=run_dir), run.task, run.model, run.header
    table = bit_table(DEFAULT_LEVEL if request.level is None else request.level, request.bits, model.specs)
    notes, plugins = ["its primitives are in another order than the run's"], run.plugins
    stored, steps, dataset = model, 0, None
    coding: BitTable | Quantizers = table
    with plugins.attribute_errors():
        progress("reading the run's data", 0.0)
        try:
            dataset = load_dataset(run)
            check_dataset_views(dataset, task.conditions)
        except NeuprimError as error:
            dataset = None
            untrained = " and it was not trained for few bits" if request.trains else ""
            notes.append(f"the loss was not measured{untrained}, as the run's data cannot be read: {error}")
            if not request.by_level:
                notes.append(f"no training views decide the bits; they are of --level {DEFAULT_LEVEL}")
        start = time.perf_counter()
        if dataset is not None and (request.trains or not request.by_level):
            with use_one_torch_thread_for_run():
                quantized = _search_quantized_model(
                    request, TrainingData(config, task, dataset), model, table, progress
                )
            stored, coding, steps = quantized.model, quantized.quantizers, quantized.steps
            notes += quantized.notes
        text = (run_dir / "config.yaml").read_text(encoding="utf-8")
        sizes = save_compressed(final, stored, task.name, read_header_extra(header), coding, text)
        seconds = time.perf_counter() - start
        measured: dict[str, tuple[float, float]] = {}
        if dataset is not None:
            progress("measuring test views", 0.0)
            decoded, _ = load_model_checkpoint(final, task)
            before, after = (measure_quality(one, task, dataset, config.renderer) for one in (model, decoded))
            measured = {name: (before[i], after[i]) for i, name in enumerate(("psnr", "ssim"))}
    parameters = tuple(
        StoredParameter(s.name, sizes[s.name].bits, 4 * model.count * s.size, sizes[s.name].size)
        for s in model.specs
        if s.size
    )
    floats = sum(p.before for p in parameters)
    return Compression(final, parameters, floats, final.stat().st_size, measured, seconds, steps, tuple(notes))


def _search_quantized_model(
    request: CompressRequest, data: TrainingData, model: Primitives, table: BitTable, progress: Progress
) -> QuantizedModel:
    steps = request.steps
    if steps is None:
        steps = count_run_finetune_steps(request.seconds, Job(data.config, data.task), data.dataset, model)
    if request.by_level:
        return finetune_for_table(data, model, table, steps, progress)
    tolerance = DEFAULT_TOLERANCE if request.tolerance is None else request.tolerance
    return search_fewest_bits(data, model, tolerance, steps, progress)

"""``neuprim compress``: write a run's model as a quantized file, as coarsely as the quality of its images allows."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from neuprim.config import Job, RunConfig
from neuprim.core.checkpoint import load_model_checkpoint, read_header_extra, save_compressed
from neuprim.core.compression.codec import (
    Quantizers,
    canonical_model,
    fake_quantize,
    fit_quantizers,
    fit_quantizers_to_error,
)
from neuprim.core.compression.quantizers import DEFAULT_LEVEL, BitTable, bit_table
from neuprim.core.data import Dataset
from neuprim.core.data.dataset_check import check_dataset_views
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.io.files import refuse_existing
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import TaskSpec
from neuprim.core.train.sensitivity import inner_sensitivity, sensitivity
from neuprim.runs.fit import use_one_torch_thread_for_run
from neuprim.runs.measure import measure_quality
from neuprim.runs.open import COMPRESSED, load_dataset, load_run
from neuprim.runs.training import count_run_finetune_steps, make_run_finetune_trainer
from neuprim.search.model_quality import SearchQuality
from neuprim.search.pruning_cuts import mask_pruned_numbers

__all__ = ["CompressRequest", "Compression", "StoredParameter", "compress_run"]

Progress = Callable[[str, float], None]

DEFAULT_TOLERANCE = 0.1  # dB that training views may lose

_SENSITIVITY_VIEWS = 48  # training views for the effects of numbers; sums over all primitives need few
_FIRST_LOSS = 2.0  # loss by rounding before the first round of training, in units of the tolerance
_ROUND_STEPS, _MAX_ROUNDS = 500, 3  # least steps of a round, and most rounds; each shows how much training recovers

_SLOPE, _AIM = 0.7, 0.95
"""``_SLOPE``: dB lost after fine-tuning per dB lost before. ``_AIM``: fraction of the tolerance that a round should use
up."""

_MAX_TRIES = 16

_FINEST, _COARSEST = 1e-4, 30.0  # limits of the added error, as shares of the model's squared error


@dataclass(frozen=True)
class CompressRequest:
    """Request for :func:`compress_run`, with the arguments of ``neuprim compress``.

    ``level`` and ``bits`` set the bits of the parameters. If neither is given, parameters get as few bits as possible
    while the PSNR of training views drops by at most ``tolerance``; without data, a default level is used.

    Attributes:
        level: 1 (nearly lossless) to 5 (very small).
        bits: texts NAME=BITS, which replace the level's bits for the parameter NAME.
        out: the file to write; None for ``model.neuprim`` in the run directory.
        overwrite: whether an existing file may be replaced.
        seconds: approximate time of fine-tuning the quantized model.
        steps: number of fine-tuning steps, instead of ``seconds``; the result is then the same on every machine.
        tolerance: PSNR that training views may lose, dB; not together with level or bits.
    """

    run_dir: Path  # the run directory
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
    """Bits and bytes of one parameter in a compressed file."""

    name: str  # name of the parameter
    bits: str  # bits per number, as text
    before: int  # bytes in float32
    after: int  # bytes in the file


@dataclass(frozen=True)
class Compression:
    """Result of :func:`compress_run`."""

    file: Path  # the compressed file
    parameters: tuple[StoredParameter, ...]
    before: int  # bytes of the numbers in float32
    after: int  # bytes of the file
    measured: dict[str, tuple[float, float]]  # "psnr", "ssim" -> means of test views before and after; {} without data
    seconds: float  # time of training, encoding and writing
    steps: int  # steps of training
    notes: tuple[str, ...]  # lines for the user


def compress_run(request: CompressRequest, progress: Progress = lambda text, fraction: None) -> Compression:
    """Write a run's model as a compressed file; measure the loss of quality if the run's data are available.

    Fine-tuning renders every image from quantised parameters (straight-through gradients). The file stores the
    fine-tuned model only if it renders the training views better than the original model.

    Raises:
        NeuprimError: the run, level or parameter does not exist, values cannot be stored, or the file exists already.
    """
    run_dir = request.run_dir
    if request.tolerance is not None and request.by_level:
        other = "bits.NAME=BITS" if request.bits else "--level"
        raise ConfigError(
            f"--tolerance {request.tolerance:g}: the tolerance determines the bits of all numbers; leave {other} out"
        )
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
    """Fine-tune and quantize a model, by ``table`` if the request gives level or bits, else by the tolerance."""
    steps = request.steps
    if steps is None:
        steps = count_run_finetune_steps(request.seconds, Job(data.config, data.task), data.dataset, model)
    if request.by_level:
        return finetune_for_table(data, model, table, steps, progress)
    tolerance = DEFAULT_TOLERANCE if request.tolerance is None else request.tolerance
    return search_fewest_bits(data, model, tolerance, steps, progress)


# ---------------------------------------------------------------- quantization


class TrainingData(NamedTuple):
    """Input of fine-tuning: configuration of the run, task and data set."""

    config: RunConfig
    task: TaskSpec
    dataset: Dataset


class QuantizedModel(NamedTuple):
    """A model in the canonical form that files store, its quantizers, number of training steps, and notes to print."""

    model: Primitives
    quantizers: Quantizers
    steps: int
    notes: tuple[str, ...] = ()


def dequantize(model: Primitives, quantizers: Quantizers) -> Primitives:
    """Return a copy of a model in canonical form (:func:`canonical_model`), with parameters rounded as in a file."""
    params = {name: value.detach() for name, value in fake_quantize(model.params, quantizers).items()}
    return Primitives(model.density, model.colour, params)


class QuantizationSearch:
    """Search for the quantizers of a model, which round its parameters. One number, the *error share*, determines all.

    The error share is the squared error that rounding may add to images, divided by the squared error without rounding.
    Methods begin their search at the share ``start``.
    """

    def __init__(self, model: Primitives, dataset: Dataset, quality: SearchQuality) -> None:
        self.model = canonical_model(model)
        effects = sensitivity(self.model, dataset, quality.others[:_SENSITIVITY_VIEWS], quality.settings)
        if quality.draws:
            inside = inner_sensitivity(self.model, quality.draws, threads=quality.settings.threads)
            effects = effects.combine(inside, quality.inside_weight(self.model))
        columns = sum(spec.size for spec in self.model.specs)
        self._effects = effects.columns
        self._error = 10 ** (-quality.image_quality(self.model) / 10) / max(columns, 1)

    def with_model(self, trained: Primitives) -> QuantizationSearch:
        """Return a search for the fine-tuned model ``trained`` that uses the error estimates of this search."""
        other = copy(self)
        other.model = trained
        return other

    def fit(self, share: float) -> Quantizers:
        """Return the quantizers for the error share ``share``."""
        return fit_quantizers_to_error(self.model, self._effects, share * self._error)

    def find_coarsest(self, accept: Callable[[Quantizers], bool], start: float) -> tuple[Quantizers, float]:
        """Return the coarsest quantizers that ``accept`` accepts, else the finest possible, and their error share.

        ``start`` is the first error share to try.
        """
        fine, _ = self._bisect(accept, start)
        return self.fit(fine), fine

    def find_finest(self, accept: Callable[[Quantizers], bool], start: float) -> tuple[Quantizers, float]:
        """Return the finest quantizers that ``accept`` accepts, else the coarsest possible, and their error share.

        ``start`` is the first error share to try.
        """
        _, coarse = self._bisect(lambda quantizers: not accept(quantizers), start)
        return self.fit(coarse), coarse

    def _bisect(self, is_fine: Callable[[Quantizers], bool], start: float) -> tuple[float, float]:
        """Return two close error shares: ``is_fine`` is true for the first and false for the second.

        If ``is_fine`` is the same for all allowed shares, both are the limit of the allowed range.
        """
        fine, coarse, share = 0.0, 0.0, start
        for _ in range(_MAX_TRIES):
            if is_fine(self.fit(share)):
                fine = share
            else:
                coarse = share
            if coarse == _FINEST or fine == _COARSEST or (fine and coarse and coarse < 1.08 * fine):
                break
            if fine and coarse:
                share = math.sqrt(fine * coarse)
            else:
                share = min(2.0 * fine, _COARSEST) if fine else max(share / 2.0, _FINEST)
        return fine or _FINEST, coarse or _COARSEST


def finetune_for_table(
    data: TrainingData, model: Primitives, table: BitTable, steps: int, progress: Progress
) -> QuantizedModel:
    """Fine-tune a model for ``steps`` steps, and quantize it with the bits in ``table``.

    If the fine-tuned model does not render the training views better, quantize the original model.
    """
    whole = canonical_model(model)
    quantizers, quality = fit_quantizers(whole, table), SearchQuality.of_run(data.config, data.dataset)
    before = quality(dequantize(whole, quantizers))
    progress("training for few bits", 0.0)
    trained = _finetune(data, whole, quantizers, steps)
    after = quality(dequantize(trained, quantizers))
    if after > before:
        return QuantizedModel(trained, quantizers, steps)
    note = (
        f"{steps:,} steps for few bits brought nothing ({after - before:+.3f} dB on training views); stored untrained"
    )
    return QuantizedModel(whole, quantizers, steps, (note,))


def search_fewest_bits(
    data: TrainingData, model: Primitives, tolerance: float, steps: int, progress: Progress
) -> QuantizedModel:
    """Fine-tune a model and quantize it with as few bits as possible; training views lose at most ``tolerance`` dB.

    Args:
        steps: number of fine-tuning steps; 0 for none.
    """
    quality = SearchQuality.of_run(data.config, data.dataset)
    base = quality(model)
    progress("measuring the effect of numbers", 0.0)
    untrained = QuantizationSearch(model, data.dataset, quality)
    search, at_once = untrained, _FIRST_LOSS * tolerance
    best: tuple[Primitives, Quantizers, float] | None = None
    rounds = min(max(steps // _ROUND_STEPS, 1), _MAX_ROUNDS) if steps else 0
    for number in range(rounds):
        share = _tolerated_error_share(at_once)
        quantizers = search.fit(share)
        own = steps * (number + 1) // rounds - steps * number // rounds
        progress("training for few bits", number / rounds)
        search = search.with_model(_finetune(data, search.model, quantizers, own))
        lost = base - quality(dequantize(search.model, quantizers))
        if lost <= tolerance and (best is None or share > best[2]):
            best = search.model, quantizers, share
        at_once = max(at_once + (_AIM * tolerance - lost) / _SLOPE, 0.25 * at_once)
    if best is None:  # of the trained and the untrained model the one that can be stored more coarsely
        progress("looking for the coarsest numbers", 1.0)
        for one in [untrained, search] if rounds else [untrained]:

            def accept(quantizers: Quantizers, model: Primitives = one.model) -> bool:
                return base - quality(dequantize(model, quantizers)) <= tolerance

            found = one.model, *one.find_coarsest(accept, _tolerated_error_share(tolerance))
            best = found if best is None or found[2] > best[2] else best
    assert best is not None
    whole, quantizers, share = best
    note = f"rounding may add {share:.1%} to the squared error; the last bit of every number is worth the same"
    return QuantizedModel(whole, quantizers, steps, (note,))


def _tolerated_error_share(decibels: float) -> float:
    """Return the error share (relative increase of the squared error) that lowers the PSNR by ``decibels``."""
    return float(min(max(10 ** (decibels / 10) - 1, _FINEST), _COARSEST))


def _finetune(data: TrainingData, model: Primitives, quantizers: Quantizers, steps: int) -> Primitives:
    """Fine-tune a model in canonical form (:func:`canonical_model`). Images are rendered from quantized parameters."""
    trainer = make_run_finetune_trainer(Job(data.config, data.task), data.dataset, model, steps)
    trainer.zero_masks = mask_pruned_numbers(trainer.model)
    on_device = {name: quantizer.to(trainer.device) for name, quantizer in quantizers.items()}
    trainer.fake_quantize = lambda params: fake_quantize(params, on_device)
    for _ in range(steps):
        trainer.train_step()
    params = {name: value.detach().cpu() for name, value in trainer.model.params.items()}
    return Primitives(model.density, model.colour, params)

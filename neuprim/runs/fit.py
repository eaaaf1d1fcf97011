"""Train in memory: load the data of a configuration, create its model and train it, without a run directory.

A training reports its progress as events: it calls a listener function with each event, on the training thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch

from neuprim.config import Job, RunConfig, current_config_provenance, find_config_plugins
from neuprim.core.channels import Channels, find_channels
from neuprim.core.compute.threads import limit_threads
from neuprim.core.data import Dataset
from neuprim.core.data.dataset import hold_out_views
from neuprim.core.data.dataset_check import check_dataset_views
from neuprim.core.errors import ConfigError
from neuprim.core.metrics import psnr
from neuprim.core.metrics.lpips import Lpips
from neuprim.core.model.primitives import Primitives, reduce_fields
from neuprim.core.render import backends
from neuprim.core.task import Loss, TaskSpec
from neuprim.core.train.distributed_trainer import DistributedTrainer
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.process_group import ProcessGroup
from neuprim.core.train.settings import TrainSettings, build_settings, loss_settings
from neuprim.core.train.trainer import StepReport, Trainer
from neuprim.plugins.attribution import attribute_errors, call_task_clips, call_task_facts, check_fields, guard_loss
from neuprim.plugins.registry import LOSSES
from neuprim.runs.measure import measure_views, render_image, summarize_run_metrics
from neuprim.runs.open import load_dataset

_CURVE_VIEWS = 5
"""Number of held-out views that are measured during the training."""

_CURVE_PSNR_MAX = 200.0
"""Upper bound of a view's PSNR during the training, dB. Equal images have an infinite PSNR, which JSON cannot store."""

_TRIAL_PRIMITIVES = 10_000
"""Number of primitives for ``model.primitives=auto`` of a trial training; fewer if the data offer fewer points."""

_TRIAL_STEPS, _TRIAL_SECONDS, _TRIAL_WARM, _TRIAL_GPU_WARM = 40, 2.0, 3, 24
"""Limits on the timed steps of a trial training, and steps before the clock starts. On a GPU, the first steps of each
kind are recorded as CUDA graphs."""


__all__ = ["Evaluated", "Finishing", "Fitted", "Note", "Preparing", "Step", "fit"]

# ---------------------------------------------------------------- events


@dataclass(frozen=True)
class Preparing:
    """Event: progress of work before the training loop, such as loading data and compiling kernels."""

    text: str
    fraction: float = 0.0  # done fraction of the work, 0..1


@dataclass(frozen=True)
class Step:
    """Event: one training step has ended."""

    report: StepReport
    progress: float  # used fraction of the budget, 0..1


@dataclass(frozen=True)
class Evaluated:
    """Event: held-out views were measured during the training."""

    psnr: float  # mean PSNR of a few held-out views, dB


@dataclass(frozen=True)
class Finishing:
    """Event: the training loop has ended, and other work begins, such as measuring held-out views."""

    text: str


@dataclass(frozen=True)
class Note:
    """Event: a line of text for the user. A display keeps it on the screen."""

    text: str


Event = Preparing | Step | Evaluated | Finishing | Note
Events = Callable[[Event], None]


def ignore_run_event(event: Event) -> None:
    """Do nothing: the default function that receives the events of a training."""


# ---------------------------------------------------------------- fit


TrainerFactory = Callable[[Job, Dataset, Loss], Trainer]
"""Function (job, data set, loss) -> trainer that continues an existing model instead of starting an untrained one."""


@dataclass(frozen=True)
class Fitted(Job):
    """A trained model with its configuration, data and trainer: the result of :func:`fit`."""

    dataset: Dataset
    channels: Channels
    trainer: Trainer
    lpips: Lpips | None = None
    split: str = "test"  # views to measure: "test", or "train, held out" if training views replace the test views

    @property
    def model(self) -> Primitives:
        """Current model, on the device of the training."""
        return self.trainer.model

    @property
    def training(self) -> dict[str, Any]:
        """Entries ``iterations`` (training steps) and ``train_seconds`` of ``metrics.json``."""
        return {"iterations": self.trainer.step, "train_seconds": self.trainer.elapsed}

    def unlock_bands(self) -> None:
        """Make the density and colour use all bands of spherical harmonics; training activates the bands gradually."""
        for field in (self.model.density, self.model.colour):
            field.set_progress(1.0)

    def metrics(self) -> dict[str, Any]:
        """Measure the held-out views; return quality, size and speed, the content of ``metrics.json``."""
        self.unlock_bands()
        views = measure_views(self.model, self.task, self.dataset, self.config.renderer, self.lpips)
        size = 4 * sum(value.numel() for value in self.model.params.values())
        return summarize_run_metrics(self, self.dataset, self.model, views, size, self.training, self.lpips, self.split)


def fit(config: RunConfig, events: Events = ignore_run_event, dataset: Dataset | None = None) -> Fitted:
    """Train a configuration to the end of its budget (steps or seconds), in memory, without files.

    Args:
        config: the configuration.
        events: function that is called with every event.
        dataset: the scene of the configuration, if it is loaded already.

    Raises:
        NeuprimError: the input is wrong, or the training produced numbers that are not finite.
    """
    with find_config_plugins(config).attribute_errors():
        return train_to_end(prepare_training(config, events, dataset), events)


def train_to_end(fitted: Fitted, events: Events = ignore_run_event) -> Fitted:
    """Compile the kernels, and train to the end of the budget (steps or seconds); return ``fitted``."""
    compile_run_kernels(fitted.trainer, events)
    with use_one_torch_thread_for_run():
        for _ in train_run_steps(fitted.trainer, events):
            pass
    fitted.unlock_bands()
    return fitted


def prepare_training(
    config: RunConfig,
    events: Events = ignore_run_event,
    dataset: Dataset | None = None,
    hold_out: int = 0,
    make: TrainerFactory | None = None,
    group: ProcessGroup | None = None,
) -> Fitted:
    """Load the data and create loss, model and trainer, without training. Raises the errors of :func:`fit`.

    Args:
        hold_out: n > 1 holds out every n-th training view. The held-out views are measured instead of the test
            views. 0 uses the splits unchanged.
        make: function that makes the trainer; None for :func:`make_run_trainer`, which creates an untrained model.
        group: the ranks (processes) that train the model together; None for one process.
    """
    if make is None:
        refuse_chunks(config, "this function trains one model; only a whole run can train in chunks")
    backends.check_render_backend(config.renderer)
    task = Job.of(config).task
    config = replace(config, made_by=current_config_provenance(config, task))
    job = Job(config, task)
    # errors of the loss come before the data are loaded, errors of the task before the training
    loss = make_run_loss(job)
    lpips = None if config.metrics.lpips is None else Lpips.load(config.metrics.lpips)
    if dataset is None:
        dataset = load_dataset(job, lambda text, fraction: events(Preparing(text, fraction)))
    check_dataset_views(dataset, task.conditions)
    call_task_clips(task, dataset)
    call_task_facts(task, dataset)
    channels = find_channels(task, dataset)
    if channels.hides_channels:
        events(Note(f"shown: {channels.display_text}; task {task.name!r} has no display that shows them all"))
    if hold_out:
        dataset = hold_out_views(dataset, hold_out)
    if make is not None:
        trainer = make(job, dataset, loss)
    else:
        events(Preparing("starting points"))
        if config.model.primitives == "auto":
            count = partial(_choose_run_size, job, dataset, loss, events)
            chosen = count() if group is None else group.share_number("primitives", count)
            config = replace(config, model=replace(config.model, primitives=chosen))
            job = Job(config, task)
        trainer = make_run_trainer(job, dataset, loss, group)
        wanted, found = config.model.count, trainer.model.count
        if found < wanted and config.train.population.strategy != "relocate":
            events(Note(f"{dataset.name} offers {found:,} starting points for model.primitives={wanted:,}"))
    # every later command uses the near plane that the trainer chose
    config = replace(config, renderer=replace(config.renderer, near=trainer.renderer.near))
    split = "train, held out" if hold_out and make is None else "test"
    return Fitted(config, task, dataset, channels, trainer, lpips, split)


def train_run_steps(trainer: Trainer, events: Events = ignore_run_event) -> Iterator[tuple[StepReport, float | None]]:
    """Train until the budget is used; yield (report, held-out PSNR) after each step.

    The PSNR is None unless held-out views were measured after the step (``train.eval_every``). Between two steps the
    caller may save the state or leave the loop.
    """
    next_point = _next_run_curve_progress(trainer)
    for report in trainer.run():
        events(Step(report, trainer.progress))
        held_out = None
        if trainer.progress >= next_point:
            if trainer.rank == 0:
                held_out = measure_run_curve_point(trainer)
                events(Evaluated(held_out))
            next_point = _next_run_curve_progress(trainer)
        yield report, held_out
    count, wanted = trainer.model.count, trainer.settings.population.grow_to or 0
    if trainer.settings.population.strategy == "relocate" and count < wanted:
        why = "too few interventions of the population, or places with an error, to split for the others"
        events(Note(f"{count:,} primitives of model.primitives={wanted:,}: {why}; see train.population.every"))
    if trainer.corrections is not None and trainer.rank == 0:
        events(Note(trainer.corrections.summary()))


def _next_run_curve_progress(trainer: Trainer) -> float:
    """Return the progress (used fraction of the budget) at which held-out views are measured next.

    Return infinity if ``train.eval_every`` is 0.
    """
    every = trainer.settings.eval_every
    return (int(trainer.progress / every + 1e-9) + 1) * every if every > 0 else float("inf")


def measure_run_curve_point(trainer: Trainer) -> float:
    """Return the mean PSNR of up to five held-out views, each clamped to 200 dB. The training state does not change."""
    views, background = trainer.dataset.test, trainer.dataset.background
    chosen = sorted({i * len(views) // _CURVE_VIEWS for i in range(_CURVE_VIEWS)})
    total = 0.0
    with limit_threads(trainer.renderer.threads):
        for i in chosen:
            pixels = views.pixels(i)
            rendered = render_image(trainer.model, views.view(i), trainer.renderer, background)
            total += min(psnr(rendered, pixels.over(background), pixels.mask), _CURVE_PSNR_MAX)
    return total / len(chosen)


# ---------------------------------------------------------------- parts of a training


def make_run_loss(job: Job) -> Loss:
    """Return the loss function of a job: the one that ``train.loss`` names, or the task's own if none is named.

    Raises:
        ConfigError: the loss does not exist, or refuses an option.
        PluginError: the loss of another package cannot be made.
    """
    config, task = job.config, job.task
    chosen = None if config.train.loss is None else LOSSES.load(config.train.loss)
    settings = loss_settings(chosen or task, config.train, config.options)
    with attribute_errors(job.plugins.loss, "loss" if chosen is None else "make"):
        made = task.loss(settings) if chosen is None else chosen.make(settings)
    return guard_loss(made, job.plugins.loss)


def make_run_trainer(job: Job, dataset: Dataset, loss: Loss, group: ProcessGroup | None = None) -> Trainer:
    """Make an untrained model for a job, and return a trainer for it.

    Args:
        group: the ranks (processes) that train the model together; None for one process.

    Raises:
        ConfigError: a learning rate or initial value is set for a parameter that the model does not have.
        DataError: the data set offers no starting point.
        PluginError: the task of another package does not build what the data set needs.
    """
    config, task = job.config, job.task
    if config.train.supervision == "images":  # no parameters that only points could train
        if dataset.points is not None and dataset.points.channels:
            found = "train.supervision=images: voxels are needed for scene.channels"
            raise ConfigError(f"{found}; expected auto, both or voxels, or no channels")
        dataset = replace(dataset, points=None)
    source = job.plugins.task
    with attribute_errors(source, "build"):
        density, colour = task.build(build_settings(task, config.model, config.options), dataset)
    density, colour = reduce_fields(density, colour, config.model.reduced)
    with attribute_errors(source):
        check_fields(density, colour, dataset)
    settings = replace(config.model, primitives=_starting_count_of_run(config))
    model = initial_model_to_train(density, colour, dataset, settings, config.seed)
    population = config.train.population
    if population.grow_to is None:
        population = replace(population, grow_to=config.model.count)
    train = drop_unused_run_rates(replace(config.train, population=population), task, model)
    if group is None:
        return Trainer(model, dataset, loss, train, config.renderer, config.seed)
    return DistributedTrainer(model, dataset, loss, train, config.renderer, config.seed, group)


def drop_unused_run_rates(train: TrainSettings, task: TaskSpec, model: Primitives) -> TrainSettings:
    """Return the settings without learning rates for parameters that the model does not have. A preset has rates for
    every density and colour field of its task, and the trainer refuses unknown names."""
    others = task.parameter_names() - model.params.keys()
    rates = {k: v for k, v in train.rates.items() if k not in others}
    units = {k: v for k, v in train.rate_units.items() if k not in others}
    return replace(train, rates=rates, rate_units=units)


def _starting_count_of_run(config: RunConfig) -> int:
    """Return the number of primitives at the start of the training."""
    return max(round(config.train.population.grow_from * config.model.count), 1)


def _choose_run_size(job: Job, dataset: Dataset, loss: Loss, events: Events) -> int:
    """Return the number of primitives for ``model.primitives=auto``.

    The number depends on ``train.max_seconds`` and on the time per step, which a short trial training measures.
    """
    config = job.config
    whole = replace(config.train, population=replace(config.train.population, grow_from=1.0))
    trial = replace(config, model=replace(config.model, primitives=_TRIAL_PRIMITIVES), train=whole)
    trainer = make_run_trainer(Job(trial, job.task), dataset, loss)
    compile_run_kernels(trainer, events)
    events(Preparing("a test of the pace, for model.primitives=auto"))
    pace = time_run_step(trainer) / trainer.model.count
    model, seconds = config.model.with_count_for(config.train, pace), config.train.max_seconds
    events(Note(f"model.primitives=auto: {model.count:,} for {seconds:g} s, as one takes {1e6 * pace:.2g} µs a step"))
    return model.count


def time_run_step(trainer: Trainer) -> float:
    """Take some training steps, and return the seconds that one took. Use the trainer for nothing else afterwards."""
    with use_one_torch_thread_for_run():
        for _ in range(_TRIAL_WARM if trainer.recorder is None else _TRIAL_GPU_WARM):
            trainer.train_step()
        trainer.settle()
        first, start = trainer.step, time.perf_counter()
        while trainer.step < first + _TRIAL_STEPS and time.perf_counter() < start + _TRIAL_SECONDS:
            trainer.train_step()
        trainer.settle()
        pace = (time.perf_counter() - start) / (trainer.step - first)
    if trainer.recorder is not None:
        trainer.recorder.reset()
    return pace


def compile_run_kernels(trainer: Trainer, events: Events = ignore_run_event) -> None:
    """Compile the kernels before the training clock starts.

    The function performs one training step on a temporary copy of a few of the model's primitives.
    """
    events(Preparing("loading kernels; once per installation they are compiled, which takes about a minute"))
    model = trainer.model
    rows = torch.arange(0, model.count, max(model.count // 64, 1))  # some of them are active in the view
    few = Primitives(model.density, model.colour, model.rows(rows))
    settings = replace(trainer.settings, stride=1, voxels_every=1)  # the step has a whole view and points
    trial = Trainer(few, trainer.dataset, trainer.loss, settings, trainer.renderer, 0)
    trial.step = max(trial.settings.iterations or 1, 1)
    trial.elapsed = trial.settings.max_seconds or 0.0  # at the end of the budget every band of colour is in use
    trial.train_step()


@contextmanager
def use_one_torch_thread_for_run() -> Iterator[None]:
    """Context manager that limits PyTorch to one thread.

    PyTorch's tensors are small here, and PyTorch's threads would take cores from the compiled kernels.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def is_chunked(config: RunConfig) -> bool:
    """Return whether the scene is trained in chunks (parts that are trained as separate runs).

    The setting ``scene.chunks`` alone does not decide this, because it has another meaning in some scenes.
    """
    return config.scene.get("chunks") not in (None, 1) and Job.of(config).scene.spec.chunks is not None


def refuse_chunks(config: RunConfig, reason: str) -> None:
    """Raise ConfigError if the configuration trains the scene in chunks; ``reason`` says why the caller cannot."""
    if is_chunked(config):
        raise ConfigError(f"scene.chunks={config.scene['chunks']}: {reason}; expected scene.chunks=null")

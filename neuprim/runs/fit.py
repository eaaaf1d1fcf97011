"""Fit in memory: data, model and training of a configuration, without a directory. ``neuprim run``, benchmarks and
sweeps all start here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch

from neuprim.config import Job, RunConfig, find_run_plugins, made_now, scene_of, task_of
from neuprim.core.channels import Channels, find_channels
from neuprim.core.data import Dataset
from neuprim.core.data.dataset import hold_out_views
from neuprim.core.data.dataset_check import check_dataset
from neuprim.core.errors import ConfigError
from neuprim.core.metrics.lpips import Lpips
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.reduction import reduce_fields
from neuprim.core.render import backends
from neuprim.core.task import Loss, TaskSpec
from neuprim.core.train.distributed.distributed_trainer import DistributedTrainer
from neuprim.core.train.distributed.process_group import ProcessGroup
from neuprim.core.train.initial_model import initial_model
from neuprim.core.train.settings import TrainSettings
from neuprim.core.train.trainer import StepReport, Trainer
from neuprim.core.used_settings import build_settings, loss_settings
from neuprim.plugins.attribution import attribute_errors, guard_loss
from neuprim.plugins.registry import LOSSES
from neuprim.plugins.returns import call_task_clips, call_task_facts, check_fields
from neuprim.runs.curve import evaluate_curve_point, next_evaluation_progress
from neuprim.runs.events import Evaluated, Events, Note, Preparing, Step, ignore_event
from neuprim.runs.measure import measure_views, summarize_metrics
from neuprim.runs.open import load_dataset

TrainerFactory = Callable[[RunConfig, TaskSpec, Dataset, Loss], Trainer]
"""(configuration, its task, its data, its loss) -> the trainer of a model that is there already."""


@dataclass(frozen=True)
class Fitted:
    """A configuration with its data and the trainer of its model; after :func:`fit` at the end of the budget."""

    config: RunConfig
    task: TaskSpec
    dataset: Dataset
    channels: Channels
    trainer: Trainer
    lpips: Lpips | None = None
    split: str = "test"  # what judges: "train, held out" where training views took the place of the test views

    @property
    def model(self) -> Primitives:
        """As it is now, on the device of its training; ``model.to(torch.device("cpu"))`` is a copy elsewhere."""
        return self.trainer.model

    @property
    def job(self) -> Job:
        """Configuration, task, data and model."""
        return Job(self.config, self.task, self.dataset, self.model)

    @property
    def training(self) -> dict[str, Any]:
        """Steps done and seconds that they took, as ``metrics.json`` has them."""
        return {"iterations": self.trainer.step, "train_seconds": self.trainer.elapsed}

    def unlock(self) -> None:
        """Fields are as at the end of a budget from now on, with every band of colour in use."""
        for field in (self.model.density, self.model.colour):
            field.set_progress(1.0)

    def metrics(self) -> dict[str, Any]:
        """The content of ``metrics.json``, measured on the views that judge; the model's size is that of its
        tensors."""
        self.unlock()
        job, settings = self.job, self.config.renderer
        views = measure_views(self.model, self.task, self.dataset, settings, self.channels, lpips=self.lpips)
        size = 4 * sum(value.numel() for value in self.model.params.values())
        return summarize_metrics(job, self.channels, views, size, self.training, self.lpips, self.split)


def fit(config: RunConfig, events: Events = ignore_event, dataset: Dataset | None = None) -> Fitted:
    """Train a configuration to the end of its budget, in memory.

    Args:
        dataset: the scene of the configuration, if it is loaded already.

    Raises:
        NeuprimError: the input's fault, or numbers that left the finite.
    """
    with find_run_plugins(config).attribute_errors():
        return train_to_end(prepare_training(config, events, dataset), events)


def train_to_end(fitted: Fitted, events: Events = ignore_event) -> Fitted:
    """Train to the end of the budget; returns what was passed."""
    compile_kernels(fitted.trainer)
    with use_one_torch_thread():
        for _ in train_steps(fitted.trainer, events):
            pass
    fitted.unlock()
    return fitted


def prepare_training(
    config: RunConfig,
    events: Events = ignore_event,
    dataset: Dataset | None = None,
    hold_out: int = 0,
    make: TrainerFactory | None = None,
    group: ProcessGroup | None = None,
) -> Fitted:
    """Everything up to the first step. Raises as :func:`fit`.

    Args:
        hold_out: n > 1: every n-th training view takes the place of the test views; 0: the data are taken as they are.
            What a task knows of its test views, and checks here, is of those that the data set came with.
        make: what makes the trainer; None: :func:`make_trainer`, of a fresh model.
        group: the ranks that train the model together; None for one process.
    """
    if make is None:
        refuse_chunks(config, "this trains one model at once, and only a whole run can be fitted in chunks")
    backends.check_device(config.renderer)
    task = task_of(config)
    config = replace(config, made_by=made_now(config, task))
    loss = make_loss(config, task)  # options that it refuses must not cost the loading of the data
    lpips = None if config.metrics.lpips is None else Lpips.load(config.metrics.lpips)
    if dataset is None:
        dataset = load_dataset(config, task, lambda text, fraction: events(Preparing(text, fraction)))
    check_dataset(dataset, task.conditions)
    call_task_clips(task, dataset)  # what the task cannot make of these data must not cost a training
    call_task_facts(task, dataset)
    channels = find_channels(task, dataset)
    if channels.partial:
        events(Note(f"shown: {channels.shown}; task {task.name!r} has no display that shows them all"))
    if hold_out:
        dataset = hold_out_views(dataset, hold_out)
    if make is not None:
        trainer = make(config, task, dataset, loss)
        return Fitted(_as_drawn(config, trainer), task, dataset, channels, trainer, lpips)
    events(Preparing("starting points"))
    trainer = make_trainer(config, task, dataset, loss, group)
    config = _as_drawn(config, trainer)
    asked, found = config.model.primitives, trainer.model.count
    if found < _first(config):
        grows = config.train.population.strategy == "relocate"
        rest = "the rest is born where the error is largest" if grows else "there will be no more of them"
        events(Note(f"{dataset.name} offers {found:,} starting points for model.primitives={asked:,}: {rest}"))
    return Fitted(config, task, dataset, channels, trainer, lpips, "train, held out" if hold_out else "test")


def _as_drawn(config: RunConfig, trainer: Trainer) -> RunConfig:
    """The configuration with the near plane that its trainer decided, so that every later command uses the same."""
    return replace(config, renderer=replace(config.renderer, near=trainer.renderer.near))


def train_steps(trainer: Trainer, events: Events = ignore_event) -> Iterator[tuple[StepReport, float | None]]:
    """Step until the budget is used: what each step did, and the held-out PSNR where the curve gets a point after it.

    Between two steps the state may be saved or the loop left.
    """
    next_eval = next_evaluation_progress(trainer)
    for report in trainer.run():
        events(Step(report, trainer.progress))
        held_out = None
        if trainer.progress >= next_eval:
            if trainer.rank == 0:
                held_out = evaluate_curve_point(trainer)
                events(Evaluated(held_out))
            next_eval = next_evaluation_progress(trainer)
        yield report, held_out
    asked = trainer.settings.population.grow_to or 0
    if trainer.settings.population.strategy == "relocate" and trainer.model.count < asked:
        events(
            Note(
                f"{trainer.model.count:,} primitives of model.primitives={asked:,}: too few interventions, or places "
                f"with an error, to split for the others; "
                "see train.population.every"
            )
        )


def make_loss(config: RunConfig, task: TaskSpec) -> Loss:
    """The loss of a run's configuration: the task's own, or the one that ``train.loss`` names.

    Raises:
        ConfigError: no such loss, or an option that it refuses.
        PluginError: it is another package's and cannot be made.
    """
    chosen = None if config.train.loss is None else LOSSES.load(config.train.loss)
    source = find_run_plugins(config).loss
    with attribute_errors(source, "loss" if chosen is None else "make"):
        made = (task.loss if chosen is None else chosen.make)(
            loss_settings(chosen or task, config.train, config.options)
        )
    return guard_loss(made, source)


def make_trainer(
    config: RunConfig,
    task: TaskSpec,
    dataset: Dataset,
    loss: Loss | None = None,
    group: ProcessGroup | None = None,
) -> Trainer:
    """A fresh model of a run's configuration and what fits it.

    Args:
        loss: as :func:`make_loss` makes it, which is called without one.
        group: the ranks that train the model together; None for one process.

    Raises:
        ConfigError: a rate or starting value for something the model does not have.
        DataError: the data set offers no starting point.
        PluginError: the task of another package does not build what the data set needs.
    """
    if config.train.supervision == "images":  # the model has nothing that only points could teach
        dataset = replace(dataset, points=None)
    source = find_run_plugins(config).task
    with attribute_errors(source, "build"):
        density, colour = task.build(build_settings(task, config.model, config.options), dataset)
    density, colour = reduce_fields(density, colour, config.model.reduced)
    with attribute_errors(source):
        check_fields(density, colour, dataset)
    model = initial_model(density, colour, dataset, replace(config.model, primitives=_first(config)), config.seed)
    population = config.train.population
    if population.grow_to is None:
        population = replace(population, grow_to=config.model.primitives)
    settings = keep_model_settings(replace(config.train, population=population), task, model)
    parts = model, dataset, loss or make_loss(config, task), settings, config.renderer, config.seed
    return Trainer(*parts) if group is None else DistributedTrainer(*parts, group)


def keep_model_settings(train: TrainSettings, task: TaskSpec, model: Primitives) -> TrainSettings:
    """Training settings as a model's trainer takes them: a preset has rates for every density and colour of its task,
    and the trainer refuses names that the model does not have."""
    others = task.parameter_names() - model.params.keys()
    rates = {k: v for k, v in train.rates.items() if k not in others}
    units = {k: v for k, v in train.rate_units.items() if k not in others}
    return replace(train, rates=rates, rate_units=units)


def _first(config: RunConfig) -> int:
    """Primitives that a model is to start with."""
    return max(round(config.train.population.grow_from * config.model.primitives), 1)


def compile_kernels(trainer: Trainer) -> None:
    """Compile the kernels outside the training clock: one throw-away step on a copy of a few primitives."""
    model = trainer.model
    rows = torch.arange(0, model.count, max(model.count // 64, 1))  # some of them live in the view
    few = Primitives(model.density, model.colour, model.rows(rows))
    trial = Trainer(few, trainer.dataset, trainer.loss, trainer.settings, trainer.renderer, 0)
    trial.step = max(trial.settings.iterations or 1, 1)
    trial.elapsed = trial.settings.max_seconds or 0.0  # at the end of the budget every band of colour is in use
    trial.train_step()


@contextmanager
def use_one_torch_thread() -> Iterator[None]:
    """Between kernels torch has only small tensors; its own thread pool would spin on the cores the kernels need."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def is_chunked(config: RunConfig) -> bool:
    """Whether a scene that can be fitted in chunks shall be; other scenes may use the setting for something else."""
    return config.scene.get("chunks") not in (None, 1) and scene_of(config, task_of(config)).spec.chunks is not None


def refuse_chunks(config: RunConfig, what: str) -> None:
    """Raise ConfigError where something that trains one model at once is asked to do it in chunks."""
    if is_chunked(config):
        raise ConfigError(f"scene.chunks={config.scene['chunks']}: {what}; expected scene.chunks=null")

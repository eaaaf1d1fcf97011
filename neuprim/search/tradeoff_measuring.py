"""Measure the points of a trade-off (render configurations or trained models): image quality, file size, frame times.

Frame times are measured in rounds, so that load of the machine affects all points alike.
"""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from neuprim.config import RunConfig
from neuprim.core.channels import Channels, find_channels
from neuprim.core.compute.threads import core_count, cpu_name
from neuprim.core.data import Dataset, View
from neuprim.core.errors import BackendUnavailable, ConfigError, DataError, nearest
from neuprim.core.metrics import psnr, ssim, ssim_3dgs
from neuprim.core.metrics.lpips import Lpips
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import backends
from neuprim.report.tradeoff_page import TradeoffPicture, write_tradeoff_page
from neuprim.runs.open import load_dataset, load_run, model_file, move_to_render_device
from neuprim.runs.render_config import RenderConfig, estimate_run_file_bytes, parse_run_rendering
from neuprim.search.model_quality import EvalView, choose_trial_views, fill_masked
from neuprim.search.tradeoff_record import TRADEOFF_FILE, TradeoffPoint, TradeoffRecord
from neuprim.version import __version__

__all__ = ["TradeoffRequest"]

_MAX_CACHED = 1 << 29  # bytes of prepared models that are kept between rounds
_PER_REFERENCE = 6  # points per drawing of the reference in a round
_WARM_UP_SIZE = 16  # side of a first image, pixels; it compiles and loads what would slow down the timed frames

Renderer = Callable[[View], Tensor]
Progress = Callable[[str, float], None]  # text, fraction 0..1 of what it names
Tell = Callable[[str], None]  # a line for the user
T = TypeVar("T")


@dataclass
class TradeoffSetup:
    """A run's model, evaluation views, and reference: the render configuration with which others are compared."""

    config: RunConfig
    model: Primitives
    dataset: Dataset
    channels: Channels
    reference: RenderConfig
    views: list[EvalView]
    file: Path
    lpips: Lpips | None = None
    _prepared: dict[tuple[object, ...], Primitives] = field(default_factory=dict)

    def overrides(self, config: RenderConfig) -> tuple[str, ...]:
        """Return the overrides of ``neuprim render`` (``key=value``) that select a render configuration."""
        return config.to_overrides(self.config.renderer)

    def parse(self, overrides: Sequence[str]) -> RenderConfig:
        return parse_run_rendering(overrides, self.config.renderer, self.model)

    def prepare_model(self, config: RenderConfig) -> Primitives:
        """Return the model for a configuration: fields reduced, on the right device. Recent models are cached."""
        key = (tuple(config.reduced.items()), config.settings.backend, config.settings.device)
        if key not in self._prepared:
            model = move_to_render_device(config.prepare_model(self.model), config.settings, self.views[0].view)
            cached = (*self._prepared.values(), model)
            if sum(v.numel() * v.element_size() for m in cached for v in m.params.values()) > _MAX_CACHED:
                self._prepared.clear()
            self._prepared[key] = model
        return self._prepared[key]

    def backend(self, config: RenderConfig) -> backends.Backend:
        """Return the backend that renders images with a configuration."""
        model, view = self.prepare_model(config), config.scale_view(self.views[0].view)
        lowered = model.lower(view.camera, view.conditions, shaded=False)
        return backends.choose_backend(lowered, config.settings, view.camera)

    def unsupported(self, config: RenderConfig) -> str | None:
        """Return why a configuration cannot be rendered on this machine; None if it can."""
        try:
            backends.check_backend_device(config.settings)
            self.backend(config)
        except (BackendUnavailable, ConfigError) as error:
            return str(error)
        return None

    def renderer(self, config: RenderConfig) -> Renderer:
        """Prepare the model for a configuration, and return a function that renders a view with it."""
        model = self.prepare_model(config)
        return lambda view: config.render_view(model, view, self.dataset.background)

    def display(self, image: Tensor) -> Tensor:
        """Convert an image to displayed values within [0, 1]."""
        return self.channels.display(image).clamp(0.0, 1.0)


def load_tradeoff_setup(
    run_dir: Path,
    overrides: Sequence[str] = (),
    views: int = 5,
    lpips: str | Path | None = None,
    loaded: tuple[Dataset, list[EvalView]] | None = None,
) -> TradeoffSetup:
    """Load a finished run to measure its quality and speed.

    Args:
        overrides: render settings of the reference configuration, on top of the run's render settings.
        views: limit on the number of evaluation views, which are evenly spread over the test views.
        lpips: weights for LPIPS; None for those of the run.
        loaded: data set and evaluation views, if they are loaded already.

    Raises:
        NeuprimError: the run does not exist, has no test views, or overrides are invalid.
    """
    run = load_run(run_dir)
    config, task, model = run.config, run.task, run.model
    reference = parse_run_rendering(overrides, config.renderer, model)
    weights = lpips or config.metrics.lpips
    distance = None if weights is None else Lpips.load(weights)
    if loaded is None:
        dataset = load_dataset(run)
        loaded = dataset, choose_trial_views(dataset, views)
    dataset, chosen = loaded
    if not chosen:
        raise DataError(f"{run_dir}: {dataset.name} has no test views; expected at least one")
    channels, file = find_channels(task, dataset), model_file(run_dir)
    return TradeoffSetup(config, model, dataset, channels, reference, chosen, file, distance)


def describe_tradeoff_conditions(views: Sequence[EvalView]) -> dict[str, Any]:
    """Return the views, machine and versions of measurements. If any of these differ, no measurement is reused."""
    camera = views[0].view.camera
    return {
        "views": [one.view.name for one in views],
        "image_size": [camera.width, camera.height],
        "machine": {"cpu": cpu_name(), "cores": core_count()},
        "versions": {
            "neuprim": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
    }


def describe_tradeoff_setup(setup: TradeoffSetup) -> dict[str, Any]:
    """Return facts about the measured run, which are stored in the record for its readers."""
    return {
        "task": setup.config.task,
        "scene": setup.config.scene_name,
        "dataset": setup.dataset.name,
        "data_source": setup.dataset.data_source,
        "backend": setup.backend(setup.reference).name,
        "shown": setup.channels.display_text,
    }


# ---------------------------------------------------------------- one point


def measure_point(setup: TradeoffSetup, knob: str, config: RenderConfig) -> TradeoffPoint:
    """Measure the render configuration ``config``, which changes the setting ``knob``. Return a point with the image
    metrics, averaged over the views, and the bytes of the model file; frame times are measured later.
    """
    model, draw = setup.prepare_model(config), setup.renderer(config)
    rows: list[dict[str, float]] = []
    for view in setup.views:
        image = fill_masked(draw(view.view), view)
        shown, wanted = setup.display(image), setup.display(view.image)
        row = {"psnr": psnr(image, view.image, view.mask), "ssim": ssim(image, view.image)}
        row["ssim_3dgs"] = ssim_3dgs(shown, wanted)
        if setup.lpips is not None and min(shown.shape[:2]) >= setup.lpips.least:
            row |= {"lpips": setup.lpips(shown, wanted), "lpips_3dgs": setup.lpips.unmapped(shown, wanted)}
        rows.append(row)
    common = [name for name in rows[0] if all(name in row for row in rows)]
    quality = {name: float(np.mean([row[name] for row in rows])) for name in common}
    size = estimate_run_file_bytes(setup.file, setup.model, model)
    return TradeoffPoint(knob, setup.overrides(config), quality, size)


# ---------------------------------------------------------------- frame times


class TimedPoint(NamedTuple):
    """A point of a trade-off whose frame times are to be measured, and a function that returns its renderer."""

    point: TradeoffPoint
    renderer: Callable[[], Renderer]


def time_tradeoff_points(
    timed: Sequence[TimedPoint],
    repeats: int,
    views: Sequence[EvalView],
    deadline: float,
    done: Callable[[int, int], None],
) -> None:
    """Measure frame times of points in rounds. The first point is the reference, rendered several times in every round.

    In a round, every point with fewer than ``repeats`` rounds renders every view, in random order. Each frame is
    rendered twice. Only the second time counts, because the model is then in the caches. A round adds to each point the
    mean milliseconds per frame, and the frame time divided by the reference's. This ratio is a median over views, so
    that brief load of the machine has no effect.

    Args:
        repeats: number of rounds that each point should have, including earlier rounds.
        deadline: value of :func:`time.monotonic` at which to end. The first round always runs. A further round only
            runs if it is expected to end in time.
        done: called with (round, number of rounds) after each round.
    """
    order = torch.Generator().manual_seed(len(timed[0].point.ms))
    most = max(repeats - len(one.point.ms) for one in timed)
    for number in range(most):
        start = time.monotonic()
        due = [timed[0], *(one for one in timed[1:] if len(one.point.ms) < repeats)]
        if number == 0:
            for one in due:
                _warm_up_tradeoff_renderer(one.renderer(), views[0].view)
        slots = torch.tensor([0] * (1 + (len(due) - 1) // _PER_REFERENCE) + list(range(1, len(due))))
        seconds = []  # view -> point -> median
        for view in views:
            times: list[list[float]] = [[] for _ in due]
            for i in slots[torch.randperm(len(slots), generator=order)].tolist():
                draw = due[i].renderer()
                draw(view.view)
                begin = time.perf_counter()
                draw(view.view)
                times[i].append(time.perf_counter() - begin)
            seconds.append([statistics.median(own) for own in times])
        for one, own in zip(due, zip(*seconds, strict=True), strict=True):
            one.point.ms.append(1e3 * statistics.mean(own))
            one.point.ratios.append(statistics.median(a / row[0] for a, row in zip(own, seconds, strict=True)))
        done(number + 1, most)
        if time.monotonic() + (time.monotonic() - start) > deadline:
            return


def _warm_up_tradeoff_renderer(draw: Renderer, view: View) -> None:
    draw(replace(view, camera=view.camera.resized(_WARM_UP_SIZE, _WARM_UP_SIZE)))


# ---------------------------------------------------------------- the session


@dataclass(frozen=True)
class TradeoffRequest:
    """Request for a trade-off, with the arguments of ``neuprim tradeoff``.

    Attributes:
        words: overrides of the reference: render settings for a finished run, or overrides of ``neuprim run`` if models
            are trained.
        budget: approximate time in seconds; measurements that do not fit are left out.
        views: limit on the number of held-out views to measure; they are evenly spread.
        repeats: number of rounds of timing.
        knobs: names of the settings to vary; empty for all.
        lpips: weights for LPIPS; None for those of the run.
        out: folder for the results; None for a default name made from the run directory, or from task and scene.
    """

    words: Sequence[str] = ()
    budget: float = 300.0
    views: int = 5
    repeats: int = 15
    knobs: Sequence[str] = ()
    lpips: Path | None = None
    out: Path | None = None


class TradeoffSession:
    """Session that measures the points of a trade-off within a time budget and writes the record and an HTML page.

    Args:
        folder: folder for ``tradeoff.json`` and its page.
        progress: called with (text, done fraction 0..1).
    """

    def __init__(self, folder: Path, request: TradeoffRequest, record: TradeoffRecord, progress: Progress) -> None:
        self.folder, self.request, self.record, self.progress = folder, request, record, progress
        self.begun = time.monotonic()

    def point_setup(self, number: int) -> tuple[TradeoffSetup, RenderConfig]:
        """Return the setup (model, views, data) and the render configuration of the record's point ``number``."""
        raise NotImplementedError

    def seconds_left(self, part: float) -> float:
        """Return the seconds left until the fraction ``part`` (0..1) of the time budget is used."""
        return self.begun + part * self.request.budget - time.monotonic()

    @property
    def no_time(self) -> str:
        """Text for the record that says why a point was not measured when no time was left."""
        return f"no time left of the budget of {self.request.budget:g} s"

    def write_record(self) -> None:
        self.record.write(self.folder / TRADEOFF_FILE)

    def choose_knobs(self, knobs: Mapping[str, list[T]]) -> dict[str, list[T]]:
        """Return the entries of ``knobs`` (setting -> values to try) that the request names; all if it names none.

        Settings without values to try are noted in the record.
        """
        chosen = {name: own for name, own in knobs.items() if not self.request.knobs or name in self.request.knobs}
        for name, own in chosen.items():
            if not own:
                self.record.leave_out(name, (), "there is no other value")
        return chosen

    def take_times(self, part: float) -> None:
        """Measure frame times of all points with too few rounds, until the fraction ``part`` of the budget is used."""
        timed = []
        for number, point in enumerate(self.record.points):
            setup, config = self.point_setup(number)
            timed.append(TimedPoint(point, partial(setup.renderer, config)))

        def note_round(number: int, count: int) -> None:
            self.write_record()
            self.progress(f"round {number} of {count}, {len(timed)} points", number / count)

        deadline, views = time.monotonic() + self.seconds_left(part), self.point_setup(0)[0].views
        time_tradeoff_points(timed, self.request.repeats, views, deadline, note_round)

    def write_results(self, command: Callable[[Sequence[str]], str]) -> None:
        """Write the record, the HTML page, and the chart of the Pareto fronts.

        ``command`` turns the overrides of a point into the command line that the page shows.
        """
        self.write_record()
        self.progress("pictures of the front", 0.0)
        write_tradeoff_page(self.folder, self.record.to_dict(), self._render_front_pictures(), command)

    def _render_front_pictures(self) -> dict[int, TradeoffPicture]:
        """Return index of a point -> its picture, for the first point and the Pareto fronts; -1 is the ground truth.

        All pictures show the evaluation view with most contrast.
        """
        setup, _ = self.point_setup(0)
        view = max(setup.views, key=lambda one: float(setup.channels.display(one.image).var()))
        truth = setup.display(view.image)
        pictures = {-1: TradeoffPicture(truth, None)}
        trained = bool(self.record.points[0].run_dir)  # models are compared with the truth, others with the reference
        for number in dict.fromkeys((0, *self.record.speed, *self.record.size)):
            setup, config = self.point_setup(number)
            shown = setup.display(fill_masked(setup.renderer(config)(view.view), view))
            against = truth if trained else None if number == 0 else pictures[0].image
            pictures[number] = TradeoffPicture(shown, against)
        return pictures


def check_knobs(request: TradeoffRequest, known: Iterable[str], owner: str) -> None:
    """Raise ConfigError if the request names a setting that is not ``known``, i.e. that ``owner`` does not have."""
    for name in request.knobs:
        if name not in (names := list(known)):
            raise ConfigError(f"--vary {name}: no such setting of {owner}{nearest(name, names)}")

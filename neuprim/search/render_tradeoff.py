"""Trade-offs of a finished run: vary each render setting alone, then several together, and find the Pareto fronts.

Results go to ``RUN_DIR/tradeoff`` or a given folder. Points that were measured before are not measured again.
"""

from __future__ import annotations

import hashlib
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from neuprim.config import find_config_plugins
from neuprim.core.compute.threads import core_count
from neuprim.core.errors import ConfigError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import backends
from neuprim.runs.fit import use_one_torch_thread_for_run
from neuprim.runs.render_config import RenderConfig
from neuprim.search.tradeoff_measuring import (
    Progress,
    Tell,
    TradeoffRequest,
    TradeoffSession,
    TradeoffSetup,
    check_knobs,
    describe_tradeoff_conditions,
    describe_tradeoff_setup,
    load_tradeoff_setup,
    measure_point,
)
from neuprim.search.tradeoff_record import (
    COMBINED,
    REFERENCE,
    TRADEOFF_FILE,
    TRADEOFF_FOLDER,
    ParetoStep,
    TradeoffPoint,
    TradeoffRecord,
    combine_pareto_steps,
    read_tradeoff_record,
)

_IMAGES, _TIMES, _COMBINED = 0.45, 0.65, 0.85
"""Deadlines, as fractions of the time budget: for images of single changes, their frame times, and combinations."""

__all__ = ["measure_tradeoff"]

_COMBINATIONS = 24


def format_tradeoff_render_command(run_dir: str, overrides: Sequence[str]) -> str:
    """Return the ``neuprim render`` command that renders a run's test views with these overrides."""
    return shlex.join(["neuprim", "render", run_dir, "--camera", "test", *overrides])


_VALUES: dict[str, tuple[Any, ...]] = {
    "alpha_min": (0.0, *(2.0**-k for k in (10, 9, 8, 7, 6, 5))),
    "transmittance_min": (0.0, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1),
    "alpha_max": (0.9, 0.95, 0.99, 0.999, 0.9999),
    "sort": ("center", "entry"),
    "samples": (1, 2, 4),
}
"""Renderer setting -> values to measure."""


def list_render_knobs(reference: RenderConfig, model: Primitives) -> dict[str, list[RenderConfig]]:
    """Return a dict: setting -> render configurations that change only this setting of ``reference``. The settings
    ``density.NAME`` and ``colour.NAME`` reduce the setting NAME of the model's field, e.g. ``colour.degree``.
    """
    cores, compared = core_count(), [name for name in backends.backend_names() if name != backends.REFERENCE]
    threads = sorted({1, 0, *(2**k for k in range(1, 7) if 2**k < cores)}) if cores > 1 else []
    values = {**_VALUES, "backend": compared, "threads": threads}
    knobs = {
        name: [replace(reference, settings=replace(reference.settings, **{name: value})) for value in own]
        for name, own in values.items()
    }
    knobs["resolution"] = [replace(reference, resolution=part) for part in (1.0, 0.75, 0.5, 0.25)]
    for kind, own in (("density", model.density), ("colour", model.colour)):
        for name, counts in own.reductions().items():
            reduced = [{**reference.reduced, (kind, name): count} for count in counts]
            knobs[f"{kind}.{name}"] = [replace(reference, reduced=dict(sorted(one.items()))) for one in reduced]
    return {name: [one for one in configs if one != reference] for name, configs in knobs.items()}


def measure_tradeoff(
    run_dir: Path,
    request: TradeoffRequest,
    tell: Tell = lambda text: None,
    progress: Progress = lambda text, fraction: None,
) -> TradeoffRecord:
    """Measure how a run's render settings trade quality for speed; write ``tradeoff.json``, ``tradeoff.html`` and
    ``front.png``.

    ``tell`` is called with lines of text for the user, ``progress`` with (text, done fraction 0..1).

    Raises:
        NeuprimError: run, setting or test views do not exist, an override is invalid, or ``tradeoff.json`` is damaged.
    """
    folder = request.out or run_dir / TRADEOFF_FOLDER
    if request.out and folder.is_dir() and any(folder.iterdir()) and not (folder / TRADEOFF_FILE).exists():
        raise ConfigError(f"--out {folder}: has other files; expected a new folder, or a folder of `neuprim tradeoff`")
    setup = load_tradeoff_setup(run_dir, request.words, request.views, request.lpips)
    knobs = list_render_knobs(setup.reference, setup.model)
    check_knobs(request, knobs, "this run")
    record = _resume_tradeoff_record(folder / TRADEOFF_FILE, _render_tradeoff_identity(setup), tell)
    with find_config_plugins(setup.config).attribute_errors(), use_one_torch_thread_for_run():
        if (reason := setup.unsupported(setup.reference)) is not None:
            raise ConfigError(reason)
        record.facts |= describe_tradeoff_setup(setup)
        session = _RenderTradeoffSession(folder, request, record, progress, setup)
        session.measure([(REFERENCE, setup.reference), *session.single_changes(knobs)], _IMAGES)
        session.take_times(_TIMES)
        session.measure([(COMBINED, config) for config in session.combinations()], _COMBINED)
        session.take_times(1.0)
        record.find_fronts(in_size=session.draws_the_reference)
        session.write_results(partial(format_tradeoff_render_command, str(run_dir)))
    return record


class _RenderTradeoffSession(TradeoffSession):
    """Session that measures render configurations of one finished run within a time budget."""

    def __init__(
        self, folder: Path, request: TradeoffRequest, record: TradeoffRecord, progress: Progress, setup: TradeoffSetup
    ) -> None:
        super().__init__(folder, request, record, progress)
        self.setup = setup

    def point_setup(self, number: int) -> tuple[TradeoffSetup, RenderConfig]:
        return self.setup, self.setup.parse(self.record.points[number].words)

    def single_changes(self, knobs: Mapping[str, list[RenderConfig]]) -> Iterator[tuple[str, RenderConfig]]:
        """Yield (setting, configuration) for each change of a single setting that this machine can render.

        Changes that this machine cannot render are noted in the record.
        """
        base = self.setup.backend(self.setup.reference).name
        for name, configs in self.choose_knobs(knobs).items():
            for config in configs:
                reason = self.setup.unsupported(config)
                if reason is not None:
                    self.record.leave_out(name, self.setup.overrides(config), reason)
                elif name != "backend" or self.setup.backend(config).name != base:
                    yield name, config

    def measure(self, wanted: Sequence[tuple[str, RenderConfig]], part: float) -> None:
        """Measure quality and bytes of the ``wanted`` (setting, configuration) pairs that the record lacks.

        End when the fraction ``part`` of the time budget is used.
        """
        for number, (knob, config) in enumerate(wanted):
            words, points = self.setup.overrides(config), self.record.points
            if any(point.words == words for point in points):
                continue
            if points and self.seconds_left(part) < 0:
                self.record.leave_out(knob, words, self.no_time)
                continue
            self.progress(f"images of point {number + 1} of {len(wanted)}", number / len(wanted))
            points.append(measure_point(self.setup, knob, config))
            self.write_record()

    def draws_the_reference(self, point: TradeoffPoint) -> bool:
        """Return whether a point differs from the run itself (the reference) in the model alone, not in rendering."""
        config, reference = self.setup.parse(point.words), self.setup.reference
        return config.settings == reference.settings and config.resolution == reference.resolution

    def combinations(self) -> list[RenderConfig]:
        """Return the configurations in the record that combine several changes, and new combinations.

        New combinations consist of single changes that reduce time or bytes.
        """
        base, *others = self.record.points
        faster, smaller, known = [], [], []
        for point in others:
            turned = [word for word in point.words if word not in base.words]
            known.append(turned)
            if point.knob == COMBINED or len(turned) != 1:
                continue
            knob, loss = turned[0].partition("=")[0], base.quality["psnr"] - point.quality["psnr"]
            if point.ratios and point.ratio < 1.0 - point.doubt:
                faster.append(ParetoStep(knob, turned[0], -math.log(point.ratio), loss))
            if point.bytes < base.bytes and self.draws_the_reference(point):
                smaller.append(ParetoStep(knob, turned[0], math.log(base.bytes / point.bytes), loss))
        configs = [self.setup.parse(point.words) for point in others if point.knob == COMBINED]
        for way in combine_pareto_steps((faster, smaller), known, _COMBINATIONS):
            changed = {word.partition("=")[0] for word in way}
            kept = [word for word in base.words if word.partition("=")[0] not in changed]
            configs.append(self.setup.parse([*kept, *way]))
        return configs


def _render_tradeoff_identity(setup: TradeoffSetup) -> dict[str, Any]:
    """Return facts on model, settings and machine as JSON-ready values. Points are only reused if all are equal."""
    config, conditions = setup.config, describe_tradeoff_conditions(setup.views)
    conditions["machine"]["device"] = setup.backend(setup.reference).computing_on(setup.reference.settings)
    return {
        "model": hashlib.sha256(setup.file.read_bytes()).hexdigest(),
        "settings": asdict(config.renderer),
        "reference": list(setup.overrides(setup.reference)),
        "scene": {"name": config.scene_name, **{key: str(value) for key, value in config.scene.items()}},
        "lpips": None if setup.lpips is None else setup.lpips.network,
        **conditions,
    }


def _resume_tradeoff_record(path: Path, identity: dict[str, Any], tell: Tell) -> TradeoffRecord:
    """Return the record in ``path`` if its facts (e.g. model, settings) equal ``identity``, else an empty record."""
    before = read_tradeoff_record(path)
    if before is None:
        return TradeoffRecord(identity)
    if changed := before.changes(identity):
        tell(f"{path}: made with another {' and '.join(changed)}; all is measured anew")
        return TradeoffRecord(identity)
    tell(f"{path}: {len(before.points)} points measured already are kept; delete it to measure anew")
    before.left_out.clear()
    return before

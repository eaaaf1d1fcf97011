"""Train a designed set of models, measure them side by side, find the fronts, and write it all into one folder that can
be gone on with."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from neuprim.config import suspects_of, task_of
from neuprim.core.data.dataset_check import check_dataset
from neuprim.core.render import backends
from neuprim.report.tradeoff_models import write_models
from neuprim.runs.fit import use_one_torch_thread
from neuprim.runs.ground_truth import render_ground_truth_for_training
from neuprim.runs.launch.launcher import use_launcher_threads
from neuprim.runs.open import LOGS, load_dataset
from neuprim.runs.run_directory import lock_directory
from neuprim.search.design.combine import fronts
from neuprim.search.design.kept import TRIALS, centre_of, check_folder, kept_record, number_of, old_plan, same_of
from neuprim.search.design.pictures import pictures
from neuprim.search.design.plan import Plan
from neuprim.search.design.record import Model, command
from neuprim.search.design.request import DesignRequest, Progress, Tell
from neuprim.search.design.session import Session
from neuprim.search.design.variants import CENTRE, Variant, check_knobs, in_turn, singles
from neuprim.search.tradeoff.knobs import LeftOut
from neuprim.search.tradeoff.memory import UNKNOWN
from neuprim.search.tradeoff.record import Record, read_record, write_csv

__all__ = ["TRIALS", "DesignRequest", "design_run"]

_SINGLES, _TIMED, _COMBINED = 0.58, 0.64, 0.88
"""Parts of the budget that remains after paces are known, by which single knobs are trained and timed, and combinations
trained, which a single knob has none of."""


def design_run(
    request: DesignRequest,
    tell: Tell = lambda text: None,
    progress: Progress = lambda text, fraction: None,
) -> tuple[Path, Record]:
    """Train and measure, and write ``tradeoff.json``, ``tradeoff.csv``, ``tradeoff.html`` and ``front.png`` into the
    set's folder, beside :data:`TRIALS`; returns the folder and the record, whose points are
    :class:`~neuprim.search.design.record.Model`.

    The same request goes on where it was left: what is trained stays as it is, and a larger budget adds what did not
    fit.

    Args:
        tell: called with lines for the user.
        progress: called with (text, fraction 0..1 of what the text names).

    Raises:
        NeuprimError: words that do not fit, no such knob, data that cannot be read, or a folder that holds something
        else.
    """
    begun = time.monotonic()
    words, folder, centre = centre_of(request)
    task = task_of(centre)
    with use_one_torch_thread(), use_launcher_threads(request.launcher), ExitStack() as stack:
        stack.enter_context(suspects_of(centre).watch(folder / LOGS))
        ladders = singles(centre, task)
        check_knobs(request.knobs, ladders, task.name)
        ladders = {name: ladder for name, ladder in ladders.items() if not request.knobs or name in request.knobs}
        before = read_record(folder / "tradeoff.json", Model)
        check_folder(folder, before, centre, request)
        stack.enter_context(lock_directory(folder, "set"))
        plan = old_plan(folder, before)
        render_ground_truth_for_training(centre, request.launcher, progress)
        dataset = load_dataset(centre, task, progress)
        check_dataset(dataset, task.conditions)
        record = kept_record(folder, before, same_of(centre, dataset, request), tell)
        spent = number_of(record, "spent_seconds")
        session = Session(request, folder, words, centre, dataset, record, tell, progress, begun, spent, plan)
        record.left_out += [
            LeftOut(name, (), "nothing but what the centre has") for name, ladder in ladders.items() if not ladder
        ]
        wanted = session.with_paces([Variant(CENTRE), *in_turn(ladders)])
        several = len([ladder for ladder in ladders.values() if ladder]) > 1
        session.make_plan(wanted, several)
        session.train(wanted, _SINGLES if several else _COMBINED)
        session.take_times(_TIMED if several else 1.0)
        session.train(session.combinations(_COMBINED), _COMBINED)
        session.train(wanted, _COMBINED)
        session.take_times(1.0)
        _describe(session)
        record.speed, record.size = fronts(session.models)
        session.write()
        write_csv(
            folder / "tradeoff.csv", record, lambda number: session.models[number].primitives, _columns(session.models)
        )
        progress("pictures of the front", 0.0)
        shown = pictures(session.measuring, session.models, [*record.speed, *record.size])
    write_models(folder, record.to_dict(), shown, command)
    return folder, record


def _columns(models: Sequence[Model]) -> dict[str, Callable[[int], object]]:
    """Of the table, beside those that every point has."""
    return {
        "numbers per primitive": lambda number: models[number].parameters_per_primitive,
        "training steps": lambda number: models[number].steps,
        "training seconds": lambda number: f"{models[number].seconds:.3f}",
        "ms per step": lambda number: f"{models[number].ms_per_step:.4f}",
        "command": lambda number: command(models[number].words),
    }


def _describe(session: Session) -> None:
    """Facts that do not depend on what is measured."""
    centre, plan = session.centre, session.plan
    assert plan is not None
    lpips = session.request.lpips or centre.metrics.lpips
    session.record.facts |= {
        "task": centre.task,
        "scene": centre.scene_name,
        "preset": centre.preset,
        "dataset": session.dataset.name,
        "data_source": session.dataset.data_source,
        "words": list(session.words),
        "seeds": session.request.seeds,
        "budget_seconds": session.request.budget,
        "length": _length(plan),
        "backend": session.measuring.backend_name or backends.AUTO,
        "not_measured": {} if lpips else {"lpips": "no weights were given (--lpips FILE)"},
    }
    if not Path("/proc/self/clear_refs").exists():
        session.record.facts["not_measured"]["peak_bytes"] = UNKNOWN


def _length(plan: Plan) -> str:
    """In a sentence, how long the models train."""
    same = f"Every model trains for the same time, about {plan.seconds:.3g} s: {plan.steps:,} steps of the centre"
    if plan.whole and plan.steps < plan.whole:
        return f"{same}, of {plan.whole:,} that its words or preset say. These are fronts of short trainings; those of long ones may be others."
    return f"{same}, all that its words or preset say."

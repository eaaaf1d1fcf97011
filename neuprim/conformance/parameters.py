"""Checks of what a task says about itself: its files, its fields' settings and parameters, and their start values."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import Any

import torch

from neuprim.config import check_groups, preset_settings, presets, task_choices
from neuprim.config.checks import complete_options
from neuprim.config.task_files import Level, read_levels
from neuprim.conformance.subject import Subject
from neuprim.core.errors import ConfigError
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.model.schema import InitContext, ParameterSpec
from neuprim.core.task import API_VERSION
from neuprim.core.train.settings import ModelSettings
from neuprim.core.used_settings import build_settings
from neuprim.core.validation import validate
from neuprim.plugins.members import fault
from neuprim.plugins.trading import traded

__all__ = ["check_fields", "check_files", "check_initialisers", "check_members", "check_parameter_specs", "check_trade"]


def check_members(t: Subject) -> None:
    """Every member of the TaskSpec is of its kind, so that nothing fails in the middle of a run."""
    wrong = fault(t.task)
    t.require(wrong is None, "TaskSpec", wrong, "members as documented in neuprim.core.task.TaskSpec")
    t.require(t.task.api == API_VERSION, "TaskSpec.api", t.task.api, str(API_VERSION))
    t.require(t.task.name.isidentifier(), "TaskSpec.name", repr(t.task.name), "letters, digits and _")
    t.require(
        bool(t.task.fields),
        "TaskSpec.fields",
        t.task.fields,
        "every field class by its name, or saved models cannot be read",
    )


def check_files(t: Subject) -> None:
    """Every scene, preset and level of effort has settings that compose, and rates and their units only for parameters
    that exist, so that no choice is a dead end."""
    check_groups(t.task)
    choice = task_choices(t.task)
    known = t.task.parameter_names() | {s.name for s in GEOMETRY_SPECS}
    levels = read_levels(t.task, presets(t.task)) or {}
    chosen: list[tuple[str, str, Level | None]] = [(f"preset {preset}", preset, None) for preset in presets(t.task)]
    chosen += [(f"effort {number}", level.preset, level) for number, level in levels.items()]
    for where, preset, level in chosen:
        settings = preset_settings(t.task, preset, choice.scene, level)
        for group, given in (("rates", settings.train.rates), ("rate_units", settings.train.rate_units)):
            for name in given:
                t.require(
                    name in known,
                    f"{where}: train.{group}.{name}",
                    "no such parameter",
                    f"one of {', '.join(sorted(known))}",
                )
        try:
            t.task.check(build_settings(t.task, settings.model, choice.options))
        except ConfigError as error:
            t.require(False, where, f"model settings that TaskSpec.check refuses ({error})", "settings that it accepts")
    for scene in t.task.scenes:
        preset_settings(t.task, choice.preset, scene.name)


def check_trade(t: Subject) -> None:
    """What the task offers to trade are settings that exist, at values that its own check accepts, so that no training
    of a designed set is offered in vain."""
    offered = traded(t.task, build_settings(t.task, t.settings.model, t.options))
    for name, values in offered.items():
        for value in values:
            tree: dict[str, Any] = {"model": asdict(t.settings.model), "task": {"options": dict(t.options)}}
            *path, last = name.split(".")
            node = tree
            for part in path:
                node = node.setdefault(part, {})
            node[last] = value
            try:
                options = complete_options(t.task.options, tree["task"]["options"], f"task {t.task.name!r}")
                t.task.check(build_settings(t.task, validate(ModelSettings, tree["model"], "model"), options))
            except ConfigError as error:
                t.require(
                    False,
                    f"trade: {name}={value}",
                    f"a setting that is refused ({error})",
                    "settings that the task takes",
                )


def check_fields(t: Subject) -> None:
    """A field is rebuilt from its class name and JSON-able settings with the same parameters, so that a saved model can
    be read."""
    for kind, field in zip(("density", "colour"), t.fields(), strict=True):
        name, listed = type(field).__name__, t.task.fields or {}
        t.require(
            listed.get(name) is type(field),
            f"TaskSpec.fields[{name!r}]",
            listed.get(name),
            f"the class of the {kind} that build makes",
        )
        settings = field.settings()
        try:
            same = json.loads(json.dumps(settings, allow_nan=False)) == settings
        except (TypeError, ValueError):
            same = False
        t.require(same, f"{name}.settings()", settings, "values that JSON holds unchanged")
        again = type(field)(**settings)
        before, after = ([(s.name, tuple(s.shape)) for s in f.parameters()] for f in (field, again))
        t.require(before == after, f"{name}(**settings)", f"parameters {after}", f"{before}")
        _refuses_unknown(t, field, settings)


def _refuses_unknown(t: Subject, field: Any, settings: dict[str, Any]) -> None:
    name = type(field).__name__
    try:
        type(field)(**settings, no_such_setting=1)
    except (TypeError, ValueError):
        return
    t.require(False, f"{name}(no_such_setting=1)", "it was taken", "TypeError, so that a damaged file is noticed")


def check_parameter_specs(t: Subject) -> None:
    """Names are unique, shapes and rates possible: optimiser, checkpoint and export all live off this list."""
    taken = {s.name for s in GEOMETRY_SPECS}
    for kind, spec in t.specs():
        where = f"{kind}.parameters: {spec.name!r}"
        t.require(isinstance(spec, ParameterSpec), where, type(spec).__name__, "ParameterSpec")
        t.require(
            str(spec.name).isidentifier(), where, repr(spec.name), "a name of letters, digits and _ (it becomes a key)"
        )
        t.require(spec.name not in taken, where, "a name used twice", "a unique one")
        taken.add(spec.name)
        fits = isinstance(spec.shape, tuple) and all(isinstance(n, int) and n >= 0 for n in spec.shape)
        t.require(fits, f"{where}: shape", spec.shape, "a tuple of whole numbers, () for a scalar")
        t.require(math.isfinite(spec.lr) and spec.lr > 0, f"{where}: lr", spec.lr, "a positive rate")
        t.require(spec.lr_unit in ("absolute", "extent"), f"{where}: lr_unit", spec.lr_unit, "absolute or extent")
        t.require(callable(spec.init), f"{where}: init", type(spec.init).__name__, "a function of InitContext")


def check_initialisers(t: Subject) -> None:
    """Start values have the spec's shape, are finite, and depend on nothing but the context and its generator, so that
    seeds mean something."""

    def drawn(seed: int) -> InitContext:
        generator = torch.Generator().manual_seed(seed)
        cloud = t.dataset.initial_points(t.settings.model.primitives, generator)
        scales = torch.full((len(cloud.means),), 0.1)
        return InitContext(
            cloud.means.float(), scales, cloud.colors.float(), generator, t.settings.model.init, cloud.conditions
        )

    for kind, spec in t.specs():
        where = f"{kind}.parameters: {spec.name!r}: init"
        context = drawn(5)
        kept = [x.clone() for x in (context.means, context.scales, context.colors)]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            value = spec.init(context)
            torch.manual_seed(2)
            again = spec.init(drawn(5))
        expected = (context.count, *spec.shape)
        t.require(tuple(value.shape) == expected, f"{where}: start value", f"shape {tuple(value.shape)}", str(expected))
        t.require(bool(torch.isfinite(value).all()), f"{where}: start value", "NaN or infinity", "finite numbers")
        t.require(
            torch.equal(value, again),
            f"{where}: two draws with one seed",
            "different values",
            "equal ones (use only context.generator)",
        )
        same = all(
            torch.equal(a, b) for a, b in zip(kept, (context.means, context.scales, context.colors), strict=True)
        )
        t.require(same, where, "the context's means, scales or colors changed in place", "a context left alone")
    first, other = t.fresh(), t.fresh()
    equal = all(torch.equal(first.params[n], other.params[n]) for n in first.params)
    t.require(equal, "two models of one seed", "different start values", "equal ones")

"""Conformance checks for authors of tasks: every task must pass them.

    from neuprim.conformance import check_task, checks

    check_task(TASK)            # all checks; ConformanceError lists what failed

    @checks(TASK)               # in a test file: one test per check
    def test_conforms(check):
        check()

Each check builds tiny models on the reference backend from the task's default preset. The data set is the ``example``
of the task's TaskSpec, or a small synthetic set with the conditions that the task declares. The docstring of each check
states the requirement.
"""

from __future__ import annotations

import json
import math
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import torch

from neuprim.config import check_config_groups, list_task_presets, preset_settings, read_task_config
from neuprim.config.setting_checks import check_config_parameter_names, complete_task_options
from neuprim.config.task_files import Level, read_config_effort_levels
from neuprim.conformance.field_checks import (
    check_activity_conformance,
    check_gradients_conformance,
    check_integral_conformance,
    check_reductions_conformance,
    check_scaling_conformance,
    check_split_conformance,
)
from neuprim.conformance.task_under_test import (
    ConformanceError,
    TaskUnderTest,
    conformance_range,
    random_conformance_condition,
)
from neuprim.core import checkpoint
from neuprim.core.channels import find_channels
from neuprim.core.compression.codec import canonical_model
from neuprim.core.compression.quantizers import LEVELS
from neuprim.core.errors import ConfigError, FormError, NeuprimError
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import RateUnit
from neuprim.core.render import render
from neuprim.core.render.layer_frame import LayerFrame
from neuprim.core.task import Supervision, TaskSpec
from neuprim.core.train.settings import ModelSettings, build_settings, loss_settings
from neuprim.core.validation import validate_settings
from neuprim.plugins.attribution import (
    ReturnError,
    call_task_clips,
    call_task_diagnose,
    call_task_facts,
    call_task_mask,
    call_task_metrics,
    call_task_orbit,
    call_task_tunable_settings,
    check_loss_returns,
    draw_task_layer,
)
from neuprim.plugins.spec_validation import validate_spec

__all__ = ["CHECKS", "ConformanceError", "check_task", "checks", "named_checks"]

_NOT_THE_TASKS = ("neuprim.core", "neuprim.config", "neuprim.plugins")
_LIBRARIES = ("torch", "numpy", "scipy", "numba", "importlib", "omegaconf", "hydra", "yaml")
_STEPS = 4
"""Number of training steps before the checkpoint, and again after the checkpoint. Population control runs twice in each
half."""


# ---------------------------------------------------------------- what a task declares


def check_description_conformance(t: TaskUnderTest) -> None:
    """Check that a task's description is valid and consistent with its configuration files.

    The TaskSpec must be valid. The task must accept its scenes, presets, effort levels and tunable settings, and refuse
    an unknown setting.
    """
    problem = validate_spec(t.task)
    t.require(problem is None, "TaskSpec", problem, "members as documented in neuprim.core.task.TaskSpec")
    t.require(bool(t.task.fields), "TaskSpec.fields", t.task.fields, "every field class by its name")
    check_config_groups(t.task)
    choice, presets = read_task_config(t.task), list_task_presets(t.task)
    levels = read_config_effort_levels(t.task, presets) or {}
    chosen: list[tuple[str, str, Level | None]] = [(f"preset {preset}", preset, None) for preset in presets]
    chosen += [(f"effort {number}", level.preset, level) for number, level in levels.items()]
    for where, preset, level in chosen:
        with _settings_accepted(t, where):
            settings = preset_settings(t.task, preset, choice.scene, level)
            check_config_parameter_names(t.task, settings)
            _check_settings(t, asdict(settings.model), choice.options)
    for scene in t.task.scenes:
        preset_settings(t.task, choice.preset, scene.name)
    for name, values in call_task_tunable_settings(t.task, build_settings(t.task, t.settings.model, t.options)).items():
        for value in values:
            tree: dict[str, Any] = {"model": asdict(t.settings.model), "task": {"options": dict(t.options)}}
            *path, last = name.split(".")
            node = tree
            for part in path:
                node = node.setdefault(part, {})
            node[last] = value
            with _settings_accepted(t, f"tunable_settings: {name}={value}"):
                _check_settings(t, tree["model"], tree["task"]["options"])
    for group in ("density", "colour"):
        changed: dict[str, Any] = {group: {**getattr(t.settings.model, group), "no_such_setting": 1}}
        where = f"TaskSpec.check with model.{group}.no_such_setting=1"
        found = "it was accepted"
        try:
            t.task.check(build_settings(t.task, replace(t.settings.model, **changed), t.options))
        except ConfigError as error:
            found = str(error)
        t.require("no_such_setting" in found, where, repr(found), "ConfigError, a message that names the setting")


@contextmanager
def _settings_accepted(t: TaskUnderTest, where: str) -> Iterator[None]:
    try:
        yield
    except ConfigError as error:
        t.require(False, where, f"a setting that is refused ({error})", "settings that the task accepts")


def _check_settings(t: TaskUnderTest, model: dict[str, Any], options: dict[str, Any]) -> None:
    complete = complete_task_options(t.task.options, options, f"task {t.task.name!r}")
    t.task.check(build_settings(t.task, validate_settings(ModelSettings, model, "model"), complete))


def check_fields_conformance(t: TaskUnderTest) -> None:
    """Check that the density field and the colour field can be rebuilt from their settings, stored as JSON.

    A rebuilt field must have the same parameters. The class of a field must refuse an unknown setting.
    """
    for kind, field in zip(("density", "colour"), t.build_fields(), strict=True):
        name, settings = type(field).__name__, field.settings()
        listed = (t.task.fields or {}).get(name)
        t.require(listed is type(field), f"TaskSpec.fields[{name!r}]", listed, f"the class of the {kind}")
        same = json.loads(json.dumps(settings, allow_nan=False)) == settings
        t.require(same, f"{name}.settings()", settings, "values that JSON holds unchanged")
        before, after = ([(s.name, tuple(s.shape)) for s in f.parameters()] for f in (field, type(field)(**settings)))
        t.require(before == after, f"{name}(**settings)", f"parameters {after}", before)
        try:
            type(field)(**{**settings, "no_such_setting": 1})
        except (TypeError, ValueError):
            continue
        t.require(False, f"{name}(no_such_setting=1)", "it was accepted", "TypeError, so that damage is noticed")


def check_parameters_conformance(t: TaskUnderTest) -> None:
    """Check the fields' parameters: unique names, valid shapes and rates, initial values that only the seed decides."""
    taken = {s.name for s in GEOMETRY_SPECS}
    for kind, spec in t.parameter_specs():
        where = f"{kind}.parameters: {spec.name!r}"
        t.require(str(spec.name).isidentifier(), where, repr(spec.name), "a name of letters, digits and _")
        t.require(spec.name not in taken, where, "a name used twice", "a unique one")
        taken.add(spec.name)
        fits = isinstance(spec.shape, tuple) and all(isinstance(n, int) and n >= 0 for n in spec.shape)
        t.require(fits, f"{where}: shape", spec.shape, "a tuple of whole numbers, () for a scalar")
        t.require(math.isfinite(spec.lr) and spec.lr > 0, f"{where}: lr", spec.lr, "a positive rate")
        t.require(spec.lr_unit in get_args(RateUnit), f"{where}: lr_unit", spec.lr_unit, ", ".join(get_args(RateUnit)))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        one = t.initial_model()
        torch.manual_seed(2)
        other = t.initial_model()
    for kind, spec in t.parameter_specs():
        where, value = f"{kind}.parameters: {spec.name!r}: start value", one.params[spec.name]
        expected = (one.count, *spec.shape)
        t.require(tuple(value.shape) == expected, where, f"shape {tuple(value.shape)}", expected)
        t.require_finite(where, value)
        t.require(torch.equal(value, other.params[spec.name]), f"{where}s of one seed", "different ones", "equal ones")


def check_evaluation_conformance(t: TaskUnderTest) -> None:
    """Check the functions with which a task evaluates a model, on the task's example data set or on synthetic data.

    The functions compute metrics, masks, diagnostics, facts (header entries), clips (films) and layers (images of .exr
    files). Views of an orbit must set every condition of the task, e.g. the time.
    """
    task, data, model = t.task, t.dataset, t.perturbed_model(torch.float32)
    find_channels(task, data).display(data.test.pixels(0).over(data.background))
    before = {name: value.clone() for name, value in model.params.items()}
    try:
        call_task_clips(task, data)
        call_task_facts(task, data)
        for i in range(len(data.test)):
            truth = data.test.pixels(i).over(data.background)
            call_task_mask(task, data, i)
            call_task_metrics(task, data, i, 0.5 * truth, truth)
        call_task_diagnose(task, data, model)
        orbit = call_task_orbit(task, data, 3)
        for spec in task.layers:
            for view in t.views:
                frame = LayerFrame(model, view.camera, view.conditions, t.settings.renderer, data.color_space)
                draw_task_layer(spec, frame, data.channels)
    except ReturnError as error:  # it says what was found and what was expected
        raise ConformanceError(f"task {task.name!r}: {t.check}: {error}") from error
    t.require_equal("diagnose or layers changed the model", model.params, before)
    for view in orbit:
        missing = [spec.name for spec in task.conditions if spec.name not in view.conditions]
        t.require(not missing, f"orbit: view {view.name}", f"no {', '.join(missing)}", "every condition of the task")


def check_loss_conformance(t: TaskUnderTest) -> None:
    """Check that the loss and its gradient are finite, and that the loss is lower for the true image.

    The loss must also be finite if a mask selects some of the pixels.
    """
    loss = t.task.loss(loss_settings(t.task, t.settings.train, t.options))
    pixels = t.dataset.train.pixels(0)
    frame = Supervision(t.dataset.train.view(0), pixels.mask, pixels.alpha)
    truth = pixels.over(t.dataset.background)
    off = (truth + 0.2 * torch.rand(truth.shape, generator=torch.Generator().manual_seed(2))).requires_grad_()
    value, parts = loss(off, truth, frame)
    check_loss_returns(value, parts, off)
    t.require(math.isfinite(value.item()), "loss", value.item(), "a finite number")
    value.backward()
    t.require_finite("gradient of the loss", off.grad)
    t.require(off.grad is not None and bool(off.grad.any()), "gradient of the loss", "none or zero", "another one")
    mask = torch.zeros(truth.shape[:2], dtype=torch.bool)
    mask[: max(1, len(mask) // 2)] = True
    masked = torch.where(mask[..., None], off.detach(), truth).requires_grad_()
    part = loss(masked, truth, replace(frame, mask=mask))[0].item()
    t.require(math.isfinite(part), "loss of a frame with a mask", part, "a finite number")
    least = loss(truth.clone().requires_grad_(), truth, frame)[0].item()
    t.require(least < value.item(), "loss of the truth itself", f"{least:g}", f"less than {value.item():g}")


def check_channels_conformance(t: TaskUnderTest) -> None:
    """Check the colour fields that ``build`` returns for data of 1 channel and of 5 channels.

    A colour field must have as many channels as the data; an image must render, and training must run.
    ``build`` may instead raise an error, or use the same number of channels for all data. Tasks that declare channels
    or an ``example`` are not checked.
    """
    if t.task.example is not None or t.task.channels:
        return  # only the task knows what data of other channels would look like, or there are no others
    declared = {}
    for count in (1, 5):
        other = t.with_channels(count)
        with suppress(NeuprimError, ValueError):  # refused
            declared[count] = other.build_fields()[1].channels, other
    if len(declared) == 2 and len({found for found, _ in declared.values()}) == 1:
        return  # a fixed number, which the renderer compares with every background
    for count, (found, other) in declared.items():
        data = f"with data of {count} channel{'s' * (count > 1)}"
        t.require(found == count, f"colour.channels {data}", found, count)
        try:
            other.draw(data, other.perturbed_model(torch.float32), other.views[0])
        except FormError as error:
            raise FormError(f"{data}: {error}") from error
        for _ in other.trainer(2).run():
            pass


# ---------------------------------------------------------------- files and conditions


def check_resume_conformance(t: TaskUnderTest) -> None:
    """Check that N training steps, a checkpoint on disk and N more steps give the same bits as 2N steps."""
    whole, first, second = (t.trainer(2 * _STEPS) for _ in range(3))
    for _ in range(_STEPS):
        whole.train_step()
        first.train_step()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.safetensors"
        tensors, header = first.state()
        checkpoint.write_tensors(path, "checkpoint", tensors, {"task": t.task.name, **header})
        header, tensors = checkpoint.read_tensors(path, "checkpoint")
        second.load_state(tensors, header, str(path))
    for _ in range(_STEPS):
        whole.train_step()
        second.train_step()
    where = f"{2 * _STEPS} steps against {_STEPS} + resume + {_STEPS}"
    t.require_equal(where, second.state()[0], whole.state()[0])


def check_save_load_conformance(t: TaskUnderTest) -> None:
    """Check that a saved model loads with equal bits and images, and that compressing a model again changes no bit.

    Compressed files store canonical parameters, which must give the same images up to a difference of 1e-4.
    """
    model = t.perturbed_model(torch.float32)
    canonical = canonical_model(model)
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        path = Path(folder) / "model.safetensors"
        checkpoint.save_model(path, model, t.task.name, {})
        loaded = checkpoint.load_model_checkpoint(path, t.task)[0]
        t.require_equal("after loading", loaded.params, model.params)
        t.require_equal("after folding twice", canonical_model(canonical).params, canonical.params)
        for view in t.views[:3]:
            image = t.draw("saved", model, view)
            for where, other, tolerance in (("loading", loaded, 0.0), ("folding", canonical, 1e-4)):
                change = float((t.draw(where, other, view) - image).abs().max())
                found = f"a change of {change:.3g}"
                t.require(change <= tolerance, f"view {view.name} after {where}", found, tolerance)
        stored = [canonical.params]
        for _ in range(2):
            again = Primitives(model.density, model.colour, stored[-1])
            checkpoint.save_compressed(Path(folder) / "model.neuprim", again, t.task.name, {}, LEVELS[1])
            stored.append(checkpoint.load_model_checkpoint(Path(folder) / "model.neuprim", t.task)[0].params)
        t.require_equal("compressed twice", stored[2], stored[1])


def check_conditions_conformance(t: TaskUnderTest) -> None:
    """Check the task's conditions (inputs of an image besides the camera, e.g. the time).

    A condition must parse the text of a valid value and refuse other text. Images must be finite over the condition's
    range. Rendering without a value for the condition must raise an error that names the condition.
    """
    model = t.perturbed_model(torch.float32)
    view = t.views[0]
    for spec in t.task.conditions:
        where = f"condition {spec.name!r}"
        _check_condition_parsing(t, spec, where)
        generator = torch.Generator().manual_seed(9)
        others = {name: value for name, value in view.conditions.items() if name != spec.name}
        ends = [torch.full(spec.shape, float(end)) for end in spec.range]
        for value in (*ends, random_conformance_condition(spec, generator)):
            changed = replace(view, conditions={**others, spec.name: value})
            t.draw(f"{where} = {value.tolist()}", model, changed)
        found = "it was drawn"
        try:
            render(model, view.camera, others, t.settings.renderer)
        except (KeyError, NeuprimError) as error:
            found = str(error)
        t.require(spec.name in found, f"a frame without {where}", repr(found), "KeyError or ConfigError that names it")


def _check_condition_parsing(t: TaskUnderTest, spec: ConditionSpec, where: str) -> None:
    low, high = conformance_range(spec)
    expected = torch.full(spec.shape, low + 0.25 * (high - low))
    text = ",".join(f"{x:g}" for x in expected.flatten().tolist())
    values = spec.parse(text)
    shapes = [tuple(value.shape) for value in values]
    fits = len(shapes) >= 1 and all(shape == spec.shape for shape in shapes)
    t.require(fits, f"{where}: parse({text!r})", f"shapes {shapes}", f"frames of shape {spec.shape}")
    near = torch.allclose(values[0].float(), expected, rtol=1e-4, atol=1e-6)
    t.require(near, f"{where}: parse({text!r})", values[0].tolist(), expected.tolist())
    try:
        spec.parse("no such value")
    except NeuprimError:
        return
    t.require(False, f"{where}: parse('no such value')", "it was accepted", "ConfigError")


# ---------------------------------------------------------------- running the checks

CHECKS: dict[str, Callable[[TaskUnderTest], None]] = {
    "description": check_description_conformance,
    "fields": check_fields_conformance,
    "parameters": check_parameters_conformance,
    "evaluation": check_evaluation_conformance,
    "loss": check_loss_conformance,
    "channels": check_channels_conformance,
    "activity": check_activity_conformance,
    "integral": check_integral_conformance,
    "gradients": check_gradients_conformance,
    "scaling": check_scaling_conformance,
    "split": check_split_conformance,
    "reductions": check_reductions_conformance,
    "resume": check_resume_conformance,
    "save_load": check_save_load_conformance,
    "conditions": check_conditions_conformance,
}
"""All conformance checks by name, in reading order."""


def named_checks(
    task: TaskSpec, preset: str | None = None, model: Mapping[str, Any] | None = None
) -> dict[str, Callable[[], None]]:
    """Return the checks of a task: name -> function without arguments, which raises :class:`ConformanceError`.

    Args:
        preset: name of the preset for the models' settings; None is the task's default preset.
        model: changes to the model settings, e.g. ``{"neurons": 2, "density": {"form": "gaussian"}}``.
    """
    subject = TaskUnderTest(task, preset=preset, model=model)
    return {name: partial(_run_check, subject, name) for name in CHECKS}


def _run_check(subject: TaskUnderTest, name: str) -> None:
    with suppress(Exception):  # a task whose files are broken fails only the checks that need them
        _ = subject.settings, subject.options  # read once for all checks
    where = f"task {subject.task.name!r}: {name}"
    try:
        CHECKS[name](subject.named(name))
    except ConformanceError:
        raise
    except FormError as error:  # it names field, method and tensor
        raise ConformanceError(f"{where}: {error}") from error
    except (Exception, SystemExit) as error:  # whatever a task's code does, the message must name the task
        text = (
            f"stopped by {type(error).__name__}: {' '.join(str(error).split())}{_find_conformance_failure_line(error)}"
        )
        raise ConformanceError(f"{where}: {text}") from error


def check_task(task: TaskSpec, preset: str | None = None, model: Mapping[str, Any] | None = None) -> None:
    """Run all checks on a task; see :func:`named_checks` for the arguments.

    Raises:
        ConformanceError: one line for each check that failed.
    """
    failed: list[ConformanceError] = []
    for run in named_checks(task, preset, model).values():
        try:
            run()
        except ConformanceError as error:
            failed.append(error)
    if failed:
        raise ConformanceError("\n".join(map(str, failed))) from failed[0]


def checks(task: TaskSpec, preset: str | None = None, model: Mapping[str, Any] | None = None) -> Any:
    """Return a pytest decorator that runs a test function once per check, with the check as argument ``check``."""
    import pytest

    found = named_checks(task, preset, model)
    return pytest.mark.parametrize("check", [pytest.param(run, id=name) for name, run in found.items()])


def _find_conformance_failure_line(error: BaseException) -> str:
    """Return where in the task's own code an error was raised, e.g. ``" in Waves.on_split (fields.py, line 12)"``.

    The text is empty if no line of the traceback is in the task's own code.
    """
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        module = str(frame.f_globals.get("__name__", ""))
        if not module.startswith(_NOT_THE_TASKS) and module.split(".")[0] not in _LIBRARIES:
            return f" in {frame.f_code.co_qualname} ({Path(frame.f_code.co_filename).name}, line {line})"
    return ""

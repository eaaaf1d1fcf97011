"""Checks at the edges: conditions, extreme geometry, wrong settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from neuprim.conformance.example import between, sample
from neuprim.conformance.forms import camera_at
from neuprim.conformance.subject import Subject, watched
from neuprim.core.data import View
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import render
from neuprim.core.used_settings import build_settings

__all__ = ["check_clear_errors", "check_conditions", "check_extremes", "check_missing_conditions"]


# ---------------------------------------------------------------- conditions


def check_conditions(t: Subject) -> None:
    """Each declared condition parses from numbers, refuses nonsense in one line, and any value in its range renders:
    flags derive from it."""
    model = t.model(torch.float32)
    for spec in t.task.conditions:
        where = f"condition {spec.name!r}"
        t.require(
            spec.name.isidentifier(), where, repr(spec.name), "a name of letters, digits and _ (it becomes a flag)"
        )
        low, high = spec.range
        t.require(low < high, f"{where}: range", spec.range, "a lower and a higher end")
        _parses(t, spec, where)
        if spec.sweep:
            frames, expected = spec.parse(spec.sweep), "two or more, an animation"
            t.require(len(frames) > 1, f"{where}: frames of its sweep {spec.sweep!r}", len(frames), expected)
        try:
            spec.parse("no such value")
        except NeuprimError:
            pass
        else:
            t.require(False, f"{where}: parse('no such value')", "it was taken", "ConfigError")
        generator = torch.Generator().manual_seed(9)
        ends = [torch.full(spec.shape, float(end)) for end in (low, high)]
        for value in (*ends, sample(spec, generator)):
            view = t.views()[0]
            t.image(
                f"{where} = {value.tolist()}", model, replace(view, conditions={**view.conditions, spec.name: value})
            )


def _parses(t: Subject, spec: ConditionSpec, where: str) -> None:
    low, high = between(spec)
    middle = low + 0.25 * (high - low)
    count = int(torch.Size(spec.shape).numel())
    text = ",".join([f"{middle:g}"] * count)
    values = spec.parse(text)
    t.require(len(values) >= 1, f"{where}: parse({text!r})", "no frame", "one tensor per frame")
    for value in values:
        t.require(
            tuple(value.shape) == spec.shape,
            f"{where}: parse({text!r})",
            f"shape {tuple(value.shape)}",
            str(spec.shape),
        )
    expected = torch.full(spec.shape, middle)
    near = torch.allclose(values[0].float(), expected, rtol=1e-4, atol=1e-6)
    t.require(near, f"{where}: parse({text!r})", values[0].tolist(), str(expected.tolist()))


def check_missing_conditions(t: Subject) -> None:
    """A frame that lacks a condition which matters is refused by name rather than drawn as if it had some value."""
    model = t.model(torch.float32)
    for spec in t.task.conditions:
        view = t.views()[0]
        others = {k: v for k, v in view.conditions.items() if k != spec.name}
        try:
            render(model, view.camera, others, t.settings.renderer)
        except (KeyError, NeuprimError) as error:
            t.require(
                spec.name in str(error),
                f"message without condition {spec.name!r}",
                repr(str(error)),
                "one that names it",
            )
            continue
        generator = torch.Generator().manual_seed(10)
        images = [
            render(model, v.camera, {**v.conditions, spec.name: sample(spec, generator)}, t.settings.renderer).rgb
            for v in (view, view)
        ]
        t.require(
            torch.equal(*images),
            f"a frame without condition {spec.name!r}",
            "it was drawn",
            "KeyError or ConfigError that names it",
        )


# ---------------------------------------------------------------- extremes


def check_extremes(t: Subject) -> None:
    """Colours and gradients stay finite for huge, tiny and needle-like primitives, cameras far away or inside, and no
    density at all."""
    for name, change, place in _CASES:
        model = t.model(torch.float32)
        change(model)
        view = place(t.views()[0], model)
        params = watched(model)
        rgb = t.image(name, model, view)
        if rgb.requires_grad:
            rgb.sum().backward()
        for parameter, value in params.items():
            bad = value.grad is not None and not bool(torch.isfinite(value.grad).all())
            t.require(
                not bad, f"{t.lowering(parameter)}gradient of {parameter}, {name}", "NaN or infinity", "finite numbers"
            )


def _scaled(by: tuple[float, float, float]) -> Callable[[Primitives], None]:
    def change(model: Primitives) -> None:
        model.params["log_scales"] = model.params["log_scales"] + torch.tensor(by)

    return change


def _nothing(model: Primitives) -> None:
    zero = model.density.scale_density(model.of(model.density), torch.zeros(model.count))
    model.params.update(zero)


def _gathered(model: Primitives) -> None:
    model.params["means"] = torch.zeros_like(model.params["means"])


def _same(model: Primitives) -> None:
    pass


def _here(view: View, model: Primitives) -> View:
    return view


def _far(view: View, model: Primitives) -> View:
    return replace(view, camera=camera_at(view.camera, 1e5 * view.camera.position, 1e5))


def _inside(view: View, model: Primitives) -> View:
    """Behind some primitives, inside one, in front of others."""
    return replace(view, camera=camera_at(view.camera, model.params["means"][0].detach()))


_CASES: tuple[tuple[str, Callable[[Primitives], None], Callable[[View, Primitives], View]], ...] = (
    ("tiny primitives", _scaled((-14.0, -14.0, -14.0)), _here),
    ("huge primitives", _scaled((9.0, 9.0, 9.0)), _here),
    ("needles", _scaled((0.0, -9.0, -9.0)), _here),
    ("discs", _scaled((0.0, 0.0, -9.0)), _here),
    ("a camera far away", _same, _far),
    ("a camera inside, with primitives behind it", _same, _inside),
    ("primitives in one place", _gathered, _here),
    ("zero density", _nothing, _here),
)


# ---------------------------------------------------------------- errors


def check_clear_errors(t: Subject) -> None:
    """A setting that the task does not have is a ConfigError that names it, before any data are loaded: typos cost no
    run."""
    model = t.settings.model
    t.task.check(build_settings(t.task, model, t.options))
    for group in ("density", "colour"):
        changed: dict[str, Any] = {group: {**getattr(model, group), "no_such_setting": 1}}
        wrong = build_settings(t.task, replace(model, **changed), t.options)
        where = f"TaskSpec.check with model.{group}.no_such_setting=1"
        try:
            t.task.check(wrong)
        except ConfigError as error:
            text = str(error)
            t.require("no_such_setting" in text, where, repr(text), "a message that names the setting")
            t.require("\n" not in text, where, repr(text), "a message of one line")
            continue
        t.require(False, where, "it was taken", "ConfigError (neuprim.core.validation.choose does it)")

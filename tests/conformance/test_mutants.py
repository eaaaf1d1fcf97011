"""Every check fails on a task that is broken in the matching way, with a message that says where."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.conformance import CHECKS, ConformanceError, named_checks
from neuprim.conformance.task_under_test import conformance_dataset
from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import Conditions, ConditionSpec, Constant, Cosine, Field
from neuprim.core.model.gaussian import GaussianDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.core.task import SceneSpec, Supervision, TaskSpec
from neuprim.core.train.losses import photometric
from neuprim.tasks.static import TASK, SphericalHarmonics

MODEL = {"neurons": 2, "colour": {"form": "sh"}, "sh_degree": 0, "init": {}}


def using(
    density: type[CosineDensity] | type[GaussianDensity] = CosineDensity, colour: type = SphericalHarmonics, **more: Any
) -> TaskSpec:
    """The static task with other fields."""

    def build(model: Mapping[str, Any], dataset: Any) -> Any:
        first = density() if issubclass(density, GaussianDensity) else density(2)
        return first, colour(0, dataset.channels)

    fields: dict[str, type[Field]] = {**(TASK.fields or {}), density.__name__: density, colour.__name__: colour}
    return replace(TASK, build=build, fields=fields, **more)


def unlisted(density: type[CosineDensity]) -> TaskSpec:
    """The same, whose fields do not list the usual density."""
    task = using(density)
    return replace(task, fields={name: field for name, field in (task.fields or {}).items() if name != "CosineDensity"})


# ---------------------------------------------------------------- densities that break one promise each


def variant(name: str, base: type[Field] = CosineDensity, **methods: Any) -> Any:
    """A field class with other methods."""
    return type(name, (base,), methods)


def less_of(values: tuple[Any, ...], make: Any = None) -> type[CosineDensity]:
    class Less(CosineDensity):
        def reductions(self) -> dict[str, tuple[int, ...]]:
            return {"neurons": values} if self.neurons else {}

        def reduce(self, params: Params, geometry: Geometry, name: str, value: int) -> Any:
            field, fewer = super().reduce(params, geometry, name, value)
            return (Less(field.neurons), fewer) if make is None else make(field, fewer)

    return Less


class SwallowsSettings(CosineDensity):
    def __init__(self, neurons: int = 8, **anything: Any) -> None:
        super().__init__(neurons)


def specs(index: int = -1, **changes: Any) -> Any:
    """A density with a changed ParameterSpec."""

    def parameters(self: CosineDensity) -> list[ParameterSpec]:
        found = CosineDensity.parameters(self)
        found[index] = replace(found[index], **changes)
        return found

    return variant("Changed", parameters=parameters)


def lowers(change: Callable[[Cosine, Geometry], Cosine], name: str = "Changed") -> Any:
    def lower(self: CosineDensity, params: Params, geometry: Geometry, conditions: Conditions) -> Cosine:
        return change(CosineDensity.lower(self, params, geometry, conditions), geometry)

    return variant(name, lower=lower)


def colours(name: str, change: Callable[[Tensor, Conditions], Tensor]) -> Any:
    def lower(self: Any, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        return Constant(change(SphericalHarmonics.lower(self, params, geometry, camera, conditions).rgb, conditions))

    return variant(name, SphericalHarmonics, lower=lower)


def scale_in_place(self: Any, params: Params, factor: Tensor) -> dict[str, Tensor]:
    params["w2"].mul_(factor[:, None])
    return {**params, "b2": params["b2"] * factor[:, None]}


class Remembers(CosineDensity):
    """State that no checkpoint holds."""

    calls = 0

    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> Cosine:
        self.calls += 1
        form = super().lower(params, geometry, conditions)
        return replace(form, b2=form.b2 * (1 + 1e-2 * self.calls))


class Progresses(SphericalHarmonics):
    """Another picture at the end of training than after loading."""

    gain = 1.0

    def set_progress(self, progress: float) -> None:
        self.gain = 1.0 + progress

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        return Constant(self.gain * super().lower(params, geometry, camera, conditions).rgb)


ForgetsNeurons = variant("ForgetsNeurons", settings=lambda self: {"neurons": 3})
Lazy = specs(0, init=lambda context: torch.rand(context.count, 2, 3))
Transposed = lowers(lambda form, geometry: replace(form, b2=form.b2.T), "Transposed")
LeavesOut = variant("LeavesOut", active_rows=lambda self, params, conditions: torch.arange(3))
Unsorted = variant("Unsorted", active_rows=lambda self, params, conditions: torch.arange(len(params["b2"])).flip(0))
Doubled = variant("Doubled", density=lambda self, *arguments: 1.05 * CosineDensity.density(self, *arguments))
Squares = variant("Squares", scale_density=lambda self, p, f: CosineDensity.scale_density(self, p, f.square()))
InPlace = variant("InPlace", scale_density=scale_in_place)
FoldsAway = variant("FoldsAway", canonicalize=lambda self, params: {**params, "w2": params["w2"].abs()})
FoldsOn = variant("FoldsOn", canonicalize=lambda self, p: {**p, "b1": p["b1"] + 2 * math.pi / self.omega0})
Copies = variant("Copies", on_split=lambda self, params, old, new: dict(params))
Spills = variant("Spills", GaussianDensity, on_split=lambda self, params, old, new: dict(params))
Grey = colours("Grey", lambda rgb, conditions: rgb.mean(-1, keepdim=True))
FirstThree = colours("FirstThree", lambda rgb, conditions: rgb[:, :3])
Uphill = colours("Uphill", lambda rgb, conditions: 2 * rgb.detach() - rgb)
Timed = colours("Timed", lambda rgb, conditions: rgb * (1 + conditions["time"].to(rgb)))
Untimed = colours("Untimed", lambda rgb, conditions: rgb * (1 + conditions.get("time", torch.tensor(0.5)).to(rgb)))
BlowsUp = colours("BlowsUp", lambda rgb, conditions: rgb / conditions["time"].to(rgb))


def refuse_vaguely(rgb: Tensor, conditions: Conditions) -> Tensor:
    if "time" not in conditions:
        raise KeyError("something is missing")
    return rgb


Mute = colours("Mute", refuse_vaguely)


def without_conditions(dataset: Dataset, frames: int) -> Any:
    return [replace(view, conditions={}) for view in dataset.orbit(frames)]


def at_most_three(model: Mapping[str, Any], dataset: Any) -> Any:
    return CosineDensity(2), SphericalHarmonics(0, min(dataset.channels, 3))


def three_only(settings: Mapping[str, Any]) -> Any:
    """A weight per colour of RGB."""
    weights = torch.tensor([0.2, 0.7, 0.1])
    return lambda rendered, truth, frame: (((rendered - truth).abs() * weights).mean(), {})


def number(text: str) -> list[Tensor]:
    try:
        return [torch.tensor(float(text))]
    except ValueError:
        raise ConfigError(f"--time {text}: expected a number") from None


def lenient(text: str) -> list[Tensor]:
    try:
        return number(text)
    except ConfigError:
        return [torch.tensor(0.0)]


def timed(colour: type = Timed, parse: Callable[[str], list[Tensor]] = number, **more: Any) -> TaskSpec:
    return using(colour=colour, conditions=(ConditionSpec("time", (), "s", (0.0, 1.0), parse),), **more)


def bare() -> Dataset:
    """Three channels, and no conditions."""
    return conformance_dataset(())


# ---------------------------------------------------------------- losses


def negative(settings: Mapping[str, Any]) -> Any:
    inner = photometric(settings)

    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        value, parts = inner(rendered, truth, frame)
        return -value, parts

    return loss


def maskless(settings: Mapping[str, Any]) -> Any:
    """Fails where some pixels do not count, which only some data sets have."""

    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        difference = (rendered - truth).abs()
        return difference.mean() if frame.mask is None else difference[:, frame.mask].mean(), {}

    return loss


def detached(settings: Mapping[str, Any]) -> Any:
    return lambda rendered, truth, frame: ((rendered.detach() - truth).abs().mean(), {})


GHOST = SceneSpec("ghost", "has no file", lambda s, c: None)  # type: ignore[arg-type, return-value]
UNNAMED = replace(TASK, check=lambda model: None)


def vague(model: Mapping[str, Any]) -> None:
    if "no_such_setting" in (*model["density"], *model["colour"]):
        raise ConfigError("something is wrong")


MUTANTS: list[tuple[str, str, TaskSpec]] = [
    ("description", "build is of type int", replace(TASK, build=3)),  # type: ignore[arg-type]
    ("description", "TaskSpec.fields", replace(TASK, fields=None)),
    ("description", "scene/static/ghost.yaml", replace(TASK, scenes=(*TASK.scenes, GHOST))),
    (
        "description",
        "a setting that is refused (model.init.mode",
        replace(TASK, fields={"SphericalHarmonics": SphericalHarmonics}),
    ),
    (
        "description",
        "tunable_settings: found 'neurons'; expected the name",
        replace(TASK, tunable_settings=lambda model: {"neurons": (1,)}),
    ),
    (
        "description",
        "tunable_settings: model.neurons=99: found a",
        replace(TASK, tunable_settings=lambda m: {"model.neurons": (4, 99)}),
    ),
    (
        "description",
        "tunable_settings: task.options.haze=1",
        replace(TASK, tunable_settings=lambda m: {"task.options.haze": (1,)}),
    ),
    ("description", "model.density.no_such_setting=1: found 'it was accepted'", UNNAMED),
    ("description", "a message that names the setting", replace(TASK, check=vague)),
    ("fields", "ForgetsNeurons(**settings)", using(ForgetsNeurons)),
    ("fields", "no_such_setting=1", using(SwallowsSettings)),
    ("parameters", "'means': found a name used twice", using(specs(name="means"))),
    ("parameters", "'b2': lr: found inf", using(specs(lr=math.inf))),
    ("parameters", "'b2': shape", using(specs(shape=(-1,)))),
    ("parameters", "density.parameters: 'W1': start values of one seed", using(Lazy)),
    ("parameters", "(12, 1)", using(specs(init=lambda context: torch.zeros(context.count)))),
    ("evaluation", "expected 2, the channels of task 'static': a, b", using(channels=("a", "b"), example=bare)),
    ("evaluation", "display returned torch.float32 of shape (9, 10, 2)", using(display=lambda image: image[..., :2])),
    ("evaluation", "orbit: view orbit_000: found no time", timed(orbit=without_conditions)),
    ("loss", "loss of the truth itself", using(loss=negative)),
    ("loss", "no gradient", using(loss=detached)),
    ("loss", "stopped by IndexError", using(loss=maskless)),
    ("channels", "with data of 5 channels: colour field FirstThree: lower returned", using(colour=FirstThree)),
    ("channels", "colour.channels with data of 5 channels: found 3", replace(using(), build=at_most_three)),
    ("channels", "stopped by RuntimeError", replace(using(), loss=three_only)),
    ("activity", "density.active_rows: density of a primitive that it leaves out", using(LeavesOut)),
    ("activity", "density.active_rows: found torch.int64 [11, 10", using(Unsorted)),
    ("integral", "density.lower: integral of a chord, primitive", using(Doubled)),
    (
        "gradients",
        "density.lower: gradient of w2: found none",
        using(lowers(lambda f, g: replace(f, w2=f.w2.detach()))),
    ),
    ("gradients", "density field Transposed lowered to Cosine: b2 has shape (1, 12)", using(Transposed)),
    ("gradients", "density.lower: gradient of b1: found zero", using(lowers(lambda f, g: replace(f, b1=f.b1 * 0)))),
    ("gradients", "gradient of W1, primitive", using(lowers(lambda f, g: replace(f, W1=2 * f.W1 - f.W1.detach())))),
    ("gradients", "colour.lower: gradient of sh_dc, primitive", using(colour=Uphill)),
    ("scaling", "density.scale_density: density, primitive", using(Squares)),
    ("scaling", "density.scale_density: w2: found changed in place", using(InPlace)),
    ("split", "density.on_split: density of a child inside it, primitive", using(Copies)),
    ("split", "density.on_split: mass of both children of primitive", using(Spills)),
    ("reductions", "found (0, 1); expected whole numbers from 0, the largest first", using(less_of((0, 1)))),
    ("reductions", "found CosineDensity; expected a field that Task", unlisted(less_of((1,), lambda f, p: (f, p)))),
    ("reductions", "reduce('neurons', 1)", using(less_of((1,), lambda f, p: (f, {**p, "b2": p["b2"] * math.nan})))),
    ("resume", "8 steps against 4 + resume + 4", using(Remembers)),
    ("save_load", "after loading: found a change", using(colour=Progresses)),
    ("save_load", "after folding: found a change of", using(FoldsAway)),
    ("save_load", "after folding twice: b1: found different values", using(FoldsOn)),
    ("conditions", "parse('no such value'): found it was accepted", timed(parse=lenient)),
    ("conditions", "parse('0.25'): found shapes [(1,)]", timed(parse=lambda text: [number(text)[0].reshape(1)])),
    ("conditions", "parse('0.25'): found 0.5", timed(parse=lambda text: [2 * number(text)[0]])),
    ("conditions", "condition 'time' = 0.0: found colors of primitive 0 is not finite", timed(BlowsUp)),
    ("conditions", "it was drawn", timed(Untimed)),
    ("conditions", "something is missing", timed(Mute)),
]


@pytest.mark.parametrize(
    ("name", "text", "task"), MUTANTS, ids=[f"{name}-{i}" for i, (name, _, _) in enumerate(MUTANTS)]
)
def test_a_broken_task_is_caught(name: str, text: str, task: TaskSpec) -> None:
    with pytest.raises(ConformanceError) as caught:
        named_checks(task, model=MODEL)[name]()
    message = str(caught.value)
    assert message.startswith(f"task 'static': {name}: ")
    assert text in message


def test_every_check_has_a_mutant() -> None:
    assert {name for name, _, _ in MUTANTS} == set(CHECKS)


@pytest.mark.parametrize("name", CHECKS)
def test_the_unbroken_ones_pass(name: str) -> None:
    """So that a mutant fails for its fault and not for what all of them share."""
    named_checks(timed(), model=MODEL)[name]()
    if name != "description":
        named_checks(using(GaussianDensity), model=MODEL)[name]()


def test_a_fixed_number_of_channels_and_a_refusal_pass() -> None:
    """The renderer refuses the background of other data; and a task may say itself that it takes RGB only."""

    def build(model: Mapping[str, Any], dataset: Any) -> Any:
        if dataset.channels != 3:
            raise ConfigError("RGB only")
        return CosineDensity(2), SphericalHarmonics(0, 3)

    for task in (
        replace(using(), build=build),
        replace(using(), build=lambda m, d: (CosineDensity(2), SphericalHarmonics(0))),
    ):
        named_checks(task, model=MODEL)["channels"]()

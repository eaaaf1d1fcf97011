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
from neuprim.conformance.example import example
from neuprim.core.cameras.projections import AnyCamera
from neuprim.core.data import Clip, Dataset, Pixels
from neuprim.core.errors import ConfigError
from neuprim.core.layers import LayerSpec
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.densities.gaussian import GaussianDensity
from neuprim.core.model.fields import Conditions, ConditionSpec, Constant, Cosine, Field
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import InitContext, ParameterSpec, Params
from neuprim.core.task import SceneSpec, Supervision, TaskSpec
from neuprim.core.train.losses import photometric
from neuprim.tasks.static import TASK
from neuprim.tasks.static.fields import SphericalHarmonics

MODEL = {"neurons": 2, "sh_degree": 0, "init": {}}


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


class ForgetsNeurons(CosineDensity):
    def settings(self) -> dict[str, Any]:
        return {"neurons": 3}


def reduction_names(values: tuple[Any, ...], make: Any = None) -> type[CosineDensity]:
    class Less(CosineDensity):
        def reductions(self) -> dict[str, tuple[int, ...]]:
            return {"neurons": values} if self.neurons else {}

        def reduce(self, params: Params, geometry: Geometry, name: str, value: int) -> Any:
            field, fewer = super().reduced(params, geometry, name, value)
            return (Less(field.neurons), fewer) if make is None else make(field, fewer)

    return Less


def in_pieces(*pieces: PrunableUnit) -> type[CosineDensity]:
    class Pieces(CosineDensity):
        def prunable_units(self) -> tuple[PrunableUnit, ...]:
            return pieces

    return Pieces


class SwallowsSettings(CosineDensity):
    def __init__(self, neurons: int = 8, **anything: Any) -> None:
        super().__init__(neurons)


def specs(**changes: Any) -> type[CosineDensity]:
    class Changed(CosineDensity):
        def parameters(self) -> list[ParameterSpec]:
            found = super().parameters()
            return [*found[:-1], replace(found[-1], **changes)]

    return Changed


class Lazy(CosineDensity):
    """Draws its start values from the global generator."""

    def parameters(self) -> list[ParameterSpec]:
        found = super().parameters()
        return [replace(found[0], init=lambda c: torch.rand(c.count, self.neurons, 3)), *found[1:]]


class WrongStart(CosineDensity):
    def parameters(self) -> list[ParameterSpec]:
        found = super().parameters()
        return [*found[:-1], replace(found[-1], init=lambda c: torch.zeros(c.count))]


class Meddler(CosineDensity):
    def parameters(self) -> list[ParameterSpec]:
        def init(context: InitContext) -> Tensor:
            context.means.mul_(0.5)
            return torch.ones(context.count, 1)

        found = super().parameters()
        return [*found[:-1], replace(found[-1], init=init)]


def lowers(change: Callable[[Cosine, Geometry], Cosine]) -> type[CosineDensity]:
    class Changed(CosineDensity):
        def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> Cosine:
            return change(super().lower(params, geometry, conditions), geometry)

    return Changed


class Transposed(CosineDensity):
    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> Cosine:
        form = super().lower(params, geometry, conditions)
        return replace(form, b2=form.b2.T)


class LeavesOut(CosineDensity):
    def active_rows(self, params: Params, conditions: Conditions) -> Tensor:
        return torch.arange(3)


class Unsorted(CosineDensity):
    def active_rows(self, params: Params, conditions: Conditions) -> Tensor:
        return torch.arange(len(params["b2"])).flip(0)


class Doubled(CosineDensity):
    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        return 1.05 * super().density(params, geometry, prim, x, conditions)


class Squares(CosineDensity):
    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        return super().scale_density(params, factor.square())


class FoldsAway(CosineDensity):
    """Half a turn without the weight's other sign."""

    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        return {**params, "w2": params["w2"].abs()}


class FoldsOnAndOn(CosineDensity):
    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        return {**params, "b1": params["b1"] + 2 * math.pi / self.omega0}


class InPlace(CosineDensity):
    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        params["w2"].mul_(factor[:, None])
        return {**params, "b2": params["b2"] * factor[:, None]}


class Copies(CosineDensity):
    """Children with their parents' weights, as the authors' code has it."""

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        return dict(params)


class Spills(GaussianDensity):
    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        return dict(params)


class HalfDivides(CosineDensity):
    def divide(self, params: Params, geometry: Geometry) -> tuple[Tensor, dict[str, Tensor], Geometry]:
        return torch.ones(geometry.count, dtype=torch.bool), dict(params), geometry


class Noisy(CosineDensity):
    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> Cosine:
        form = super().lower(params, geometry, conditions)
        return replace(form, b2=form.b2 + 1e-3 * torch.rand_like(form.b2))


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


class Grey(SphericalHarmonics):
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        return Constant(super().lower(params, geometry, camera, conditions).rgb.mean(-1, keepdim=True))


class FirstThree(SphericalHarmonics):
    """Of data with more channels it draws the first three only."""

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        return Constant(super().lower(params, geometry, camera, conditions).rgb[:, :3])


def at_most_three(model: Mapping[str, Any], dataset: Any) -> Any:
    return CosineDensity(2), SphericalHarmonics(0, min(dataset.channels, 3))


def three_only(settings: Mapping[str, Any]) -> Any:
    """A weight per colour of RGB."""
    weights = torch.tensor([0.2, 0.7, 0.1])
    return lambda rendered, truth, frame: (((rendered - truth).abs() * weights).mean(), {})


class Uphill(SphericalHarmonics):
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        rgb = super().lower(params, geometry, camera, conditions).rgb
        return Constant(2 * rgb.detach() - rgb)


# ---------------------------------------------------------------- conditions


class Timed(SphericalHarmonics):
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        rgb = super().lower(params, geometry, camera, conditions).rgb
        return Constant(rgb * (1 + conditions["time"].to(rgb)))


class TimedByDefault(SphericalHarmonics):
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        rgb = super().lower(params, geometry, camera, conditions).rgb
        return Constant(rgb * (1 + conditions.get("time", torch.tensor(0.5)).to(rgb)))


class BlowsUp(SphericalHarmonics):
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        rgb = super().lower(params, geometry, camera, conditions).rgb
        return Constant(rgb / conditions["time"].to(rgb))


class Mute(SphericalHarmonics):
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        if "time" not in conditions:
            raise KeyError("something is missing")
        return super().lower(params, geometry, camera, conditions)


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


def timed(
    colour: type = Timed, parse: Callable[[str], list[Tensor]] = number, sweep: str = "", **more: Any
) -> TaskSpec:
    return using(colour=colour, conditions=(ConditionSpec("time", (), "s", (0.0, 1.0), parse, sweep=sweep),), **more)


def bare() -> Dataset:
    """Three channels, and no conditions."""
    return example(())


def misfit() -> Dataset:
    found = example(())
    found.train.images[0] = Pixels(torch.zeros(4, 4, 3))  # type: ignore[attr-defined]
    return found


# ---------------------------------------------------------------- losses


def negative(settings: Mapping[str, Any]) -> Any:
    inner = photometric(settings)

    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        value, parts = inner(rendered, truth, frame)
        return -value, parts

    return loss


def uphill(settings: Mapping[str, Any]) -> Any:
    """Right values, gradients that point the wrong way."""
    inner = photometric(settings)

    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        value, parts = inner(rendered, truth, frame)
        return 2 * value.detach() - value, parts

    return loss


def maskless(settings: Mapping[str, Any]) -> Any:
    """Fails where some pixels do not count, which only some data sets have."""

    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        difference = (rendered - truth).abs()
        return difference.mean() if frame.mask is None else difference[:, frame.mask].mean(), {}

    return loss


def per_pixel(settings: Mapping[str, Any]) -> Any:
    return lambda rendered, truth, frame: ((rendered - truth).abs(), {})


def detached(settings: Mapping[str, Any]) -> Any:
    return lambda rendered, truth, frame: ((rendered.detach() - truth).abs().mean(), {})


def wordy(settings: Mapping[str, Any]) -> Any:
    return lambda rendered, truth, frame: ((rendered - truth).abs().mean(), {"l1": "small"})


GLOW = LayerSpec("glow", "light, but of one channel", lambda frame: frame.drawn.alpha)
GHOST = SceneSpec("ghost", "has no file", lambda s, c: None)  # type: ignore[arg-type, return-value]
UNNAMED = replace(TASK, check=lambda model: None)


def vague(model: Mapping[str, Any]) -> None:
    if "no_such_setting" in (*model["density"], *model["colour"]):
        raise ConfigError("something is wrong")


MUTANTS: list[tuple[str, str, TaskSpec]] = [
    ("members", "build is of type int", replace(TASK, build=3)),  # type: ignore[arg-type]
    ("members", "judge is of type int; expected a function", replace(TASK, judge=3)),  # type: ignore[arg-type]
    ("members", "TaskSpec.fields", replace(TASK, fields=None)),
    ("trade", "trade: 'neurons'; expected the name of a setting", replace(TASK, trade=lambda model: {"neurons": (1,)})),
    (
        "trade",
        "trade: model.neurons=99: found a setting that is refused",
        replace(TASK, trade=lambda model: {"model.neurons": (4, 99)}),
    ),
    (
        "trade",
        "trade: model.density.edges=1: found a setting that",
        replace(TASK, trade=lambda model: {"model.density.edges": (1,)}),
    ),
    ("trade", "trade: model.neuron=4: found a setting that", replace(TASK, trade=lambda model: {"model.neuron": (4,)})),
    (
        "trade",
        "trade: task.options.haze=1: found a setting that",
        replace(TASK, trade=lambda model: {"task.options.haze": (1,)}),
    ),
    ("files", "scene/static/ghost.yaml", replace(TASK, scenes=(*TASK.scenes, GHOST))),
    ("files", "train.rates.W1", replace(TASK, fields={"SphericalHarmonics": SphericalHarmonics})),
    ("fields", "ForgetsNeurons(**settings)", using(ForgetsNeurons)),
    ("fields", "no_such_setting=1", using(SwallowsSettings)),
    ("fields", "TaskSpec.fields['CosineDensity']", replace(TASK, fields={"SphericalHarmonics": SphericalHarmonics})),
    ("parameter_specs", "'means': found a name used twice", using(specs(name="means"))),
    ("parameter_specs", "'b2': lr: found 0", using(specs(lr=0))),
    ("parameter_specs", "'b2': lr_unit: found metre", using(specs(lr_unit="metre"))),
    ("parameter_specs", "'b2': shape", using(specs(shape=(-1,)))),
    ("parameter_specs", "'b 2'", using(specs(name="b 2"))),
    ("initialisers", "density.parameters: 'W1': init: two draws with one seed", using(Lazy)),
    (
        "initialisers",
        "density.parameters: 'b2': init: start value: found shape (12,); expected (12, 1)",
        using(WrongStart),
    ),
    (
        "initialisers",
        "density.parameters: 'b2': init: found the context's means, scales or colors changed in place",
        using(Meddler),
    ),
    ("dataset", "view train0: condition 'time'", timed(example=bare)),
    ("dataset", "view train0: pixels: found (4, 4, 3)", using(example=misfit)),
    (
        "display",
        "conformance example: 3 channels; expected 2, which task 'static' names: a, b",
        using(channels=("a", "b"), example=bare),
    ),
    ("display", "display gave torch.float32 of shape (9, 10, 2)", using(display=lambda image: image[..., :2])),
    ("display", "found its argument changed in place", using(display=lambda image: image.mul_(0.5))),
    ("display", "off its rows one by one", using(display=lambda image: image / image.max())),
    ("loss", "loss of the truth itself", using(loss=negative)),
    ("loss", "shape (9, 10, 3)", using(loss=per_pixel)),
    ("loss", "no gradient", using(loss=detached)),
    ("loss", "loss part 'l1'", using(loss=wordy)),
    ("loss", "stopped by IndexError", using(loss=maskless)),
    (
        "judging",
        "test view test0: mask is float32 (9, 10); expected bool",
        using(mask=lambda d, i: d.test.pixels(i).alpha),
    ),
    (
        "judging",
        "judge of test view test0: error is tensor(",
        using(judge=lambda d, i, rendered, truth: {"error": (rendered - truth).mean()}),
    ),
    (
        "judging",
        "diagnose: means cannot be written as JSON",
        using(diagnose=lambda d, model: {"means": model.params["means"]}),
    ),
    ("judging", "clips: 'all' has view 2; expected indices below 2", using(clips=lambda d: [Clip("all", range(3))])),
    ("judging", "facts: extent cannot be written as JSON", using(facts=lambda d: {"extent": d.center})),
    (
        "judging",
        "orbit: view orbit_000: condition 'time': found none",
        timed(orbit=lambda d, n: [replace(v, conditions={}) for v in d.orbit(n)]),
    ),
    (
        "lowered_forms",
        "density field Transposed lowered to Cosine: b2 has shape (1, 12); expected (12, 1) or (12,)",
        using(Transposed),
    ),
    (
        "lowered_forms",
        "density.lower: W1: found torch.float32; expected torch.float64",
        using(lowers(lambda f, g: replace(f, W1=f.W1.float()))),
    ),
    ("lowered_forms", "colour field Grey: lower returned a colour of C=1; expected 3", using(colour=Grey)),
    (
        "channels",
        "with data of 5 channels: colour field FirstThree: lower returned a colour of C=3; expected 5",
        using(colour=FirstThree),
    ),
    ("channels", "colour.channels with data of 5 channels: found 3; expected 5", replace(using(), build=at_most_three)),
    ("channels", "stopped by RuntimeError", replace(using(), loss=three_only)),
    (
        "layers",
        "layers: glow is torch.float32 of shape (9, 10); expected floats of shape (9, 10, 3)",
        using(layers=(GLOW,)),
    ),
    (
        "layers",
        "layer 'noise' of view",
        using(layers=(replace(GLOW, name="noise", draw=lambda frame: torch.rand(9, 10), channels=("N",)),)),
    ),
    ("alive", "density.active_rows: density of a primitive that it leaves out", using(LeavesOut)),
    ("alive", "density.active_rows: found torch.int64 [11, 10", using(Unsorted)),
    ("line_integral", "density.lower: line integral of a chord, primitive", using(Doubled)),
    ("opaque_twin", "density.lower: alpha of view train0", using(Doubled)),
    (
        "gradients",
        "density.lower: gradient of w2: found none",
        using(lowers(lambda f, g: replace(f, w2=f.w2.detach()))),
    ),
    ("gradients", "density.lower: gradient of b1: found zero", using(lowers(lambda f, g: replace(f, b1=f.b1 * 0)))),
    (
        "finite_differences",
        "density.lower: gradient of W1, primitive",
        using(lowers(lambda f, g: replace(f, W1=2 * f.W1 - f.W1.detach()))),
    ),
    ("finite_differences", "colour.lower: gradient of sh_dc, primitive", using(colour=Uphill)),
    ("scale_density", "density.scale_density: density after it, primitive", using(Squares)),
    ("scale_density", "density.scale_density: w2: found changed in place", using(InPlace)),
    ("clone", "density.scale_density by a half, twice over: view train0: found a change of", using(Squares)),
    ("on_split", "density.on_split: density of a child inside it, primitive", using(Copies)),
    ("on_split", "density.on_split: mass of both children of primitive", using(Spills)),
    ("divide", "density.divide: geometry: found 12 rows; expected 24", using(HalfDivides)),
    ("determinism", "two runs of one seed: ", using(Noisy)),
    ("learning", "mean loss over the training views", using(loss=uphill)),
    ("save_load", "after loading: found a change", using(colour=Progresses)),
    ("save_load", "SwallowsSettings(no_such_setting=1), as a model file has it", using(SwallowsSettings)),
    ("reductions", "Less.reductions()['neurons']: found ()", using(reduction_names(()))),
    ("reductions", "whole numbers from 0", using(reduction_names((1, 0.5)))),
    ("reductions", "found (0, 1); expected the largest first", using(reduction_names((0, 1)))),
    (
        "reductions",
        "Less.reduced('neurons', 1): found tensors or a field",
        using(reduction_names((1,), lambda f, p: (f, {**p, "w2": p["w2"][:, :0]}))),
    ),
    (
        "reductions",
        "found CosineDensity; expected a field that TaskSpec.fields lists",
        unlisted(reduction_names((1,), lambda f, p: (f, p))),
    ),
    ("reductions", "image: found", using(reduction_names((1,), lambda f, p: (f, {**p, "b2": p["b2"] * math.nan})))),
    (
        "pieces",
        "names that are there once",
        using(in_pieces(PrunableUnit("a", {"w2": (0,)}), PrunableUnit("a", {"w2": (1,)}))),
    ),
    ("pieces", "w3: found no such parameter", using(in_pieces(PrunableUnit("a", {"w3": (0,)})))),
    ("pieces", "found a place (7,) that it does not have", using(in_pieces(PrunableUnit("a", {"w2": (7,)})))),
    ("pieces", "found an empty place", using(in_pieces(PrunableUnit("a", {"w2": (slice(1, 1),)})))),
    (
        "pieces",
        "found numbers of another piece",
        using(in_pieces(PrunableUnit("a", {"w2": (0,)}), PrunableUnit("b", {"w2": (slice(None),)}))),
    ),
    ("pieces", "found no numbers", using(in_pieces(PrunableUnit("a", {})))),
    ("folded", "after folding: found a change of", using(FoldsAway)),
    ("folded", "b1 after folding twice: found other values", using(FoldsOnAndOn)),
    ("resume", "8 steps against 4 + resume + 4", using(Remembers)),
    ("conditions", "parse('no such value'): found it was taken", timed(parse=lenient)),
    ("conditions", "parse('0.25'): found shape (1,)", timed(parse=lambda text: [number(text)[0].reshape(1)])),
    ("conditions", "parse('0.25'): found 0.5", timed(parse=lambda text: [2 * number(text)[0]])),
    ("conditions", "condition 'time': frames of its sweep '0.5': found 1; expected two or more", timed(sweep="0.5")),
    ("conditions", "condition 'time' = 0.0: found colors of primitive 0 is not finite", timed(BlowsUp)),
    ("missing_conditions", "it was drawn", timed(TimedByDefault)),
    ("missing_conditions", "something is missing", timed(Mute)),
    (
        "extremes",
        "tiny primitives",
        using(lowers(lambda f, g: replace(f, b2=f.b2 + 1e-30 / g.length_scale[:, None] ** 8))),
    ),
    ("clear_errors", "model.density.no_such_setting=1: found it was taken", UNNAMED),
    ("clear_errors", "a message that names the setting", replace(TASK, check=vague)),
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
    if name not in ("files", "members"):
        named_checks(using(GaussianDensity), model=MODEL)[name]()


def test_infinite_rates_are_noticed() -> None:
    with pytest.raises(ConformanceError, match="lr: found inf"):
        named_checks(using(specs(lr=math.inf)), model=MODEL)["parameter_specs"]()


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


def test_an_error_in_a_method_names_it_and_its_line() -> None:
    class Explodes(CosineDensity):
        def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
            return {**params, "b1": params["b1"] + torch.ones(5)}

    with pytest.raises(ConformanceError) as caught:
        named_checks(using(Explodes), model=MODEL)["on_split"]()
    message = str(caught.value)
    assert message.startswith("task 'static': on_split: stopped by RuntimeError: The size of tensor")
    assert "Explodes.on_split (test_conformance_mutants.py, line " in message and "\n" not in message


def test_a_form_that_does_not_fit_names_its_field() -> None:
    with pytest.raises(
        ConformanceError, match=r"gradients: density field Changed lowered to Cosine: w2 has shape \(3, 2\)"
    ):
        named_checks(using(lowers(lambda f, g: replace(f, w2=f.w2[:3]))), model=MODEL)["gradients"]()

"""Conformance checks of density and colour fields: integrals, gradients, scaling, splitting and reductions."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.conformance.task_under_test import EXACT, TaskUnderTest
from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.data import View
from neuprim.core.model.fields import ColourField, Conditions, Shading
from neuprim.core.model.geometry import Geometry, PrimitiveChords
from neuprim.core.model.primitives import ActivePrimitives, Primitives, reduce_model
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.core.render import RenderSettings, render
from neuprim.core.train.population import SPLIT_LONG, SPLIT_OTHERS, SPLIT_SHIFT

_RAYS = 6
"""Rays per primitive."""
_STEPS = (1e-5, 1e-6)
"""Step sizes of finite differences. The gradient must agree at one of the two step sizes, because a pixel that changes
at a silhouette disturbs the other."""
_MASS_EACH, _MASS_MEAN = 0.25, 0.05
"""Largest relative errors of the mass (integral of density) of two split children: for one pair of children, and for
the mean over all pairs."""


# ---------------------------------------------------------------- points and rays


def _active_rows_under_test(active: ActivePrimitives) -> Tensor:
    return torch.arange(active.geometry.count) if active.rows is None else active.rows


def _integrate_under_test(active: ActivePrimitives, prim: Tensor, ray: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Integrate the density sigma along P chords (segments of rays) by Gauss-Legendre quadrature.

    Each chord is divided into eight intervals, and each interval has 16 quadrature points.
    ``ray`` has origins (P, 3), directions (P, 3), and ray parameters (P,) of both ends of the chords. ``prim`` (P,) is
    the index of each chord's primitive among the active primitives. Return integrals (P,) and the largest |sigma| (P,).
    """
    o, d, t0, t1 = ray
    x, w = (torch.from_numpy(q) for q in np.polynomial.legendre.leggauss(16))
    nodes = ((x[None] + 1) / 2 + torch.arange(8)[:, None]).reshape(-1) / 8
    t = t0[:, None] + (t1 - t0)[:, None] * nodes
    points = (o[:, None] + t[..., None] * d[:, None]).reshape(-1, 3)
    sigma = active.sigma(prim.repeat_interleave(len(nodes)), points).reshape(t.shape)
    return (sigma * (w / 16).repeat(8)).sum(-1) * (t1 - t0), sigma.abs().amax(-1)


def conformance_points_inside(
    geometry: Geometry, rows: Tensor, generator: torch.Generator, reach: float = 0.95
) -> Tensor:
    """Draw M random float64 points, (M, 3). Point i is uniform in the ellipsoid with index ``rows[i]``.

    The ellipsoids are first scaled by ``reach`` about their centres.
    """
    direction = _random_directions(len(rows), generator)
    radius = reach * torch.rand(len(rows), 1, generator=generator, dtype=torch.float64) ** (1 / 3)
    local = geometry.scales.double()[rows] * direction * radius
    return geometry.means.double()[rows] + (geometry.rotations.double()[rows] @ local[:, :, None])[..., 0]


def _random_directions(count: int, generator: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)


def random_chords(geometry: Geometry, rows: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Draw M random rays; ray i starts outside the ellipsoid of primitive ``rows[i]`` and crosses the ellipsoid.

    Returns:
        origins (M, 3), directions (M, 3), and ray parameters (M,) of entry into and exit from the ellipsoid; float64.
    """
    point = conformance_points_inside(geometry, rows, generator)
    d = _random_directions(len(rows), generator)
    whiten = geometry.rotations.double()[rows].transpose(1, 2) / geometry.scales.double()[rows][:, :, None]
    y, v = ((whiten @ x[:, :, None])[..., 0] for x in (point - geometry.means.double()[rows], d))
    a, b = (v * v).sum(-1), (y * v).sum(-1)
    root = (b * b + a * (1 - (y * y).sum(-1))).sqrt()
    far = 3 * geometry.length_scale.double()[rows]
    return point - far[:, None] * d, d, far + (-b - root) / a, far + (-b + root) / a


# ---------------------------------------------------------------- activity, integrals and gradients


def check_activity_conformance(t: TaskUnderTest) -> None:
    """Check ``active_rows`` of the density field, which lists the primitives with density under a frame's conditions.

    The indices must be ascending int64 numbers. Primitives that are not listed must have zero density in the frame.
    """
    model = t.perturbed_model()
    generator = torch.Generator().manual_seed(3)
    params = model.of(model.density)
    for view in t.double_views:
        rows = model.density.active_rows(params, view.conditions)
        if rows is None:
            continue
        fine = rows.dtype == torch.int64 and bool((rows[1:] > rows[:-1]).all())
        t.require(fine, "density.active_rows", f"{rows.dtype} {rows.tolist()}", "ascending int64 rows")
        left_out = torch.ones(model.count, dtype=torch.bool).index_fill_(0, rows, False).nonzero()[:, 0]
        moved = model.density.move(params, model.geometry, view.conditions)
        points = conformance_points_inside(moved, left_out, generator)
        sigma = model.density.density(params, model.geometry, left_out, points, view.conditions)
        where = "density.active_rows: density of a primitive that it leaves out"
        t.require(not bool(sigma.any()), where, sigma.abs().max() if len(sigma) else 0, 0)


def check_integral_conformance(t: TaskUnderTest) -> None:
    """Check that the closed-form integrals of ``density.lower`` agree with quadrature of ``density.density``.

    Integrals are compared along chords (segments of rays inside an ellipsoid) and along parts of chords.
    """
    model = t.perturbed_model()
    generator = torch.Generator().manual_seed(4)
    count = 0
    with torch.no_grad():
        for view in t.double_views:
            active = model.active(view.conditions)
            geometry, form = model.lower_density(view.conditions)
            prim = torch.arange(geometry.count).repeat(_RAYS)
            if not len(prim):
                continue
            count += len(prim)
            o, d, t0, t1 = random_chords(geometry, prim, generator)
            middle = t0 + 0.4 * (t1 - t0)
            rays = [(o, d, t0, t1), (o, d, t0, middle), (o, d, middle, t1)]
            whole, first, second = (form.optical_depth(PrimitiveChords.of(geometry, prim, *ray)) for ray in rays)
            shape = tuple(whole.shape)
            t.require(shape == tuple(prim.shape), "density.lower: integral", f"shape {shape}", tuple(prim.shape))
            expected, peak = _integrate_under_test(active, prim, rays[0])
            for where, found, wanted in (
                ("chord", whole, expected),
                ("part of a chord", second, _integrate_under_test(active, prim, rays[2])[0]),
                ("chord in two parts", first + second, whole),
            ):
                error = (found - wanted).abs() / ((t1 - t0) * peak + 1e-30)
                i = int(error.argmax())
                row = int(_active_rows_under_test(active)[prim[i]])
                place = f"density.lower: integral of a {where}, primitive {row}, view {view.name}"
                t.require(bool((error <= 1e-5).all()), place, f"{float(found[i]):.6g}", f"{float(wanted[i]):.6g}")
    t.require(count > 0, "density.active_rows", "no primitive in any view", "some")


class _ShadingUnderTest(ColourField):
    """Colour field that wraps a model's colour field and computes its shading only once.

    Shading is a set of factors on colours, e.g. shadows, without gradient. It must not change with the parameters,
    because finite differences would include the change.
    """

    def __init__(self, model: Primitives, view: View) -> None:
        self.colour, self.channels = model.colour, model.colour.channels
        with torch.no_grad():
            lowered = model.lower_density(view.conditions)
            self.shading = self.colour.shade(*lowered, view.camera, view.conditions, RenderSettings())

    def parameters(self) -> list[ParameterSpec]:
        return self.colour.parameters()

    def settings(self) -> dict[str, Any]:
        return self.colour.settings()

    def shade(self, *_: Any) -> Shading | None:
        return self.shading

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Any:
        return self.colour.lower(params, geometry, camera, conditions)


def _leaf_parameters_under_test(model: Primitives) -> dict[str, Tensor]:
    """Replace the model's parameters by leaf tensors with ``requires_grad``, and return the leaf tensors."""
    model.params = {name: value.detach().clone().requires_grad_() for name, value in model.params.items()}
    return model.params


def _conformance_objective(model: Primitives, view: View, seed: int) -> Tensor:
    """Return a smooth scalar of the rendered view: a random weighted sum of colours, plus the squared alphas."""
    out = render(model, view.camera, view.conditions, EXACT)
    weight = torch.rand(out.rgb.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) + 0.5
    return (out.rgb * weight).sum() + out.alpha.square().sum()


def check_gradients_conformance(t: TaskUnderTest) -> None:
    """Check that every parameter has a gradient in some view, and that gradients agree with finite differences.

    The finite differences are computed in float64.
    """
    model = t.perturbed_model()
    params = _leaf_parameters_under_test(model)
    for i, view in enumerate(t.double_views):
        _conformance_objective(model, view, i).backward()
    for name, value in params.items():
        if value.numel():
            where = f"{t.lower_method(name)}gradient of {name}"
            t.require(value.grad is not None, where, "none: the image does not depend on it", "one")
            t.require_finite(where, value.grad)
            t.require(bool(value.grad.any()), where, "zero in all views", "other than zero")  # type: ignore[union-attr]
    for view in t.double_views[:2]:
        frozen = Primitives(model.density, _ShadingUnderTest(model, view), model.params)
        params = _leaf_parameters_under_test(frozen)
        _conformance_objective(frozen, view, 0).backward()
        for name, value in params.items():
            if value.numel():
                grad = torch.zeros_like(value) if value.grad is None else value.grad
                _compare_with_differences(t, frozen, view, name, grad.detach().reshape(-1))


def _compare_with_differences(t: TaskUnderTest, model: Primitives, view: View, name: str, grad: Tensor) -> None:
    leaves = model.params
    constants = {n: v.detach() for n, v in leaves.items()}

    def slope(entry: int, step: float) -> float:
        values = []
        for sign in (1.0, -1.0):
            changed = constants[name].clone()
            changed.reshape(-1)[entry] += sign * step
            model.params = {**constants, name: changed}
            with torch.no_grad():
                values.append(float(_conformance_objective(model, view, 0)))
        model.params = leaves
        return (values[0] - values[1]) / (2 * step)

    for entry in sorted({int(grad.abs().argmax()), len(grad) // 3}):
        found = float(grad[entry])
        slopes = [slope(entry, step) for step in _STEPS]
        tolerance = 1e-4 * float(grad.abs().max()) + 1e-7
        ok = any(abs(s - found) <= 1e-3 * max(abs(s), abs(found)) + tolerance for s in slopes)
        row = entry // max(len(grad) // model.count, 1)
        where = f"{t.lower_method(name)}gradient of {name}, primitive {row}, view {view.name}"
        t.require(ok, where, f"{found:.6g}", f"{slopes[-1]:.6g} by finite differences")


# ---------------------------------------------------------------- changes of the population


def check_scaling_conformance(t: TaskUnderTest) -> None:
    """Check that ``scale_density`` multiplies each primitive's density by a factor, and returns new tensors."""
    model = t.perturbed_model()
    factor = torch.linspace(0.25, 2.0, model.count, dtype=torch.float64)
    own = model.of(model.density)
    before = {name: value.clone() for name, value in own.items()}
    scaled = model.density.scale_density(own, factor)
    t.require_layout("density.scale_density", scaled, before)
    for name, value in own.items():
        same = torch.equal(value, before[name])
        t.require(same, f"density.scale_density: {name}", "changed in place", "a new tensor")
    with torch.no_grad():
        for i, view in enumerate(t.double_views):
            active = model.active(view.conditions)
            local = torch.arange(active.geometry.count).repeat(4)
            rows = _active_rows_under_test(active)[local]
            x = conformance_points_inside(active.geometry, local, torch.Generator().manual_seed(i))
            one, other = (model.density.density(p, model.geometry, rows, x, view.conditions) for p in (own, scaled))
            t.require_close("density.scale_density: density", other, one * factor[rows], rows)


def check_split_conformance(t: TaskUnderTest) -> None:
    """Check ``on_split``, which returns the parameters of two children that replace a primitive (their parent).

    Inside a child, the child's density must equal the parent's. If the field has ``exact_split=False``, the
    two children together must instead have the mass (integral of density) of the parent.
    """
    model = t.perturbed_model()
    old, parents, colours = model.geometry, model.of(model.density), model.of(model.colour)
    axis = torch.nn.functional.one_hot(old.log_scales.argmax(-1), 3).double()
    step = SPLIT_SHIFT * (old.rotations * (axis * old.scales)[:, None]).sum(-1)
    shrink = torch.where(axis > 0, SPLIT_LONG, SPLIT_OTHERS).double().log()
    children = []
    for sign in (1.0, -1.0):
        new = Geometry(old.means + sign * step, old.log_scales + shrink, old.quats)
        child = model.density.on_split(dict(parents), old, new)
        t.require_layout("density.on_split", child, parents)
        t.require_layout("colour.on_split", model.colour.on_split(dict(colours), old, new), colours)
        children.append((child, new))
    if not model.density.exact_split:
        _require_conforming_masses(t, model, children)
        return
    generator = torch.Generator().manual_seed(6)
    for view in t.double_views:
        rows = _active_rows_under_test(model.active(view.conditions)).repeat(4)
        for child, new in children:
            x = conformance_points_inside(model.density.move(child, new, view.conditions), rows, generator)
            found = model.density.density(child, new, rows, x, view.conditions)
            expected = model.density.density(parents, old, rows, x, view.conditions)
            t.require_close("density.on_split: density of a child inside it", found, expected, rows)


def _require_conforming_masses(
    t: TaskUnderTest, model: Primitives, children: list[tuple[dict[str, Tensor], Geometry]]
) -> None:
    """Require that two children together have the mass of their parent, the primitive that the children replace.

    The mass is the integral of |sigma|. The tolerance is larger for one pair of children than for the mean over all
    pairs, because sigma can vary within a primitive. ``children`` has two elements (parameters, ellipsoids): the first
    children of all primitives, and the second children.
    """
    view = t.double_views[0]
    ball = 2 * torch.rand(4000, 3, generator=torch.Generator().manual_seed(8), dtype=torch.float64) - 1
    ball = ball[ball.norm(dim=-1) < 1]

    def mass(params: dict[str, Tensor], geometry: Geometry) -> Tensor:
        result = []
        for n in range(geometry.count):
            x = geometry.means[n] + (ball * geometry.scales[n]) @ geometry.rotations[n].T
            sigma = model.density.density(params, geometry, torch.full((len(ball),), n), x, view.conditions)
            result.append(sigma.abs().mean() * geometry.scales[n].prod())
        return torch.stack(result)

    parents = mass(model.of(model.density), model.geometry)
    both = mass(*children[0]) + mass(*children[1])
    absent = (parents <= 0) & (both <= 0)
    change = torch.where(absent, torch.zeros_like(both), both / parents.clamp_min(1e-30) - 1)
    i, mean = int(change.abs().argmax()), float(change.mean())
    where = "density.on_split: mass of both children of"
    each = abs(float(change[i])) <= _MASS_EACH
    t.require(each, f"{where} primitive {i}", f"{float(both[i]):.4g}", f"{float(parents[i]):.4g}")
    t.require(abs(mean) <= _MASS_MEAN, f"{where} a primitive, on average", f"{1 + mean:.3f} times its parent's", 1)


def check_reductions_conformance(t: TaskUnderTest) -> None:
    """Check the reductions that density and colour fields offer: smaller values of a setting, e.g. of the SH degree.

    The task must list the class of a reduced field. The field must have fewer parameters and give finite images.
    """
    model = t.perturbed_model(torch.float32)
    for kind, field in (("density", model.density), ("colour", model.colour)):
        for name, values in field.reductions().items():
            where = f"{type(field).__name__}.reductions()[{name!r}]"
            fine = bool(values) and all(type(v) is int and v >= 0 for v in values)
            fine = fine and list(values) == sorted(set(values), reverse=True)
            t.require(fine, where, values, "whole numbers from 0, the largest first")
            for value in values:
                where = f"{type(field).__name__}.reduce({name!r}, {value})"
                less = reduce_model(model, kind, name, value)
                made = type(less.density if kind == "density" else less.colour)
                listed = made in (t.task.fields or {}).values()
                t.require(listed, where, made.__name__, "a field that TaskSpec.fields lists")
                count = less.parameters_per_primitive
                t.require(count < model.parameters_per_primitive, where, f"{count} numbers", "fewer")
                t.draw(where, less, t.views[0])

"""Checks of the mathematics: lowered forms, their integrals, and gradients."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from neuprim.conformance.integrals import Alive, by_quadrature, chords, inside, opaque_colour
from neuprim.conformance.subject import EXACT, Frozen, Subject, watched
from neuprim.core.cameras import Camera
from neuprim.core.data import View
from neuprim.core.model.fields import CustomDensity, LoweredColour, LoweredDensity
from neuprim.core.model.pairs import Pairs
from neuprim.core.model.primitives import Lowered, Primitives
from neuprim.core.render import render, render_lowered

__all__ = [
    "camera_at",
    "check_alive",
    "check_finite_differences",
    "check_gradients",
    "check_line_integral",
    "check_lowered_forms",
    "check_opaque_twin",
    "double",
]

_RAYS = 6  # per primitive
_STEPS = (1e-5, 1e-6)
"""Of the finite differences: a wrong gradient is wrong at both, a pixel that flips at a silhouette only at one."""


def double(view: View) -> View:
    """The view with camera and conditions in float64."""
    camera = replace(view.camera, viewmat=view.camera.viewmat.double())
    return replace(
        view,
        camera=camera,
        conditions={k: v.double() if v.is_floating_point() else v for k, v in view.conditions.items()},
    )


def check_lowered_forms(t: Subject) -> None:
    """Lowered tensors have one row per primitive, the shapes of their form, the data set's channels and the parameters'
    dtype."""
    for dtype in (torch.float32, torch.float64):
        model = t.model(dtype)
        for view in t.views()[:3]:
            lowered = model.lower(view.camera, view.conditions)  # which refuses what does not fit, by name
            _numbers(t, "density.lower", lowered.density, dtype)
            _numbers(t, "colour.lower", lowered.colour, dtype)
            declared = model.colour.channels
            t.require(declared == t.dataset.channels, "colour.channels", declared, str(t.dataset.channels))


def _numbers(t: Subject, where: str, form: LoweredDensity | LoweredColour, dtype: torch.dtype) -> None:
    """Dtype and values of a form's tensors; their shapes were checked as they were lowered."""
    for name, value in vars(form).items():
        if isinstance(value, Tensor):
            t.require(value.dtype == dtype, f"{where}: {name}", value.dtype, f"{dtype}, as the parameters")
            t.require(bool(torch.isfinite(value).all()), f"{where}: {name}", "NaN or infinity", "finite numbers")


def check_alive(t: Subject) -> None:
    """Primitives that ``alive`` leaves out of a frame absorb nothing in it, and rows come in ascending order."""
    model = t.model()
    generator = torch.Generator().manual_seed(3)
    params = model.of(model.density)
    for view in map(double, t.views()):
        rows = model.density.active_rows(params, view.conditions)
        if rows is None:
            continue
        fine = rows.dtype == torch.int64 and bool((rows[1:] > rows[:-1]).all())
        t.require(fine, "density.active_rows", f"{rows.dtype} {rows.tolist()}", "ascending int64 rows")
        left = torch.ones(model.count, dtype=torch.bool).index_fill_(0, rows, False).nonzero()[:, 0]
        moved = model.density.move(params, model.geometry, view.conditions)
        sigma = model.density.density(params, model.geometry, left, inside(moved, left, generator), view.conditions)
        worst = float(sigma.abs().max()) if len(left) else 0.0
        t.require(worst == 0.0, "density.active_rows: density of a primitive that it leaves out", f"{worst:g}", "0")


def check_line_integral(t: Subject) -> None:
    """Optical depths of the lowered form equal quadrature of ``density`` on whole chords and on pieces, and pieces add
    up to the whole."""
    model = t.model()
    generator = torch.Generator().manual_seed(4)
    tested = 0
    with torch.no_grad():
        for view in map(double, t.views()):
            alive = Alive.of(model, view.conditions)
            prim = torch.arange(len(alive.rows)).repeat(_RAYS)
            tested += len(prim)
            o, d, t0, t1 = chords(alive.moved, prim, generator)
            middle = t0 + 0.4 * (t1 - t0)
            whole = alive.form.optical_depth(Pairs.of(alive.moved, prim, o, d, t0, t1))
            t.require(
                tuple(whole.shape) == tuple(prim.shape),
                "density.lower: line integral",
                f"shape {tuple(whole.shape)}",
                str(tuple(prim.shape)),
            )
            parts = [
                alive.form.optical_depth(Pairs.of(alive.moved, prim, o, d, a, b))
                for a, b in ((t0, middle), (middle, t1))
            ]
            expected, peak = by_quadrature(model, alive, view.conditions, prim, o, d, t0, t1)
            piece, _ = by_quadrature(model, alive, view.conditions, prim, o, d, middle, t1)
            size = (t1 - t0) * peak + 1e-30
            for where, a, b in (
                ("density.lower: line integral of a chord", whole, expected),
                ("density.lower: line integral of a piece", parts[1], piece),
                ("density.lower: sum over two pieces of a chord", parts[0] + parts[1], whole),
            ):
                error = (a - b).abs() / size
                worst = int(error.argmax()) if len(error) else 0
                ok = bool((error <= 1e-5).all())
                if not ok:
                    place = f"{where}, primitive {int(alive.rows[prim[worst]])}, view {view.name}"
                    t.require(
                        False, place, f"{float(a[worst]):.6g}", f"{float(b[worst]):.6g}, the integral of density(...)"
                    )
    t.require(tested > 0, "density.active_rows", "no primitive in any view", "some")


def check_opaque_twin(t: Subject) -> None:
    """A frame looks the same when density and colour are handed over as plain code per ray: what lowers means what the
    field says."""
    model = t.model()
    seen = 0.0
    with torch.no_grad():
        for view in list(map(double, t.views()))[:3]:
            lowered = model.lower(view.camera, view.conditions)
            alive = Alive.of(model, view.conditions)

            def twin(
                prim: Tensor, o: Tensor, d: Tensor, t0: Tensor, t1: Tensor, alive: Alive = alive, view: View = view
            ) -> Tensor:
                return by_quadrature(model, alive, view.conditions, prim, o, d, t0, t1)[0]

            plain = Lowered(
                lowered.geometry, CustomDensity(twin), opaque_colour(lowered.colour, lowered.geometry), lowered.rows
            )
            a, b = (render_lowered(x, view.camera, EXACT) for x in (lowered, plain))
            seen = max(seen, float(a.alpha.max()))
            for what, x, y in (("density.lower: alpha", a.alpha, b.alpha), ("colour.lower: colour", a.rgb, b.rgb)):
                error = float((x - y).abs().max())
                t.require(error <= 1e-5, f"{what} of view {view.name}", f"a difference of {error:.3g}", "at most 1e-5")
    t.require(seen > 0.01, "frames of a fresh model", f"opacity of at most {seen:.2g}", "something to see")


# ---------------------------------------------------------------- gradients


def _objective(model: Primitives, views: list[View]) -> Tensor:
    """A smooth scalar that everything visible has a part in."""
    total = torch.zeros((), dtype=torch.float64)
    for i, view in enumerate(views):
        out = render(model, view.camera, view.conditions, EXACT)
        weight = torch.rand(out.rgb.shape, generator=torch.Generator().manual_seed(i), dtype=torch.float64) + 0.5
        total = total + (out.rgb * weight).sum() + out.alpha.square().sum()
    return total


def check_gradients(t: Subject) -> None:
    """Every parameter gets a gradient from some view, or training would never move it."""
    model = t.model()
    params = watched(model)
    _objective(model, list(map(double, t.views()))).backward()
    for name, value in params.items():
        if not value.numel():
            continue
        where = f"{t.lowering(name)}gradient of {name}"
        t.require(value.grad is not None, where, "none: the image does not depend on it", "one")
        assert value.grad is not None
        t.require(bool(torch.isfinite(value.grad).all()), where, "NaN or infinity", "finite numbers")
        t.require(float(value.grad.abs().max()) > 0, where, "zero in all views", "other than zero")


def check_finite_differences(t: Subject) -> None:
    """Autograd agrees with finite differences in float64 on a few entries of every parameter: a detached or wrong
    derivative shows here."""
    model = t.model()
    for view in list(map(double, t.views()))[:2]:
        frozen = Primitives(model.density, Frozen.of(model, view.conditions), model.params)
        params = watched(frozen)
        _objective(frozen, [view]).backward()
        for name, value in params.items():
            grad = value.grad if value.grad is not None else torch.zeros_like(value)
            if value.numel():
                _compare(t, frozen, view, name, grad.detach().reshape(-1))


def _compare(t: Subject, model: Primitives, view: View, name: str, grad: Tensor) -> None:
    kept = model.params
    plain = {n: v.detach() for n, v in kept.items()}
    size = float(grad.abs().max())

    def slope(entry: int, step: float) -> float:
        values = []
        for sign in (1.0, -1.0):
            changed = plain[name].clone()
            changed.reshape(-1)[entry] += sign * step
            model.params = {**plain, name: changed}
            with torch.no_grad():
                values.append(float(_objective(model, [view])))
        model.params = kept
        return (values[0] - values[1]) / (2 * step)

    for entry in sorted({int(grad.abs().argmax()), len(grad) // 3}):
        found = float(grad[entry])
        for step in _STEPS:
            expected = slope(entry, step)
            ok = abs(expected - found) <= 1e-3 * max(abs(expected), abs(found)) + 1e-4 * size + 1e-7
            if ok:
                break
        row = entry // max(len(grad) // model.count, 1)
        place = f"{t.lowering(name)}gradient of {name}, primitive {row}, view {view.name}"
        t.require(ok, place, f"{found:.6g}", f"{expected:.6g} by finite differences")


def camera_at(camera: Camera, position: Tensor, focal: float = 1.0) -> Camera:
    """The same camera somewhere else, with ``focal`` times its focal length."""
    view = camera.viewmat.double().clone()
    view[:3, 3] = -view[:3, :3] @ position.double()
    return replace(camera, viewmat=view, fx=camera.fx * focal, fy=camera.fy * focal)

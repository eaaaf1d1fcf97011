"""Checks of birth: clones and splits leave the picture alone."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.conformance.forms import double
from neuprim.conformance.integrals import Alive, inside
from neuprim.conformance.subject import EXACT, Subject
from neuprim.core.model.fields import Conditions
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import render
from neuprim.core.train.splitting import SPLIT_LONG, SPLIT_OTHERS, SPLIT_SHIFT

__all__ = ["check_clone", "check_divide", "check_on_split", "check_scale_density"]


def check_scale_density(t: Subject) -> None:
    """``scale_density`` multiplies sigma everywhere by its factor and leaves the tensors it was given alone; clones
    rely on it."""
    model = t.model()
    factor = torch.linspace(0.25, 2.0, model.count, dtype=torch.float64)
    own = model.of(model.density)
    kept = {name: value.clone() for name, value in own.items()}
    scaled = model.density.scale_density(own, factor)
    _same_tensors(t, "density.scale_density", scaled, kept)
    for name, value in own.items():
        t.require(torch.equal(value, kept[name]), f"density.scale_density: {name}", "changed in place", "a new tensor")
    for view in map(double, t.views()):
        prim, x = _points(model, view.conditions, 5)
        before, after = (model.density.density(p, model.geometry, prim, x, view.conditions) for p in (own, scaled))
        _close(t, "density.scale_density: density after it", after, before * factor[prim], prim)


def check_clone(t: Subject) -> None:
    """Two copies at half the density look like one, clamps and cut-offs aside: a clone must not change the picture."""
    model = t.model()
    half = {
        **model.params,
        **model.density.scale_density(model.of(model.density), torch.full((model.count,), 0.5, dtype=torch.float64)),
    }
    pair = {name: torch.cat([value, value]) for name, value in half.items()}
    twice = Primitives(model.density, model.colour, pair)
    with torch.no_grad():
        for view in map(double, t.views()):
            a, b = (render(m, view.camera, view.conditions, EXACT) for m in (model, twice))
            error = float((a.rgb - b.rgb).abs().max())
            # Two clamps at 0.9999 let less through than one.
            t.require(
                error <= 2e-4 * max(1.0, float(a.rgb.abs().max())),
                f"density.scale_density by a half, twice over: view {view.name}",
                f"a change of {error:.3g}",
                "none",
            )


def check_on_split(t: Subject) -> None:
    """Children continue their parent's sigma inside themselves, or where ``exact_split`` is False hold its mass: splits
    must not flicker."""
    model = t.model()
    old = model.geometry
    axis = torch.nn.functional.one_hot(old.log_scales.argmax(-1), 3).double()
    step = SPLIT_SHIFT * (old.rotations * (axis * old.scales)[:, None]).sum(-1)
    shrink = torch.where(axis > 0, SPLIT_LONG, SPLIT_OTHERS).double().log()
    parents = model.of(model.density)
    colours = model.of(model.colour)
    children = []
    for sign in (1.0, -1.0):
        new = Geometry(old.means + sign * step, old.log_scales + shrink, old.quats)
        child = model.density.on_split(dict(parents), old, new)
        _same_tensors(t, "density.on_split", child, parents)
        _same_tensors(t, "colour.on_split", model.colour.on_split(dict(colours), old, new), colours)
        children.append((child, new))
    if not model.density.exact_split:
        _mass(t, model, children)
        return
    generator = torch.Generator().manual_seed(6)
    for view in map(double, t.views()):
        rows = Alive.of(model, view.conditions).rows
        if not len(rows):
            continue
        prim = rows.repeat(4)
        for child, new in children:
            now = model.density.move(child, new, view.conditions)
            x = inside(now, prim, generator)
            found = model.density.density(child, new, prim, x, view.conditions)
            expected = model.density.density(parents, old, prim, x, view.conditions)
            _close(t, "density.on_split: density of a child inside it", found, expected, prim)


_EACH, _MEAN = 0.25, 0.05
"""What the mass of one pair of children may be off by, as a part of their parent's, and what all may be on average."""


def _mass(t: Subject, model: Primitives, children: list[tuple[dict[str, Tensor], Geometry]]) -> None:
    """Integrals of |sigma| over the ellipsoids, by the same points in every one of them.

    A density that varies within a primitive goes on as it is in the children, whose supports see other parts of it. So
    a pair may be off; all of them on average may not.
    """
    view = double(t.views()[0])
    generator = torch.Generator().manual_seed(8)
    ball = 2 * torch.rand(4000, 3, generator=generator, dtype=torch.float64) - 1
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
    change = torch.where(
        (parents > 0) | (both > 0), both / parents.clamp_min(1e-30) - 1, torch.zeros_like(both)
    )  # some are not there now
    worst = int(change.abs().argmax())
    where = "density.on_split: mass of both children of"
    t.require(
        float(change.abs().max()) <= _EACH,
        f"{where} primitive {worst}",
        f"{float(both[worst]):.4g}",
        f"{float(parents[worst]):.4g}",
    )
    mean = float(change.mean())
    t.require(
        abs(mean) <= _MEAN,
        f"{where} a primitive, on average",
        f"{1 + mean:.3f} times its parent's",
        f"1, within {_MEAN}",
    )


def check_divide(t: Subject) -> None:
    """``divide`` names parents in a mask and returns two rows for every one, all first halves first, in the parents'
    shapes."""
    model = t.model(torch.float32)
    divided = model.density.divide(model.of(model.density), model.geometry)
    if divided is None:
        return
    chosen, halves, place = divided
    n = model.count
    t.require(
        chosen.dtype == torch.bool and tuple(chosen.shape) == (n,),
        "density.divide: mask",
        f"{chosen.dtype} {tuple(chosen.shape)}",
        f"bool ({n},)",
    )
    t.require(place.count == 2 * n, "density.divide: geometry", f"{place.count} rows", f"{2 * n}")
    _same_tensors(t, "density.divide", halves, {k: torch.cat([v, v]) for k, v in model.of(model.density).items()})


# ---------------------------------------------------------------- parts


def _same_tensors(t: Subject, where: str, found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    t.require(set(found) == set(expected), where, f"tensors {sorted(found)}", f"{sorted(expected)}")
    for name, value in expected.items():
        now = found[name]
        same = now.shape == value.shape and now.dtype == value.dtype
        t.require(same, f"{where}: {name}", f"{now.dtype} {tuple(now.shape)}", f"{value.dtype} {tuple(value.shape)}")
        t.require(bool(torch.isfinite(now).all()), f"{where}: {name}", "NaN or infinity", "finite numbers")


def _points(model: Primitives, conditions: Conditions, seed: int) -> tuple[Tensor, Tensor]:
    alive = Alive.of(model, conditions)
    local = torch.arange(len(alive.rows)).repeat(4)
    return alive.rows[local], inside(alive.moved, local, torch.Generator().manual_seed(seed))


def _close(t: Subject, where: str, found: Tensor, expected: Tensor, prim: Tensor) -> None:
    if not len(prim):
        return
    error = (found - expected).abs() / expected.abs().max().clamp_min(1e-30)
    worst = int(error.argmax())
    t.require(
        float(error.max()) <= 1e-6,
        f"{where}, primitive {int(prim[worst])}",
        f"{float(found[worst]):.6g}",
        f"{float(expected[worst]):.6g}",
    )

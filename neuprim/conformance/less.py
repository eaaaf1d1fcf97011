"""Checks of what a task's fields say that they, or single primitives, can do without."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from neuprim.conformance.subject import Subject
from neuprim.core.model.fields import Field, prunable_units_by_name
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import PrunableUnit, nonzero_rows, zero_units
from neuprim.core.model.reduction import reduce_model

__all__ = ["check_pieces", "check_reductions"]


def check_reductions(t: Subject) -> None:
    """A field that can do with less of something becomes a field of the task that has less, is rebuilt from its
    settings and draws, so that models can be pruned and tried smaller."""
    model = t.model(torch.float32)
    for kind, own in (("density", model.density), ("colour", model.colour)):
        for name, values in own.reductions().items():
            where = f"{type(own).__name__}.reductions()[{name!r}]"
            whole = all(isinstance(v, int) and not isinstance(v, bool) and v >= 0 for v in values)
            t.require(bool(values) and whole, where, values, "whole numbers from 0")
            t.require(list(values) == sorted(set(values), reverse=True), where, values, "the largest first, each once")
            for value in values:
                _smaller(t, model, kind, own, name, value)


def _smaller(t: Subject, model: Primitives, kind: str, own: Field, name: str, value: int) -> None:
    where = f"{type(own).__name__}.reduce({name!r}, {value})"
    try:
        less = reduce_model(model, kind, name, value)
    except (ValueError, AssertionError) as error:
        t.require(
            False, where, f"tensors or a field that do not fit ({error})", "a field of the same kind and its tensors"
        )
        raise
    field = less.density if kind == "density" else less.colour
    t.require(
        type(field) in (t.task.fields or {}).values(), where, type(field).__name__, "a field that TaskSpec.fields lists"
    )
    again = type(field)(**field.settings())
    same = [(s.name, s.shape) for s in again.parameters()] == [(s.name, s.shape) for s in field.parameters()]
    t.require(same, f"{where}.settings()", "other parameters", "settings that rebuild it")
    t.require(
        less.parameters_per_primitive < model.parameters_per_primitive,
        where,
        f"{less.parameters_per_primitive} numbers",
        "fewer",
    )
    for view in t.views()[:2]:
        t.image(f"{where}: image", less, view)


def check_pieces(t: Subject) -> None:
    """A piece names numbers that exist, no number is in two of them, and without it a primitive still draws, so that
    pruning may leave it out of files."""
    model = t.model(torch.float32)
    for own in (model.density, model.colour):
        names = [piece.name for piece in own.prunable_units()]
        t.require(
            len(set(names)) == len(names), f"{type(own).__name__}.prunable_units()", names, "names that are there once"
        )
    pieces = prunable_units_by_name(model.density, model.colour)
    taken = {name: torch.zeros_like(value, dtype=torch.bool) for name, value in model.params.items()}
    drawn: set[str] = set()
    for name, piece in pieces.items():
        _place(t, model.params, taken, name, piece)
        gone = torch.arange(model.count) % 2 == 0
        less = Primitives(model.density, model.colour, zero_units({name: (piece, gone)}, model.params))
        t.require(
            bool((nonzero_rows(piece, less.params) == ~gone).all()),
            f"piece {name!r}",
            "numbers that stay",
            "zeros where it is gone",
        )
        if (
            piece.group not in drawn
        ):  # of pieces that are told of together, such as the coefficients of a band, one is drawn
            for view in t.views()[:2]:
                t.image(f"image without {name!r}", less, view)
        drawn |= {piece.group} - {""}


def _place(t: Subject, params: Mapping[str, Any], taken: dict[str, Any], name: str, piece: PrunableUnit) -> None:
    t.require(bool(piece.places), f"piece {name!r}", "no numbers", "some")
    for parameter, place in piece.places.items():
        where = f"piece {name!r}: {parameter}"
        t.require(parameter in params, where, "no such parameter", f"one of {', '.join(params)}")
        try:
            before = taken[parameter][(slice(None), *place)]
        except (IndexError, TypeError) as error:
            t.require(
                False,
                where,
                f"a place {place} that it does not have ({error})",
                f"one within {tuple(params[parameter].shape[1:])}",
            )
            raise
        t.require(before.numel() > 0, where, f"an empty place {place}", "numbers")
        t.require(not bool(before.any()), where, "numbers of another piece", "each number in one piece")
        taken[parameter][(slice(None), *place)] = True

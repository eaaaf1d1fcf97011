"""Which primitives, pieces of primitives and parts of fields go: what is worth least for its bytes first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.core.model.fields import prunable_units_by_name
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import PrunableUnit, count_numbers, nonzero_rows, zero_units
from neuprim.core.model.reduction import reduce_model
from neuprim.core.train.sensitivity import Sensitivity
from neuprim.search.prune.judge import Judge

__all__ = ["cut_to", "numbers", "priced", "steps_down", "zeros_of"]

_CONTRAST = 0.05
"""Mean square of a primitive's difference of colour from what is behind it, to begin with; :func:`priced` measures
it."""

_PROBE = 0.02
"""Share of the primitives whose removal tells the contrast."""

_HALVINGS = 14


def _pieces(model: Primitives) -> dict[str, PrunableUnit]:
    return prunable_units_by_name(model.density, model.colour)


def numbers(model: Primitives) -> int:
    """Numbers that a file has to hold: all but the pieces that are zero."""
    left_out = sum(
        count_numbers(piece, model.params) * int((~nonzero_rows(piece, model.params)).sum())
        for piece in _pieces(model).values()
    )
    return model.count * model.parameters_per_primitive - left_out


def zeros_of(model: Primitives) -> dict[str, Tensor]:
    """Parameter -> (N, ...) bool of the numbers in pieces that are zero."""
    found: dict[str, Tensor] = {}
    for piece in _pieces(model).values():
        gone = ~nonzero_rows(piece, model.params)
        if bool(gone.any()):
            for name, place in piece.places.items():
                mask = found.setdefault(name, torch.zeros_like(model.params[name], dtype=torch.bool))
                mask[(gone, *place)] = True
    return found


def steps_down(model: Primitives) -> list[tuple[str, str, int]]:
    """(kind, name, value) of all that the whole model could have less of, what saves most first."""
    fields = (("density", model.density), ("colour", model.colour))
    words = [
        (kind, name, value) for kind, own in fields for name, values in own.reductions().items() for value in values
    ]
    return sorted(words, key=lambda word: reduce_model(model, *word).parameters_per_primitive)


def cut_to(model: Primitives, prices: Sensitivity, quality: Callable[[Primitives], float], loss: float) -> Primitives:
    """The model without whatever is worth less than some price per number, the price being what loses ``loss`` dB now.

    Args:
        prices: of this model, see :func:`priced`.
        quality: dB of a model on a few views.
    """
    start = quality(model)
    share = _share(model)
    low, high = 0.0, _dearest(prices, share)
    best = _at(model, prices, share, 0.0)
    for _ in range(_HALVINGS):
        price = (max(low, high * 1e-9) * high) ** 0.5
        tried = _at(model, prices, share, price)
        if tried.count and start - quality(tried) <= loss:
            best, low = tried, price
        else:
            high = price
    return best


def priced(model: Primitives, views: Sensitivity, inside: Sensitivity | None, judge: Judge) -> Sensitivity:
    """Mean squared changes of the views without each primitive and piece, for the differences of colour that there are;
    what changes inside counts as much as it is of the error inside, beside that of the views."""
    whole = views.whole * _contrast(model, views, lambda m: judge.images(m, quick=True))
    found = replace(views, whole=whole)
    return found if inside is None else found.beside(inside, judge.apart(model))


_Share = tuple[Tensor, dict[str, Tensor], dict[str, int]]


def _share(model: Primitives) -> _Share:
    """(N,) numbers of each primitive that are not zero, and for each piece who has it and how many numbers it is."""
    pieces = _pieces(model)
    there = {name: nonzero_rows(piece, model.params).cpu() for name, piece in pieces.items()}
    sizes = {name: count_numbers(piece, model.params) for name, piece in pieces.items()}
    own = torch.full((model.count,), float(model.parameters_per_primitive))
    for name, has in there.items():
        own -= sizes[name] * (~has).float()
    return own, there, sizes


def _at(model: Primitives, prices: Sensitivity, share: _Share, price: float) -> Primitives:
    own, there, sizes = share
    known = prices.seen > 0
    kept = (~known | (prices.whole / own >= price)).nonzero()[:, 0]
    pieces = _pieces(model)
    gone = {
        name: (pieces[name], (prices.pieces[name] / max(sizes[name], 1) < price) & there[name] & known)
        for name in pieces
    }
    rows = Primitives(model.density, model.colour, zero_units(gone, model.params)).rows(kept.to(model.device))
    return Primitives(model.density, model.colour, rows)


def _dearest(prices: Sensitivity, share: _Share) -> float:
    own, _, sizes = share
    dear = [prices.whole / own, *(prices.pieces[name] / max(size, 1) for name, size in sizes.items())]
    return max(1e-30, *(float(each.max()) for each in dear if len(each)))


def _contrast(model: Primitives, effects: Sensitivity, quality: Callable[[Primitives], float]) -> float:
    """Mean squared difference of colour, from what removing the least primitives costs."""
    count = max(int(_PROBE * model.count), 1)
    order = effects.whole.where(effects.seen > 0, torch.inf).argsort(stable=True)
    kept = order[count:].sort().values
    if not len(kept):
        return _CONTRAST
    start, found = quality(model), quality(Primitives(model.density, model.colour, model.rows(kept.to(model.device))))
    more = 10 ** (-found / 10) - 10 ** (-start / 10)
    expected = float(effects.whole[order[:count]].sum())
    return min(max(more / expected, 1e-4), 1.0) if expected > 0 and more > 0 else _CONTRAST

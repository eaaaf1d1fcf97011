"""Which primitives, pieces of primitives and parts of fields go: what is worth least for its bytes first."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from neuprim.core.model.fields import pieces_by_name
from neuprim.core.model.less import with_less
from neuprim.core.model.pieces import Piece, alive, numbers_of, without
from neuprim.core.model.primitives import Primitives
from neuprim.core.train.sensitivity import Sensitivity

__all__ = ["cut_to", "numbers", "steps_down", "zeros_of"]

_CONTRAST = 0.05
"""Mean square of a primitive's difference of colour from what is behind it, to begin with; :func:`cut_to` measures it."""

_PROBE = 0.02
"""Share of the primitives whose removal tells the contrast."""

_HALVINGS = 14


def _pieces(model: Primitives) -> dict[str, Piece]:
    return pieces_by_name(model.density, model.colour)


def numbers(model: Primitives) -> int:
    """Numbers that a file has to hold: all but the pieces that are zero."""
    left_out = sum(numbers_of(piece, model.params) * int((~alive(piece, model.params)).sum()) for piece in _pieces(model).values())
    return model.count * model.parameters_per_primitive - left_out


def zeros_of(model: Primitives) -> dict[str, Tensor]:
    """Parameter -> (N, ...) bool of the numbers in pieces that are zero."""
    found: dict[str, Tensor] = {}
    for piece in _pieces(model).values():
        gone = ~alive(piece, model.params)
        if bool(gone.any()):
            for name, place in piece.places.items():
                mask = found.setdefault(name, torch.zeros_like(model.params[name], dtype=torch.bool))
                mask[(gone, *place)] = True
    return found


def steps_down(model: Primitives) -> list[tuple[str, str, int]]:
    """(kind, name, value) of all that the whole model could have less of, what saves most first."""
    fields = (("density", model.density), ("colour", model.colour))
    words = [(kind, name, value) for kind, own in fields for name, values in own.reductions().items() for value in values]
    return sorted(words, key=lambda word: with_less(model, *word).parameters_per_primitive)


def cut_to(model: Primitives, effects: Sensitivity, quality: Callable[[Primitives], float], loss: float) -> Primitives:
    """The model without whatever is worth less than some price per number, the price being what loses ``loss`` dB now.

    Args:
        effects: of this model.
        quality: dB of a model on a few views.
    """
    start = quality(model)
    contrast = _contrast(model, effects, quality, start)
    low, high = 0.0, _dearest(model, effects, contrast)
    best = _at(model, effects, contrast, 0.0)
    for _ in range(_HALVINGS):
        price = (max(low, high * 1e-9) * high) ** 0.5
        tried = _at(model, effects, contrast, price)
        if tried.count and start - quality(tried) <= loss:
            best, low = tried, price
        else:
            high = price
    return best


def _share(model: Primitives) -> tuple[Tensor, dict[str, Tensor], dict[str, int]]:
    """(N,) numbers of each primitive that are not zero, and for each piece who has it and how many numbers it is."""
    pieces = _pieces(model)
    there = {name: alive(piece, model.params).cpu() for name, piece in pieces.items()}
    sizes = {name: numbers_of(piece, model.params) for name, piece in pieces.items()}
    own = torch.full((model.count,), float(model.parameters_per_primitive))
    for name, has in there.items():
        own -= sizes[name] * (~has).float()
    return own, there, sizes


def _at(model: Primitives, effects: Sensitivity, contrast: float, price: float) -> Primitives:
    own, there, sizes = _share(model)
    kept = (effects.whole * contrast / own >= price).nonzero()[:, 0]
    pieces = _pieces(model)
    gone = {name: (pieces[name], (effects.pieces[name] / max(sizes[name], 1) < price) & there[name]) for name in pieces}
    rows = Primitives(model.density, model.colour, without(gone, model.params)).rows(kept.to(model.device))
    return Primitives(model.density, model.colour, rows)


def _dearest(model: Primitives, effects: Sensitivity, contrast: float) -> float:
    own, _, sizes = _share(model)
    dear = [effects.whole * contrast / own, *(effects.pieces[name] / max(size, 1) for name, size in sizes.items())]
    return max(1e-30, *(float(prices.max()) for prices in dear if len(prices)))


def _contrast(model: Primitives, effects: Sensitivity, quality: Callable[[Primitives], float], start: float) -> float:
    """Mean squared difference of colour, from what removing the least primitives costs."""
    count = max(int(_PROBE * model.count), 1)
    order = effects.whole.argsort(stable=True)
    kept = order[count:].sort().values
    if not len(kept):
        return _CONTRAST
    found = quality(Primitives(model.density, model.colour, model.rows(kept.to(model.device))))
    more = 10 ** (-found / 10) - 10 ** (-start / 10)
    expected = float(effects.whole[order[:count]].sum())
    return min(max(more / expected, 1e-4), 1.0) if expected > 0 and more > 0 else _CONTRAST

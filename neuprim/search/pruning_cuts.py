"""Choose what pruning removes: the parts of a model with the least effect on images per parameter value.

Parts are primitives, units (e.g. a neuron in one primitive), and settings of whole fields (e.g. the highest degree).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.core.model.fields import prunable_units_of_model
from neuprim.core.model.primitives import Primitives, reduce_model
from neuprim.core.model.prunable import PrunableUnit, count_unit_numbers, primitives_with_unit, zero_units
from neuprim.core.train.sensitivity import Sensitivity
from neuprim.search.model_quality import SearchQuality

_CONTRAST = 0.05
"""Assumed mean squared difference between a primitive's colour and the colour behind it, if it cannot be measured."""

_PROBE = 0.02  # share of the primitives whose removal measures the contrast

_HALVINGS = 14


def _units(model: Primitives) -> dict[str, PrunableUnit]:
    return prunable_units_of_model(model.density, model.colour)


def count_unpruned_numbers(model: Primitives) -> int:
    """Return how many parameter values a file of the model stores: all except units (e.g. neurons) that are zero."""
    zeros = sum(
        count_unit_numbers(unit, model.params) * int((~primitives_with_unit(unit, model.params)).sum())
        for unit in _units(model).values()
    )
    return model.count * model.parameters_per_primitive - zeros


def mask_pruned_numbers(model: Primitives) -> dict[str, Tensor]:
    """Return parameter name -> (N, ...) bool mask, true for values of units that pruning has set to zero."""
    masks: dict[str, Tensor] = {}
    for unit in _units(model).values():
        gone = ~primitives_with_unit(unit, model.params)
        if bool(gone.any()):
            for name, place in unit.places.items():
                mask = masks.setdefault(name, torch.zeros_like(model.params[name], dtype=torch.bool))
                mask[(gone, *place)] = True
    return masks


def list_pruning_reductions(model: Primitives) -> list[tuple[str, str, int]]:
    """Return all reductions of the fields as (field, setting, smaller value), e.g. ("colour", "degree", 1).

    The reduction that saves most parameters is first.
    """
    fields = (("density", model.density), ("colour", model.colour))
    words = [
        (kind, name, value) for kind, own in fields for name, values in own.reductions().items() for value in values
    ]
    return sorted(words, key=lambda word: reduce_model(model, *word).parameters_per_primitive)


def price_cuts(
    model: Primitives, views: Sensitivity, inside: Sensitivity | None, quality: SearchQuality
) -> Sensitivity:
    """Return the effect of removing each primitive and each unit (e.g. a neuron in one primitive).

    The effect is the mean squared change of images. ``views`` has the sensitivity of images. ``inside`` has the
    sensitivity of the extinction; if it is given, the weighted squared change of the extinction is added.
    """
    priced = replace(views, whole=views.whole * _measure_contrast(model, views, quality))
    return priced if inside is None else priced.combine(inside, quality.inside_weight(model))


def _measure_contrast(model: Primitives, effects: Sensitivity, quality: SearchQuality) -> float:
    """Return the mean squared difference between primitives' colours and the colours behind them.

    This contrast is measured by removing a few primitives with the least effect.
    """
    count = max(int(_PROBE * model.count), 1)
    order = effects.whole.where(effects.seen > 0, torch.inf).argsort(stable=True)
    kept = order[count:].sort().values
    if not len(kept):
        return _CONTRAST
    smaller = Primitives(model.density, model.colour, model.rows(kept.to(model.device)))
    before, after = (quality.image_quality(one, quick=True) for one in (model, smaller))
    more = 10 ** (-after / 10) - 10 ** (-before / 10)
    expected = float(effects.whole[order[:count]].sum())
    return min(max(more / expected, 1e-4), 1.0) if expected > 0 and more > 0 else _CONTRAST


def cut_to_loss(
    model: Primitives, prices: Sensitivity, quality: Callable[[Primitives], float], loss: float
) -> Primitives:
    """Return a model without the primitives and units of least effect per parameter value.

    The quality of the model drops by at most ``loss`` dB.

    Args:
        prices: effect of every primitive and unit on images, see :func:`price_cuts`.
        quality: function that returns the quality of a model, dB.
    """
    units = _units(model)
    present = {name: primitives_with_unit(unit, model.params).cpu() for name, unit in units.items()}
    numbers = {name: count_unit_numbers(unit, model.params) for name, unit in units.items()}
    values = torch.full((model.count,), float(model.parameters_per_primitive))  # without units removed before
    for name, has in present.items():
        values -= numbers[name] * (~has).float()
    whole = prices.whole / values
    pieces = {name: prices.pieces[name] / max(size, 1) for name, size in numbers.items()}
    known = prices.seen > 0  # nothing is known of primitives in no view

    def prune_below(price: float) -> Primitives:
        """Return the model without primitives and units whose effect per parameter value is below ``price``."""
        kept = (~known | (whole >= price)).nonzero()[:, 0]
        gone = {name: (unit, (pieces[name] < price) & present[name] & known) for name, unit in units.items()}
        rows = Primitives(model.density, model.colour, zero_units(gone, model.params)).rows(kept.to(model.device))
        return Primitives(model.density, model.colour, rows)

    low, high = 0.0, max(1e-30, *(float(each.max()) for each in (whole, *pieces.values()) if len(each)))
    start, best = quality(model), prune_below(0.0)
    for _ in range(_HALVINGS):
        price = (max(low, high * 1e-9) * high) ** 0.5
        tried = prune_below(price)
        if tried.count and start - quality(tried) <= loss:
            best, low = tried, price
        else:
            high = price
    return best

"""Which pieces of its primitives a model kept, as pruning left it."""

from __future__ import annotations

from neuprim.core.model.fields import prunable_units_by_name
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import count_numbers, nonzero_rows

PRUNED = "pruned.json"
"""Of the directory of a pruned model: how it came to be."""


def kept_shares(model: Primitives) -> dict[str, float]:
    """Group of pieces -> share of its numbers that are kept, 0 to 1, as ``density.neuron 0`` and ``colour.band 1``."""
    kept: dict[str, float] = {}
    sizes: dict[str, int] = {}
    for name, piece in prunable_units_by_name(model.density, model.colour).items():
        group = f"{name.partition('.')[0]}.{piece.group or piece.name}"
        own = count_numbers(piece, model.params)
        share = float(nonzero_rows(piece, model.params).float().mean()) if model.count else 0.0
        kept[group], sizes[group] = kept.get(group, 0.0) + own * share, sizes.get(group, 0) + own
    return {group: value / sizes[group] for group, value in kept.items()}


def describe_kept_shares(kept: dict[str, float]) -> list[str]:
    """A line for every group of pieces that is not whole."""
    return [f"{name}: {share:.0%} of its numbers are kept" for name, share in kept.items() if share < 1]

"""Which pieces of its primitives a model kept, as pruning left it."""

from __future__ import annotations

from neuprim.core.model.fields import pieces_by_name
from neuprim.core.model.pieces import alive
from neuprim.core.model.primitives import Primitives

__all__ = ["PRUNED", "kept_pieces", "kept_words"]

PRUNED = "pruned.json"
"""Of the directory of a pruned model: how it came to be."""


def kept_pieces(model: Primitives) -> dict[str, float]:
    """Piece -> share of the primitives that have it."""
    pieces = pieces_by_name(model.density, model.colour)
    return {name: float(alive(piece, model.params).float().mean()) if model.count else 0.0 for name, piece in pieces.items()}


def kept_words(kept: dict[str, float]) -> list[str]:
    """A line for every piece that some primitives do without."""
    return [f"{name}: kept by {share:.0%} of the primitives" for name, share in kept.items() if share < 1]

"""What a kernel is compiled for."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Form"]


@dataclass(frozen=True)
class Form:
    """Neurons K, the edge's exponent p and channels C of a frame; hidden units H of its colour network, -1 where
    colours are constant."""

    neurons: int
    edge: int
    channels: int
    hidden: int = -1

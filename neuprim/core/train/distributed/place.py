"""Which of several processes this one is, from the environment that torchrun makes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from neuprim.core.errors import ConfigError

__all__ = ["Place", "place_of"]

NUMBERS = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
ALL = (*NUMBERS, "MASTER_ADDR", "MASTER_PORT")
TELLING = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
"""Any of these says that somebody launches several processes; an address alone is often set for a whole machine."""


@dataclass(frozen=True)
class Place:
    """A process among those of one training.

    Attributes:
        rank, size: its number, and how many there are on all machines.
        local_rank, local_size: the same among those of this machine.
        address: host and port where they meet.
    """

    rank: int
    size: int
    local_rank: int
    local_size: int
    address: str

    @property
    def local_first(self) -> int:
        """Rank of the first process on this machine; torchrun numbers machine by machine."""
        return self.rank - self.local_rank


def place_of(environment: Mapping[str, str] = os.environ) -> Place | None:
    """This process's place; None where nobody launched several.

    Raises:
        ConfigError: the environment has some of torchrun's variables, or values that cannot be.
    """
    if not any(name in environment for name in TELLING):
        return None
    there = [name for name in ALL if environment.get(name, "") != ""]
    missing = [name for name in ALL if name not in there]
    if missing:
        raise ConfigError(
            f"environment: {', '.join(there)} without {', '.join(missing)}; expected all that torchrun sets, or none"
        )
    values = {}
    for name in NUMBERS:
        text = environment[name]
        if not text.isascii() or not text.isdigit():
            raise ConfigError(f"environment: {name}={text}: expected a whole number, as torchrun sets it")
        values[name] = int(text)
    rank, size, local_rank, local_size = values.values()
    for name, value, most in (("RANK", rank, size), ("LOCAL_RANK", local_rank, local_size)):
        if value >= most:
            whole = "WORLD_SIZE" if name == "RANK" else "LOCAL_WORLD_SIZE"
            raise ConfigError(f"environment: {name}={value} with {whole}={most}: expected less")
    if local_size > size or local_rank > rank:
        raise ConfigError(
            f"environment: rank {rank} of {size} is {local_rank} of {local_size} on this machine: expected no more there than in all"
        )
    place = Place(rank, size, local_rank, local_size, f"{environment['MASTER_ADDR']}:{environment['MASTER_PORT']}")
    return place if size > 1 else None

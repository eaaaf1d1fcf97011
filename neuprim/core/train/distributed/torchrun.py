"""Read from the environment which of the processes of torchrun this one is."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from neuprim.core.errors import ConfigError

_NUMBERS = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
_VARIABLES = (*_NUMBERS, "MASTER_ADDR", "MASTER_PORT")


@dataclass(frozen=True)
class TorchrunRank:
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


def read_torchrun_rank(environment: Mapping[str, str] = os.environ) -> TorchrunRank | None:
    """Return this process's rank; None for a process that works alone.

    Raises:
        ConfigError: the environment has some of torchrun's variables, or values that cannot be.
    """
    # an address alone does not count: it is often set for a whole machine
    if not any(name in environment for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK")):
        return None
    present = [name for name in _VARIABLES if environment.get(name, "") != ""]
    missing = [name for name in _VARIABLES if name not in present]
    if missing:
        raise ConfigError(
            f"environment: {', '.join(present)} without {', '.join(missing)}; expected all that torchrun sets, or none"
        )
    values = {}
    for name in _NUMBERS:
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
            f"environment: rank {rank} of {size} is {local_rank} of {local_size} on this machine: expected no more "
            f"there than in all"
        )
    found = TorchrunRank(
        rank, size, local_rank, local_size, f"{environment['MASTER_ADDR']}:{environment['MASTER_PORT']}"
    )
    return found if size > 1 else None

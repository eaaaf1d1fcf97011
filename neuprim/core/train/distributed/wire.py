"""The way between ranks: torch.distributed, gloo for the processor's memory and NCCL for a card's."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed.rendezvous import rendezvous

from neuprim.core.errors import ConfigError, RankError
from neuprim.core.train.distributed.place import Place

__all__ = ["Wire"]

MEETING = timedelta(minutes=5)
"""How long ranks wait for the last to start."""

PATIENCE = timedelta(hours=1)
"""How long a rank waits for another that lives, as one that measures held-out views does."""


class Wire:
    """Ranks that have met.

    Attributes:
        store: a table of short texts that all of them read and write.
        hosted: whether the store lives in rank 0 instead of in torchrun.
    """

    def __init__(self, place: Place, environment: Any) -> None:
        self.hosted = environment.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
        backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and dist.is_nccl_available() else "gloo"
        try:
            store, _, _ = next(iter(rendezvous("env://", place.rank, place.size, timeout=MEETING)))
            attempt = environment.get("TORCHELASTIC_RESTART_COUNT", "0")
            self.store = dist.PrefixStore(f"neuprim/{attempt}", store)
            dist.init_process_group(
                backend,
                store=dist.PrefixStore("group", self.store),
                rank=place.rank,
                world_size=place.size,
                timeout=PATIENCE,
            )
        except (RuntimeError, ValueError, OSError) as error:
            raise ConfigError(
                f"rank {place.rank} of {place.size} cannot meet the others at {place.address} ({' '.join(str(error).split())[:200]})"
            ) from error

    def swap(self, rows: Tensor, found: Tensor) -> None:
        """Send (R, n) rows, one to each rank, and find (R, n) rows, one from each.

        Raises:
            RankError: a rank is gone; without its name.
        """
        try:
            dist.all_to_all_single(found, rows)
        except RuntimeError as error:  # of gloo: a closed connection, or nothing for too long
            raise _broken(error) from error

    def exchange(self, rows: Tensor, found: Tensor, give: list[int], take: list[int]) -> None:
        """Send ``give[r]`` of the rows (sum of give, ...) to rank r, in their order, and find ``take[r]`` from each, by
        rank.

        Raises:
            RankError: a rank is gone; without its name.
        """
        try:
            dist.all_to_all_single(found, rows, take, give)
        except RuntimeError as error:
            raise _broken(error) from error

    def close(self) -> None:
        """Leave."""
        if dist.is_initialized():
            dist.destroy_process_group()


def _broken(error: RuntimeError) -> RankError:
    return RankError(f"the connection between ranks broke ({' '.join(str(error).split())[:200]})")

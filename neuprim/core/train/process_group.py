"""Communication between the ranks (processes) of a training by torch.distributed: gloo on the CPU, NCCL on GPUs."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed.rendezvous import rendezvous

from neuprim.core.errors import ConfigError, RankError

_NUMBERS = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
_VARIABLES = (*_NUMBERS, "MASTER_ADDR", "MASTER_PORT")


@dataclass(frozen=True)
class TorchrunRank:
    """Rank of this process among the processes that torchrun started.

    Attributes:
        rank, size: index of this process, from 0, and number of processes on all machines.
        local_rank, local_size: index and number that count only the processes on this machine.
        address: host and port where the processes connect.
    """

    rank: int
    size: int
    local_rank: int
    local_size: int
    address: str


def read_torchrun_rank(environment: Mapping[str, str] = os.environ) -> TorchrunRank | None:
    """Return the rank of this process from torchrun's environment variables; None for a single process.

    Raises:
        ConfigError: only some of torchrun's variables are set, or values are invalid.
    """
    # an address alone does not count: it is often set for a whole machine
    if not any(name in environment for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK")):
        return None
    present = [name for name in _VARIABLES if environment.get(name, "") != ""]
    missing = [name for name in _VARIABLES if name not in present]
    if missing:
        raise ConfigError(
            f"environment: {', '.join(present)} without {', '.join(missing)}; "
            "expected all of these variables (torchrun sets them), or none"
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
            raise ConfigError(f"environment: {name}={value}; expected less than {whole}={most}")
    if local_size > size or local_rank > rank:
        raise ConfigError(
            f"environment: rank {rank} of {size} is {local_rank} of {local_size} on this machine; expected LOCAL_RANK "
            "of at most RANK, and LOCAL_WORLD_SIZE of at most WORLD_SIZE"
        )
    address = f"{environment['MASTER_ADDR']}:{environment['MASTER_PORT']}"
    return TorchrunRank(rank, size, local_rank, local_size, address) if size > 1 else None


MEETING = timedelta(minutes=5)
"""Longest time that ranks wait for the last rank to start."""

TIMEOUT = timedelta(hours=12)
"""Longest time that a rank waits for another rank, which may be generating data or evaluating. The time can be long,
because if a rank ends, its connections break at once, and torchrun ends the other ranks."""

_FAILED = "failed"  # key of the store: the first failure of any rank


class ProcessGroup:
    """The connected ranks (processes) of a training; the methods communicate among all ranks.

    Args:
        place: rank of this process.
        environment: environment variables of torchrun.

    Raises:
        ConfigError: the ranks cannot connect.
    """

    def __init__(self, place: TorchrunRank, environment: Mapping[str, str]) -> None:
        self.place, self.rank, self.size = place, place.rank, place.size
        backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and dist.is_nccl_available() else "gloo"
        try:
            store, _, _ = next(iter(rendezvous("env://", place.rank, place.size, timeout=MEETING)))
            # torchrun keeps its store when it restarts the ranks
            attempt = environment.get("TORCHELASTIC_RESTART_COUNT", "0")
            self.store = dist.PrefixStore(f"neuprim/{attempt}", store)
            group = dist.PrefixStore("group", self.store)
            dist.init_process_group(backend, store=group, rank=place.rank, world_size=place.size, timeout=TIMEOUT)
        except (RuntimeError, ValueError, OSError) as error:
            reason = " ".join(str(error).split())[:200]
            raise ConfigError(
                f"rank {place.rank} of {place.size} cannot connect to the other ranks at "
                f"MASTER_ADDR:MASTER_PORT={place.address} ({reason})"
            ) from error

    @property
    def is_first(self) -> bool:
        """Whether this is rank 0, which writes files and messages."""
        return self.rank == 0

    # ------------------------------------------------------------ communication

    def gather(self, value: Any) -> list[Any]:
        """Return the ``value`` of every rank as a list, in the order of ranks.

        Raises:
            RankError: another rank ended.
        """
        values: list[Any] = [None] * self.size
        with self._errors():
            dist.all_gather_object(values, value)
        return values

    def share_number(self, name: str, make: Callable[[], int]) -> int:
        """Call ``make`` on rank 0 only; return its result on all ranks. No other call may use the key ``name``.

        Raises RankError.
        """
        number = make() if self.is_first else None
        with self._errors():
            if number is not None:
                self.store.set(name, str(number))
            return int(self.store.get(name))

    def exchange(self, sent: Tensor, received: Tensor) -> None:
        """Send row r of (R, n) ``sent`` to rank r; receive row r of ``received`` from rank r. Raises RankError."""
        with self._errors():
            dist.all_to_all_single(received, sent)

    def all_gather(self, received: Tensor, own: Tensor) -> None:
        """Fill row r of (R, n) ``received`` with ``own`` (n,) of rank r. Raises RankError."""
        with self._errors():
            dist.all_gather(list(received.unbind(0)), own)

    def check_equal(self, facts: Mapping[str, Any], hint: str) -> None:
        """Check that all ranks pass the same ``facts``.

        Raises:
            RankError: the facts of a rank differ. The message names the rank and the difference, and ends with
                ``hint``, a text about what was expected.
        """
        every = self.gather(dict(facts))
        for rank, other in enumerate(every):
            for name, value in every[0].items():
                if other[name] != value:
                    raise RankError(f"rank {rank} has {name} {other[name]!r}, but rank 0 has {value!r}; {hint}")

    @contextmanager
    def in_turn(self) -> Iterator[None]:
        """Run the block on rank 0 first, then on the first rank of every other machine, then on all other ranks.

        So only one rank writes a cache file, and later ranks find this file. Raises RankError.
        """
        turn = 0 if self.is_first else 1 if self.place.local_rank == 0 else 2
        for _ in range(turn):
            self.gather(None)
        yield
        for _ in range(2 - turn):
            self.gather(None)

    # ------------------------------------------------------------ failures

    def record_failure(self, line: str) -> bool:
        """Record in the shared store why this rank ends; return True if no rank failed before.

        The first rank that fails must report the error to the user.
        """
        own = json.dumps([self.rank, line[:4000]])
        try:
            return bool(self.store.compare_set(_FAILED, "", own).decode() == own)
        except RuntimeError:  # the store ended with torchrun or rank 0
            return True

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:  # a closed connection, or a timeout
            raise self.explain_broken_connection(error) from error

    def explain_broken_connection(self, error: Exception) -> RankError:
        """Return the error for a broken connection: the failure that another rank recorded, or a general message."""
        try:
            if self.store.check([_FAILED]):
                rank, line = json.loads(self.store.get(_FAILED))
                return RankError(f"rank {rank}: {line}", reported=True)
        except RuntimeError:
            pass  # the store is gone, too
        reason = " ".join(str(error).split())[:200]
        return RankError(f"another rank ended without a message, see torchrun's report ({reason})")

    def close(self) -> None:
        """Disconnect from the other ranks."""
        if dist.is_initialized():
            dist.destroy_process_group()

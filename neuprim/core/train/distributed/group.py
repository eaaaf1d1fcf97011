"""Several ranks that train one model: what they tell each other in a step, and what happens when one of them is gone.

Every rank draws all random numbers of a step, looks at its own views, and adds up the gradients of all of them in their
order (:mod:`~neuprim.core.train.distributed.bucket`). From there all ranks compute alike, population and learning rates
included, so nothing else is sent.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from neuprim.core.errors import RankError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.train.distributed import pulse
from neuprim.core.train.distributed.alone import Alone, Seen, StepViews
from neuprim.core.train.distributed.bucket import Bucket, Pair
from neuprim.core.train.distributed.place import Place
from neuprim.core.train.distributed.pulse import Pulse

__all__ = ["Group"]

_LETTER = 2048
"""Bytes of what a rank tells the others at once; more takes a second exchange."""

_HEAD = 4

LOOK = 0.2
"""Seconds between two looks at whether another rank is through."""


class Group(Alone):
    """This process as one of several.

    Args:
        place: which.
        wire: the way to the others: ``swap``, ``store``, ``hosted`` and ``close`` of
        :class:`~neuprim.core.train.distributed.wire.Wire`.

    Attributes:
        sent: bytes that this rank sent.
        asked: whether this process was asked to stop.
    """

    def __init__(self, place: Place, wire: Any) -> None:
        self.place, self.wire = place, wire
        self.rank, self.size = place.rank, place.size
        self.sent = 0
        self._bucket: Bucket | None = None
        self.asked: Callable[[], bool] = lambda: False
        self._stopping = False
        self._clock = 0.0
        self._told_at = 0.0
        self._turns = 0
        self._tail = 0.0
        self.pulse = Pulse(wire.store.clone(), self.rank, self.size)

    # ------------------------------------------------------------ a step

    def last(self, asked: Callable[[], bool]) -> Callable[[], bool]:
        self.asked = asked
        return lambda: self._stopping

    def step(self, model: Primitives, views: int, elapsed: float, start: float) -> StepViews:
        return _GroupViews(self, model, views, elapsed, start)

    def spent(self, elapsed: float, start: float) -> float:
        """The first rank's clock as it told it in this step; what it spends afterwards counts in the next."""
        self._tail = time.perf_counter() - self._told_at
        return self._clock

    def bucket(self, model: Primitives, views: int) -> Bucket:
        """The buffer for the model as it is now, and for letters about so many views."""
        if self._bucket is None or not self._bucket.fits(model.params, views * _LETTER):
            pair = self.size == 2 and views == 1
            self._bucket = (
                Pair(model.params, self.rank, _LETTER) if pair else Bucket(model.params, self.size, views * _LETTER)
            )
        return self._bucket

    def time(self, elapsed: float, start: float) -> float:
        """Seconds of training up to now by this rank's clock; only the first rank's counts."""
        self._told_at = time.perf_counter()
        return elapsed + self._tail + self._told_at - start

    def heard(self, letters: list[dict[str, Any]]) -> None:
        """Take over what the ranks decide together."""
        self._clock = float(letters[0]["clock"])
        self._stopping = any(letter["stop"] for letter in letters)

    # ------------------------------------------------------------ talking

    def swap(self, rows: Tensor, found: Tensor) -> None:
        """Send (R, n) rows, one to each rank, and find (R, n) rows, one from each.

        Raises:
            RankError: a rank failed or is gone; names it.
        """
        self.sent += rows[0].numel() * rows.element_size() * (self.size - 1)
        try:
            self.wire.swap(rows, found)
        except RankError as error:
            raise self.cause(error) from error

    def exchange(self, rows: Tensor, found: Tensor, give: list[int], take: list[int]) -> None:
        """Send ``give[r]`` of the rows to rank r, in their order, and find ``take[r]`` from each, by rank.

        Raises:
            RankError: a rank failed or is gone; names it.
        """
        self.sent += (len(rows) - give[self.rank]) * math.prod(rows.shape[1:]) * rows.element_size()
        try:
            self.wire.exchange(rows, found, give, take)
        except RankError as error:
            raise self.cause(error) from error

    def tell(self, letter: dict[str, Any]) -> list[dict[str, Any]]:
        """Tell all ranks the same; returns what each of them told, by rank. It must be what JSON can say."""
        return self.tell_by(self._all_get, letter, _LETTER)

    def tell_by(self, post: Callable[[bytes], list[bytes]], letter: dict[str, Any], room: int) -> list[dict[str, Any]]:
        """The same by another way, which brings ``room`` bytes of each rank to each; what is longer follows by the
        usual one."""
        text = json.dumps(letter).encode()
        whole = len(text).to_bytes(_HEAD, "little") + text
        first = post(whole[:room].ljust(room, b"\0"))
        lengths = [_HEAD + int.from_bytes(part[:_HEAD], "little") for part in first]
        rest = max(lengths) - room
        if rest > 0:
            second = self._all_get(whole[room:].ljust(rest, b"\0"))
            first = [a + b for a, b in zip(first, second, strict=True)]
        return [json.loads(part[_HEAD:length]) for part, length in zip(first, lengths, strict=True)]

    def _all_get(self, text: bytes) -> list[bytes]:
        rows = torch.frombuffer(bytearray(text * self.size), dtype=torch.uint8).view(self.size, -1)
        found = torch.empty_like(rows)
        self.swap(rows, found)
        return [part.numpy().tobytes() for part in found]

    def agree(self, what: str, facts: dict[str, Any]) -> None:
        letters = self.tell(facts)
        for rank, letter in enumerate(letters):
            for name, value in letters[0].items():
                if letter.get(name) != value:
                    raise RankError(
                        f"rank {rank} has other {name} than rank 0: {letter.get(name)!r}, not {value!r}; {what}"
                    )

    @contextmanager
    def in_turn(self) -> Iterator[None]:
        """The first rank of all goes first, then the first of each other machine, then the rest."""
        self._turns += 1
        for rank in sorted({0, self.place.local_first} - {self.rank}):
            self._wait_for(rank)
        yield
        self.wire.store.set(f"through/{self._turns}/{self.rank}", "1")

    def _wait_for(self, rank: int) -> None:
        """Until a rank is through with this turn, however long it works."""
        store, looks = self.wire.store, 0
        try:
            while not store.check([f"through/{self._turns}/{rank}"]):
                looks += 1
                if store.check(["failed"]) or (looks % 100 == 0 and rank in self.pulse.gone(store, pulse.LONG_SILENCE)):
                    raise self.cause(RankError(f"rank {rank} is gone"))
                time.sleep(LOOK)
        except RuntimeError as error:
            raise self.cause(RankError("the store that ranks meet in is gone")) from error

    # ------------------------------------------------------------ faults

    def fail(self, line: str, of_ranks: bool = False) -> str | None:
        """Leave a word for the others that the training ends and why; returns the line that the user must be told, None
        if another rank was first.

        Args:
            of_ranks: the line names ranks itself.
        """
        said = line if of_ranks or self.first else f"rank {self.rank}: {line}"
        own = json.dumps({"rank": self.rank, "text": said[:4000]})
        try:
            return said if self.wire.store.compare_set("failed", "", own).decode() == own else None
        except RuntimeError:
            return said

    def cause(self, found: RankError) -> RankError:
        """What is behind a sign that a rank is gone, such as a broken connection; ``found`` itself where nothing is."""
        store = self.wire.store
        try:
            if store.check(["failed"]):
                return _told(store.get("failed"))
            gone = self.pulse.gone(store, pulse.SILENCE)
            if store.check(["failed"]):
                return _told(store.get("failed"))
        except RuntimeError:
            gone = [0] if self.wire.hosted and self.rank else []
        if not gone:
            return found
        names = ", ".join(map(str, gone))
        return RankError(f"rank {names} died" if len(gone) == 1 else f"ranks {names} died")

    def close(self, failed: bool = False) -> None:
        """Leave the others."""
        if failed and self.wire.hosted and self.first:
            time.sleep(
                1.5 * pulse.SILENCE
            )  # the others look into the store for the cause, and it goes with this process
        self.pulse.stop()
        self.wire.close()


def _told(text: bytes) -> RankError:
    return RankError(json.loads(text)["text"], told=True)


class _GroupViews(StepViews):
    """The views of a step: this rank's in their rounds, a view of each rank in a round."""

    def __init__(self, group: Group, model: Primitives, views: int, elapsed: float, start: float) -> None:
        super().__init__(model)
        self._group, self._bucket, self._when = group, group.bucket(model, views), (elapsed, start)
        self._there: list[list[bool]] = []
        # of all bits of all positions: a rank that computes otherwise is found before its gradients count
        self._mark = int(model.params["means"].detach().view(torch.int32).sum())

    def add(self, seen: Seen, tally: Contributions) -> None:
        self.seen.append(seen)
        self._there.append(self._bucket.take(self.model.params, tally))
        self._bucket.add(self._group.swap)

    def close(self) -> Contributions:
        group, bucket = self._group, self._bucket
        letter = {
            "mark": self._mark,
            "clock": group.time(*self._when),
            "stop": group.asked(),
            "there": [any(has) for has in zip(*self._there, strict=True)],
            "seen": [asdict(seen) for seen in self.seen],
        }
        letters = group.tell_by(lambda text: bucket.spread(group.swap, text), letter, bucket.letter)
        for rank, other in enumerate(letters):
            if other["mark"] != letters[0]["mark"]:
                raise RankError(
                    f"rank {rank} does not compute as rank 0 does: its positions differ; expected processors or cards of one kind"
                )
        group.heard(letters)
        self.seen = [
            Seen(**seen) for views in zip(*(other["seen"] for other in letters), strict=True) for seen in views
        ]
        return bucket.give(
            self.model.params, [any(has) for has in zip(*(other["there"] for other in letters), strict=True)]
        )

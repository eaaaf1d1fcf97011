"""A trainer for training one model on several ranks (processes), each of which holds the whole model.

Every rank draws the same random numbers for all views of a step, but renders only its own views. Then every rank gets
the sum of the gradients of all views, added in a fixed order. So all ranks make the same update and the same population
control. R ranks with V views per step give the same bits as one process with R x V views per step.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, RankError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.core.render.output import Contributions
from neuprim.core.task import Loss
from neuprim.core.train.process_group import ProcessGroup
from neuprim.core.train.settings import TrainSettings
from neuprim.core.train.step_results import StepReport, ViewResult, ViewTask
from neuprim.core.train.trainer import Trainer
from neuprim.core.train.training_views import hash_training_views

_ALIGNMENT = 16
"""Alignment of the tensors in an exchange buffer, in float32 numbers: 16 numbers are 64 bytes, as much as a vector unit
reads at once."""


class _RankMessage(NamedTuple):
    """Message that a rank sends to all other ranks in each step.

    Attributes:
        checksum: checksum of the primitives' positions before the step. If the checksums of two ranks differ, the ranks
            compute differently.
        elapsed: seconds of training; all ranks use the value of rank 0.
        stop: whether the rank was asked to stop.
        present: for each parameter, whether it has a gradient on this rank.
        views: results of the rank's views, in order.
    """

    checksum: int
    elapsed: float
    stop: bool
    present: list[bool]
    views: list[ViewResult]


class DistributedTrainer(Trainer):
    """Trainer of one rank (process); every rank renders ``train.views_per_step`` views per step.

    Args:
        group: connection to the other ranks.

    Raises:
        ConfigError: as for Trainer; also for ``train.supervision=voxels``, because such a training uses no views that
            could be divided among the ranks.
    """

    def __init__(
        self,
        model: Primitives,
        dataset: Dataset,
        loss: Loss,
        settings: TrainSettings,
        renderer: RenderSettings,
        seed: int,
        group: ProcessGroup,
    ) -> None:
        super().__init__(model, dataset, loss, settings, renderer, seed)
        if self.settings.supervision == "voxels":
            raise ConfigError(
                "train.supervision=voxels: several processes divide the views of a step, but this training uses no "
                f"views; expected 1 process, found {group.size}"
            )
        self.group, self.rank, self.ranks = group, group.rank, group.size
        self.recorder = None  # ranks exchange gradients in every step
        self._sums: GradientSum | None = None
        self._present: list[bool] = []
        self._checksum = 0  # sum of the bits of all positions before the step
        self._stopping = False
        self._agreed = self._agreed_at = self._after = 0.0

    def check_same_start(self) -> None:
        """Check that all ranks start with the same settings, data and parameters.

        Raises:
            RankError: a rank differs; the message names the rank and the difference.
        """
        views, digest = self.dataset.train, hashlib.sha256()
        for name, value in sorted(self.state()[0].items()):
            digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode() + value.contiguous().numpy().tobytes())
        settings = hashlib.sha256(repr((self.settings, self.renderer)).encode())
        facts = {
            "steps done": self.step,
            "training views": f"{len(views)} ({hash_training_views(views)})",
            "pixels of the first view": hashlib.sha256(views.pixels(0).rgb.numpy().tobytes()).hexdigest()[:16],
            "settings": settings.hexdigest()[:16],
            "state": digest.hexdigest()[:16],
        }
        self.group.check_equal(facts, "expected the same overrides, data and output directory on all ranks")

    def train_step(self) -> StepReport:
        """Take one training step with the other ranks, as :meth:`~neuprim.core.train.trainer.Trainer.train_step`.

        Raises:
            RankError: another rank ended or computes differently. The state of this trainer is then the same as before
                the step.
        """
        order, generator = self.order, self.generator.get_state()
        try:
            return super().train_step()
        except RankError as error:
            # undo the draws, so that a training that goes on from this state repeats the step
            self.order = order
            self.generator.set_state(generator)
            raise error if error.reported else RankError(f"step {self.step + 1}: {error}") from error

    @property
    def stopping(self) -> bool:
        """Whether any rank had been asked to stop when the ranks combined the last step; the same on all ranks."""
        return self._stopping

    def _draw_views(self) -> list[ViewTask]:
        """Draw the views of all ranks for one step; return the views of this rank."""
        drawn = [self._draw_view() for _ in range(self.settings.views_per_step * self.ranks)]
        own = drawn[self.rank :: self.ranks]
        after = int(self.order[self.rank]) if len(self.order) > self.rank else None
        upcoming = [*(index for index, *_ in own[1:]), after]
        self._checksum = int(self.model.params["means"].detach().view(torch.int32).sum())
        if self._sums is None or not self._sums.fits(self.model.params):
            self._sums = GradientSum(self.model.params, self.group)
        self._present = [False] * len(self.model.params)
        return [ViewTask(*view, then) for view, then in zip(own, upcoming, strict=True)]

    def _exchange_gradients(self, contributions: Contributions) -> Contributions:
        """Add the gradients of one view of every rank to the sum; return ``contributions`` unchanged."""
        assert self._sums is not None
        present = self._sums.add(self.model.params, contributions)
        self._present = [before or now for before, now in zip(self._present, present, strict=True)]
        return contributions

    def _combine_views(
        self, results: list[ViewResult], each: list[Contributions], start: float
    ) -> tuple[list[ViewResult], Contributions]:
        """Return all ranks' view results, in order, and summed contributions; set ``.grad`` to the summed gradients."""
        assert self._sums is not None
        self._agreed_at = time.perf_counter()
        elapsed = self.elapsed + self._after + self._agreed_at - start
        own = _RankMessage(self._checksum, elapsed, self.stop_requested(), self._present, results)
        messages: list[_RankMessage] = self.group.gather(own)
        for rank, message in enumerate(messages):
            if message.checksum != messages[0].checksum:
                raise RankError(
                    f"rank {rank} computes other positions of primitives than rank 0; "
                    "expected the same kind of processor or GPU for all ranks"
                )
        self._agreed = messages[0].elapsed
        self._stopping = any(message.stop for message in messages)
        present = [any(each) for each in zip(*(message.present for message in messages), strict=True)]
        every = [view for views in zip(*(message.views for message in messages), strict=True) for view in views]
        return every, self._sums.finish(self.model.params, present)

    def _stop_clock(self, start: float) -> float:
        """Return the training time of rank 0, measured in :meth:`_combine_views`.

        The rest of the step counts for the next step.
        """
        self._after = time.perf_counter() - self._agreed_at
        return self._agreed


def _pad_gradient_exchange(numbers: int) -> int:
    """Return ``numbers``, a count of float32 numbers, rounded up to a multiple of 16."""
    return -(-numbers // _ALIGNMENT) * _ALIGNMENT


class GradientSum:
    """Sum of gradients and contributions over the views of all ranks, in the order of the views.

    An all-reduce is not used, because its order of additions is not fixed, which changes the bits. Instead, every rank
    owns a slice of a flat buffer. The rank receives this slice of every view's gradients, and adds the views one after
    the other, as a single process does. Then the rank sends the sum to the other ranks. This moves as many bytes as a
    ring all-reduce. The buffers are reused, because allocating a buffer takes as long as sending it.
    """

    def __init__(self, params: Mapping[str, Tensor], group: ProcessGroup) -> None:
        self.group = group
        self.shapes = {name: value.shape for name, value in params.items()}
        first = next(iter(params.values()))
        self._count = first.shape[0]
        sizes = [*(value.numel() for value in params.values()), self._count, self._count]
        width = _pad_gradient_exchange(-(-sum(map(_pad_gradient_exchange, sizes)) // group.size))
        self._buffer, self._received = (torch.zeros(group.size, width, device=first.device) for _ in range(2))
        self._sum = torch.zeros(width, device=first.device)
        self._empty = True
        flat, start, parts = self._buffer.reshape(-1), 0, []
        for size in sizes:
            parts.append(flat[start : start + size])
            start += _pad_gradient_exchange(size)
        *self._gradients, self._weight, self._error = parts

    def fits(self, params: Mapping[str, Tensor]) -> bool:
        """Return whether the buffers fit ``params``: the names and shapes must be those given to the constructor."""
        return self.shapes == {name: value.shape for name, value in params.items()}

    def add(self, params: Mapping[str, Tensor], contributions: Contributions) -> list[bool]:
        """Add the gradients of one view of every rank, in rank order, and the primitives' contributions to these views.

        Clear ``.grad`` of ``params``. Return for each parameter whether it had a gradient on this rank.
        """
        present = []
        for value, part in zip(params.values(), self._gradients, strict=True):
            present.append(value.grad is not None)
            if value.grad is None:
                part.zero_()
            else:
                part.view(value.shape).copy_(value.grad)
            value.grad = None
        weight, error = contributions.of_all(self._count)
        self._weight.copy_(weight)
        self._error.copy_(error)
        self.group.exchange(self._buffer, self._received)
        for row in self._received:
            if self._empty:
                self._sum.copy_(row)
                self._empty = False
            else:
                self._sum += row
        return present

    def finish(self, params: Mapping[str, Tensor], present: Sequence[bool]) -> Contributions:
        """Set ``.grad`` of the ``present`` parameters to the sum over all views; return the summed contributions.

        Gradients and contributions are valid until the next :meth:`add`, which starts a new sum.
        """
        self._empty = True
        self.group.all_gather(self._buffer, self._sum)
        for value, part, has_gradient in zip(params.values(), self._gradients, present, strict=True):
            if has_gradient:
                value.grad = part.view(value.shape)
        return Contributions(self._weight, self._error)

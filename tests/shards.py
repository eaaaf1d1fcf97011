"""A model in parts, put together again, for tests."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from neuprim.core.train.distributed.group import Group
from neuprim.core.train.distributed.shards import Shards
from neuprim.core.train.restoring import by_row
from neuprim.core.train.trainer import Trainer


def share(trainer: Trainer, group: Group) -> Trainer:
    """The trainer with its part of the primitives."""
    trainer.join(Shards(group, trainer.renderer.near))
    return trainer


def whole_of(trainers: Sequence[Trainer]) -> dict[str, Tensor]:
    """The state of the whole model, of the trainers of all ranks; what each of them has is the same on all."""
    states = [trainer.state()[0] for trainer in trainers]
    assert all(state.keys() == states[0].keys() for state in states)
    found = {}
    for name, value in states[0].items():
        each = [state[name] for state in states]
        if not by_row(name, value):
            assert all(torch.equal(value, other) for other in each), name
        found[name] = torch.cat(each) if by_row(name, value) else value
    return found


def different(found: dict[str, Tensor], expected: dict[str, Tensor]) -> list[str]:
    """Names of tensors whose bits differ."""
    assert found.keys() == expected.keys()
    return [
        name
        for name, value in expected.items()
        if found[name].dtype != value.dtype or not torch.equal(found[name], value)
    ]

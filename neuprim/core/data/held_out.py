"""Training views held out of a data set, for decisions that the test views must not make."""

from __future__ import annotations

from dataclasses import replace

from neuprim.core.data import Dataset
from neuprim.core.data.views import SomeViews
from neuprim.core.errors import ConfigError

__all__ = ["held_out"]


def held_out(dataset: Dataset, every: int) -> Dataset:
    """The same without its test views: one of every ``every`` training views takes their place, and is not learned
    from.

    Which one moves on by one from each group to the next: of cameras with as many frames as a multiple of ``every``, it
    is not always the same moment that nobody learns from.

    Args:
        every: 2 or more.

    Raises:
        ConfigError: that leaves nothing to learn from, or nothing to judge by.
    """
    count = len(dataset.train)
    if every < 2 or count < 2:
        raise ConfigError(
            f"{dataset.name}: every {every}. of {count} training views held out; expected 2 or more of 2 views or more"
        )
    test = [i for i in range(count) if i % every == i // every % every]
    train = [i for i in range(count) if i % every != i // every % every]
    return replace(dataset, train=SomeViews(dataset.train, train), test=SomeViews(dataset.train, test))

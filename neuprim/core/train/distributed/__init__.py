"""One training by several processes, its ranks: each draws other views of a step, and all of them end it with the same
bits.

The words of data-parallel training are meant: a *rank* is a process and its number.
:mod:`~neuprim.core.train.distributed.alone` is one process and what a trainer asks of any; the rest is loaded where there are
several.
"""

from neuprim.core.train.distributed.alone import ALONE, Alone, Look, Seen, StepViews

__all__ = ["ALONE", "Alone", "Look", "Seen", "StepViews"]

"""The smallest model that meets a target: short trials of several sizes, what they promise, and one full run of the
size that follows.

``prediction`` says how good a longer run will be, ``search`` which size comes next, ``pace`` what fits into the budget;
``judge`` reads what was tried with a target in mind, ``searching`` goes from trial to trial, ``trying`` trains one;
``stages`` makes the finished model smaller;
``run`` does it all, and ``record`` keeps it.
"""

from neuprim.search.target.record import Attempt, Record
from neuprim.search.target.run import target_run

__all__ = ["Attempt", "Record", "target_run"]

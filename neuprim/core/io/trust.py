"""The user's word that a run of somebody else may be used as one of their own: ``--trust``, or an environment variable.

What it is asked for: :mod:`neuprim.config.stored_run`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

FLAG = "--trust"
ENVIRONMENT = "NEUPRIM_TRUST"  # says the flag for every command; processes that a command starts inherit it


def trusted() -> bool:
    """Whether the user said so."""
    return os.environ.get(ENVIRONMENT, "") not in ("", "0")


@contextmanager
def trusting(said: bool) -> Iterator[None]:
    """Inside, runs are trusted if the user ``said`` so now, or in the environment."""
    before = os.environ.get(ENVIRONMENT)
    if said:
        os.environ[ENVIRONMENT] = "1"
    try:
        yield
    finally:
        if said:
            os.environ.pop(ENVIRONMENT)
            os.environ.update({} if before is None else {ENVIRONMENT: before})

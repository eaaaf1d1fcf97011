"""The user's consent to use a run of somebody else like one of their own: ``--trust``, or an environment variable.

:mod:`neuprim.config.stored_run` says what needs it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

FLAG = "--trust"
ENVIRONMENT = "NEUPRIM_TRUST"  # gives the flag to every command; processes that a command starts inherit it


def trusted() -> bool:
    """Return whether the user trusts runs of others."""
    return os.environ.get(ENVIRONMENT, "") not in ("", "0")


@contextmanager
def trusting(said: bool) -> Iterator[None]:
    """Trust runs inside the block if ``said``, the user's flag, is set, or if the environment variable is."""
    before = os.environ.get(ENVIRONMENT)
    if said:
        os.environ[ENVIRONMENT] = "1"
    try:
        yield
    finally:
        if said:
            os.environ.pop(ENVIRONMENT)
            os.environ.update({} if before is None else {ENVIRONMENT: before})

"""Setting that says whether the user trusts other people's runs: ``--trust`` or an environment variable.

:mod:`neuprim.config.stored_run` says which uses of a run need trust.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

FLAG = "--trust"
ENVIRONMENT = "NEUPRIM_TRUST"  # gives the flag to every command; processes that a command starts inherit it


def trusted() -> bool:
    """Return whether the user trusts runs that other people made."""
    return os.environ.get(ENVIRONMENT, "") not in ("", "0")


@contextmanager
def trusting(said: bool) -> Iterator[None]:
    """Make :func:`trusted` return True in the block if ``said``, the flag ``--trust``; otherwise, change nothing."""
    before = os.environ.get(ENVIRONMENT)
    if said:
        os.environ[ENVIRONMENT] = "1"
    try:
        yield
    finally:
        if said:
            os.environ.pop(ENVIRONMENT)
            os.environ.update({} if before is None else {ENVIRONMENT: before})

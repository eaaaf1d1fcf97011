"""Views that are damaged: left out with a line each, unless they are the rule or the user wants none left out."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from neuprim.core.errors import DataError
from neuprim.core.notices import warn_once

__all__ = ["BadViews"]

_P = ParamSpec("_P")
_T = TypeVar("_T")
_LISTED = 10


class BadViews:
    """The bad views of a data set: images that cannot be read, poses that are none, masks that leave nothing.

    One bad view is left out; keys that contradict each other are none of this, and are refused.

    Args:
        where: what messages name where most views are bad.
        strict: refuse the first bad view.
    """

    def __init__(self, where: str, strict: bool) -> None:
        self._where, self._strict = where, strict
        self._faults: list[str] = []

    def read(self, name: str, function: Callable[_P, _T], *args: _P.args, **more: _P.kwargs) -> _T | None:
        """What ``function`` returns; None for a view that it refuses."""
        try:
            return function(*args, **more)
        except DataError as error:
            self.add(name, error)
            return None

    def add(self, name: str, error: DataError) -> None:
        """Note a bad view, or raise where none may be left out."""
        if self._strict:
            raise error
        self._faults.append(f"{error}; view {name} is left out (scene.strict=true refuses it)")
        if len(self._faults) == 1:
            self._first = error

    def settle(self, count: int) -> None:
        """Name the bad ones of ``count`` views.

        Raises:
            DataError: most views are bad.
        """
        bad = len(self._faults)
        if 2 * bad > count:
            raise (
                self._first
                if count == 1
                else DataError(f"{self._first}; {bad} of {count} views of {self._where} are like this")
            )
        for fault in self._faults[:_LISTED]:
            warn_once(fault)
        if bad > _LISTED:
            warn_once(f"{self._where}: {bad - _LISTED} more views are left out")

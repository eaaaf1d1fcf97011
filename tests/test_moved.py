"""Modules that moved answer under the names that they had."""

from __future__ import annotations

import importlib
import sys

import pytest

from neuprim.moved import MOVED


@pytest.mark.parametrize("name", MOVED)
def test_the_old_name_is_the_module_of_today(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.warns(DeprecationWarning, match=f"^{name} is now {MOVED[name]}$"):
        before = importlib.import_module(name)
    today = importlib.import_module(MOVED[name])
    offered = getattr(today, "__all__", [])
    assert before.__doc__ == today.__doc__ and before.__all__ == offered
    for attribute in offered:
        assert getattr(before, attribute) is getattr(today, attribute)
    with pytest.raises(AttributeError):
        _ = before.no_such_thing


def test_a_name_that_never_was_is_not_found() -> None:
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("neuprim.core.never")

"""Fixtures of the tests of exports."""

from __future__ import annotations

import pytest

from neuprim.export import shared


@pytest.fixture
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """The views that an export is compared in have 64 pixels a side."""
    monkeypatch.setattr(shared, "_SIZE", 64)

"""What all tests share: how long one may take."""

from __future__ import annotations

import pytest

SLOW = 3600.0
"""Seconds that a test marked slow may take; the others have ``timeout`` of pyproject.toml."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW))

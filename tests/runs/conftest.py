"""What the tests of whole runs share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module", autouse=True)
def short_orbits() -> Iterator[None]:
    """Films of four frames."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
        yield

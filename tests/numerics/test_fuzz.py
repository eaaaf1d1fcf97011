"""Wild but finite primitives by the thousand: nothing in an image or a gradient may leave the finite."""

from __future__ import annotations

import sys

import pytest

from tests.numerics.wild import render_block


def test_twenty_thousand_wild_primitives() -> None:
    assert max(render_block(seed) for seed in range(10)) > 0.5


@pytest.mark.slow
def test_a_million_wild_primitives() -> None:
    assert max(render_block(seed) for seed in range(500)) > 0.5
    if sys.platform == "linux":
        import resource

        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 4 * 2**20, "KiB"

"""Wild but finite primitives by the thousand: nothing in an image or a gradient may leave the finite."""

from __future__ import annotations

import sys

import pytest

from tests.backends import FAST, SLOW_HERE
from tests.numerics.wild import render_block


@pytest.mark.parametrize("backend", FAST)
def test_twenty_thousand_wild_primitives(backend: str) -> None:
    assert max(render_block(seed, backend) for seed in range(10)) > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("backend", [b for b in FAST if b not in SLOW_HERE])
def test_a_million_wild_primitives(backend: str) -> None:
    assert max(render_block(seed, backend) for seed in range(500)) > 0.5
    if sys.platform == "linux":
        import resource

        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 4 * 2**20, "KiB"

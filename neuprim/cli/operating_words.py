"""Words of an operating point on the command line: ``renderer.alpha_min=0.01``, ``store.colour=float16``,
``resolution=0.5``."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["OPERATING", "operating_words"]

_HEADS = (
    "renderer",
    "resolution",
    "density",
    "colour",
    "store",
)  # neuprim.runs.operating.HEADS, without loading what draws

OPERATING = """\
KEY=VALUE words draw the run otherwise than it says itself:
  renderer.KEY=VALUE         any setting of the renderer
  resolution=0.5             drawn at half the width and height, and enlarged
  density.NAME=N colour.NAME=N
                             less of something, e.g. colour.degree=1 (bands of spherical harmonics) density.neurons=4
  store.GROUP=float16|uint8  means, shape, density, colour or all as 16-bit floats, or 8-bit codes, hold them
`neuprim tradeoff RUN_DIR` measures what they cost and gain."""


def operating_words(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Those of an operating point, and the others, both in their order; ``--`` may stand between."""
    found = [word for word in words if "=" in word and word.partition("=")[0].partition(".")[0] in _HEADS]
    return found, [word for word in words if word not in found and word != "--"]

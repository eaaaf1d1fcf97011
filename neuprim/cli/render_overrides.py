"""Render overrides on the command line: ``renderer.alpha_min=0.01``, ``store.colour=float16``, ``resolution=0.5``."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["RENDER_OVERRIDES_HELP", "split_render_overrides"]

_HEADS = ("renderer", "resolution", "density", "colour", "store")
"""A copy of neuprim.runs.render_config.HEADS, as importing that module loads torch."""

RENDER_OVERRIDES_HELP = """\
KEY=VALUE overrides how the run is drawn:
  renderer.KEY=VALUE         any setting of the renderer
  resolution=0.5             render at half the width and height, and upsample
  density.NAME=N colour.NAME=N
                             a smaller field, e.g. colour.degree=1 (bands of spherical harmonics) density.neurons=4
  store.GROUP=float16|uint8  store means, shape, density, colour or all as 16-bit floats or 8-bit codes
`neuprim tradeoff RUN_DIR` measures their cost and gain."""


def split_render_overrides(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split arguments into render overrides and others; ``--`` may stand between."""
    found = [word for word in words if "=" in word and word.partition("=")[0].partition(".")[0] in _HEADS]
    return found, [word for word in words if word not in found and word != "--"]

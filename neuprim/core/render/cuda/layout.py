"""Column numbers of the CUDA kernels' arrays; :mod:`neuprim.core.render.layout` explains the columns' content.

A primitive's row consists of float4 columns: one load of 16 bytes reads a vector and a scalar.
"""

from __future__ import annotations

from dataclasses import dataclass

from neuprim.core.render import layout
from neuprim.core.render.layout import (  # noqa: F401 - kernels read them as L.TILE
    ANCHOR_Z,
    G_ERROR,
    G_LOG_M,
    G_NEURONS,
    G_OFFSET,
    G_WEIGHT,
    PER_NEURON,
    PIXELS,
    TILE,
    UNIT,
)

E0, EX, EY, XA, XU, XV, REST, NEURONS = 0, 1, 2, 3, 4, 5, 6, 7
"""Numbers of the float4 columns of a primitive's row. Each column holds a vector and a scalar (:data:`SCALARS`), but
REST holds four scalars. The neurons' columns come after REST."""

SCALARS = {E0: "UX", EX: "UY", EY: "NEAR", XA: "OFFSET", XU: "TU", XV: "TV"}
"""Names of the scalar, the fourth number, of each column. REST holds TC, UNIT, ANCHOR_Z and whether the primitive needs
float64 (0 or 1). The column of a neuron holds (WX, WY, WZ, PHASE)."""

AMPLITUDE = 4  # place of the amplitude among the five numbers of a neuron in a gradient row

WARP = 32

CUT_AT = -1e30  # entry of every chord that the near plane cuts: in front of all others, and equal


@dataclass(frozen=True)
class KernelForm:
    """Constants with which a kernel is compiled."""

    neurons: int  # K, neurons of the density
    edge: int  # p, exponent of the density's edge
    channels: int  # C, colour channels
    hidden: int = -1  # H, hidden units of a colour network; -1 for constant colours


def rasterizer_amplitude_column(neurons: int) -> int:
    """Return the first column of a primitive's row with amplitudes of neurons; a float4 column holds four of them."""
    return NEURONS + neurons


def rasterizer_colour_column(neurons: int) -> int:
    """Return the first column of a primitive's row with the colour; a float4 column holds four channels."""
    return rasterizer_amplitude_column(neurons) + -(-neurons // 4)


def rasterizer_row_columns(neurons: int, channels: int) -> int:
    """Return the number of float4 columns of a primitive's row."""
    return rasterizer_colour_column(neurons) + -(-channels // 4)


def wide_width(neurons: int) -> int:
    """Return the length of a primitive's float64 ("wide") row.

    The row has the columns of :mod:`neuprim.core.render.layout`, without padding.
    """
    return layout.NEURONS + PER_NEURON * neurons


def rasterizer_net_columns(channels: int) -> int:
    """Return the number of float4 columns per unit of a colour network: (WX, WY, WZ, PHASE), then the weights."""
    return 1 + -(-channels // 4)


def gradient_width(neurons: int, channels: int, hidden: int = 0) -> int:
    """Return the number of columns of a gradient row with ``hidden`` network units, a multiple of the warp size."""
    used = G_NEURONS + PER_NEURON * neurons + channels + (4 + channels) * hidden
    return -(-used // WARP) * WARP

"""Row widths of the numba kernels' arrays, and offsets of the kernels' scratch arrays.

A kernel handles one (tile, primitive) pair at a time; a tile has 16 x 16 pixels. The kernel copies the pixels inside
the primitive's silhouette into a list without gaps. An entry of this list is a *lane*. A scratch array has one element
per lane. The name of a scratch array is its offset in a flat array: ``S[HALF + k]`` is the half chord of lane k. The
arrays of a tile's pixels (``T_`` and following) lie in another flat array, ``state``.
"""

from __future__ import annotations

from neuprim.core.render.layout import G_NEURONS, NET_OUT, NEURONS, PER_NEURON, PIXELS

# ---- Range of rates of a pair of neurons: change over a half chord, in turns. Neurons are stored by rising rate, so
# both neurons of a pair have similar rates.
SLOW, MEDIUM, FAST = 0, 1, 2
SLOW_TURNS, MEDIUM_TURNS = 0.4999, 1.4999

LANES = 288  # 256 pixels of a tile, padded so that a vector may extend past the end


def _padded_row_width(floats: int) -> int:
    return -(-floats // 16) * 16


def row_width(neurons: int) -> int:
    """Return the number of floats in a primitive's row, a multiple of 16; the caller rounds ``neurons`` up to even."""
    return _padded_row_width(NEURONS + PER_NEURON * neurons)


def net_row_width(hidden: int, channels: int) -> int:
    """Return the number of floats in the row of one primitive's colour network; 1 if the network has no hidden units.

    ``hidden`` is the number of hidden units, already rounded up to an even number.
    """
    return max((NET_OUT + channels) * hidden, 1)


def gradient_width(neurons: int, channels: int, hidden: int = 0) -> int:
    """Return the number of floats in a gradient row, a multiple of 16.

    A gradient row holds the gradients with respect to one primitive's numbers. ``neurons`` and ``hidden`` (units of a
    colour network) are already rounded up to even numbers.
    """
    return _padded_row_width(G_NEURONS + PER_NEURON * neurons + channels + (NET_OUT + channels) * hidden)


def lane_array(number: int) -> int:
    """Return the offset, in flat scratch memory, of scratch array ``number``, which has one element per lane."""
    return LANES * number


# ---- Scratch arrays over the compacted lanes of one (tile, primitive) pair.
DU, DV = lane_array(0), lane_array(1)  # pixel offset from the anchor
EXL, EYL, EZL = lane_array(2), lane_array(3), lane_array(4)  # ray direction e in whitened space
QX, QY, QZ = lane_array(5), lane_array(6), lane_array(7)  # chord middle
HALF = lane_array(8)  # half chord, units of m along e; 0 where the ray misses
FIELD = lane_array(9)  # mean of f over the chord
PIXEL = lane_array(10)  # 16 y + x in the tile
DEPTH = lane_array(11)  # optical depth, 2 FIELD HALF FADE NORM_L
MID, TM, IA = lane_array(13), lane_array(14), lane_array(15)  # chord middle, closest approach (both t), 1/(e.e)
DH = lane_array(16)  # dh/dD with the floor on D
UNCUT = lane_array(17)  # 1 where the near plane does not cut the chord
NORM_L = lane_array(18)  # length of the ray direction whose camera-z is 1
ALPHA = lane_array(19)  # opacity after clamp and cut
FADE = lane_array(20)  # soft edges: mean of (1 - |y|^2)^p over the chord; 1 without
OVER = lane_array(21)  # 1/(1 - alpha)
SLOPE = lane_array(22)  # d alpha / d(2 FIELD HALF FADE), 0 where clamped or cut
GRAD = lane_array(23)  # dL/d(2 FIELD HALF FADE)
GF = lane_array(24)  # dL/d FIELD
GQX, GQY, GQZ = lane_array(25), lane_array(26), lane_array(27)  # dL/d chord middle
GEX, GEY, GEZ = lane_array(28), lane_array(29), lane_array(30)  # dL/d (half e)
GMID = lane_array(31)  # dL/d MID from the depth image
HEIGHT = lane_array(32)  # half chord before the near plane cuts it
SLIDE = lane_array(33)  # s: MID and TM are measured from a ray origin slid by this much
# Of soft edges only: derivatives of FADE, or in float64 of the mean of the whole density, see chord_gradient.
BY_D, BY_A, BY_TM = lane_array(34), lane_array(35), lane_array(36)
INSIDE = lane_array(37)  # dL/dQ . e of the density alone
FORWARD_SCRATCH = lane_array(21)
BACKWARD_SCRATCH = lane_array(38)
# With a colour network, forward and backward: C arrays of colours before max(0, .), then C of dL/d these colours.
RAY_COLOUR = BACKWARD_SCRATCH
# Per neuron of the float64 backward pass: cos sinc, -2 pi sin sinc, cos dsinc.
N_COS, N_SIN, N_DSINC = lane_array(0), lane_array(1), lane_array(2)
NEURON_SCRATCH = lane_array(3)
# Per unit of a colour network: cos of its phase, and -2 pi sin, its derivative by turns.
NET_COS, NET_SIN = lane_array(0), lane_array(1)
NET_SCRATCH = lane_array(2)

# ---- Pixel state of one tile.
T_, NORM, LAST = 0, PIXELS, 2 * PIXELS  # transmittance, ray norm, rank + 1 of the last contributor
ZSUM = 3 * PIXELS  # forward: sum of w z
COLOR = 4 * PIXELS  # forward: then C arrays of accumulated colour
BEHIND = 3 * PIXELS  # backward: dL/dT_after x T_after, what lies behind
ERR, GZ = 4 * PIXELS, 5 * PIXELS
G_COLOR = 6 * PIXELS  # backward: then C arrays of dL/drgb

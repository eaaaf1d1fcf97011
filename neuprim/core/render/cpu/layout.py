"""Names for the columns of the kernels' flat arrays.

The pixel kernels read one float32 row per primitive and write one gradient row per (tile, primitive) pair. Flat arrays
at constant offsets are what lets LLVM vectorise them; the names keep them readable.
"""

from __future__ import annotations

__all__ = ["gradient_width", "lane", "net_row_width", "row_width"]

# ---- one primitive, as a pixel kernel sees it (method: "float64 preparation, float32 pixels").
# The ray of pixel offset (du, dv) from the anchor pixel (UX, UY) is, in whitened space with t in units of m,
#   x(t) = (XA + TC G) + t e,  G = du EX + dv EY,  e = E0 + G.
# Its origin is slid along the ray by s = du TU + dv TV, to where x is nearly orthogonal to e. The closest approach is
# then a
# small correction, and float32 loses nothing to thin axes:
#   x(t + s) = (XA + du XU + dv XV + s G) + t e,  XU = TC EX + TU E0,  XV = TC EY + TV E0.
E0, EX, EY, XA, XU, XV = 0, 3, 6, 9, 12, 15
TC = 18  # anchor depth / m
TU, TV = 19, 20
UX, UY = 21, 22  # anchor pixel
NEAR = 23  # near plane, (near - anchor depth)/m
OFFSET = 24  # b2
UNIT, ANCHOR_Z = 25, 26  # m and anchor depth in scene units, for the depth image
NEURONS = 27  # then five numbers per neuron:
WX, WY, WZ, PHASE, AMPLITUDE = 0, 1, 2, 3, 4  # W1 on whitened axes and b1 in turns, w2
PER_NEURON = 5

# ---- one primitive's colour network: per unit WX, WY, WZ, PHASE as above, then C output weights
NET_OUT = 4

# How fast a pair of neurons may turn over a half chord, in turns; neurons are stored by rising rate, so that pairs are
# alike.
SLOW, MEDIUM, FAST = 0, 1, 2
SLOW_TURNS, MEDIUM_TURNS = 0.4999, 1.4999

# ---- a gradient row: dL/d(E0, EX, EY, XA) in the same columns, then
G_OFFSET = 12
G_LOG_M = 13  # sum of dL/dI I: the explicit 1/m of the density
G_WEIGHT, G_ERROR = 14, 15  # sums of alpha T and alpha T x pixel error: statistics, not gradients
G_NEURONS = 16  # five per neuron, then C colours, then the units of a colour network

# ---- row spans of a primitive's silhouette, relative to its anchor pixel
SKEW, XC, YC, HX, HY = 0, 1, 2, 3, 4
SPAN_WIDTH = 8
UNBOUNDED = 1e30  # half axes of a silhouette that is not an ellipse

TILE = 16
LANES = 288  # 256 pixels of a tile, padded so that a vector may run over the end


def _padded(floats: int) -> int:
    return -(-floats // 16) * 16


def row_width(neurons: int) -> int:
    """Floats per primitive row for K padded neurons, a multiple of 16."""
    return _padded(NEURONS + PER_NEURON * neurons)


def net_row_width(hidden: int, channels: int) -> int:
    """Floats per row of a colour network of H padded units, at least one."""
    return max((NET_OUT + channels) * hidden, 1)


def gradient_width(neurons: int, channels: int, hidden: int = 0) -> int:
    """Floats per gradient row for K padded neurons, C colours and H padded units of a colour network, a multiple of
    16."""
    return _padded(G_NEURONS + PER_NEURON * neurons + channels + (NET_OUT + channels) * hidden)


def lane(index: int) -> int:
    """Offset of scratch array number ``index``."""
    return LANES * index


# ---- scratch arrays over the compacted lanes of one (tile, primitive) pair
DU, DV = lane(0), lane(1)  # pixel offset from the anchor
EXL, EYL, EZL = lane(2), lane(3), lane(4)  # ray direction e in whitened space
QX, QY, QZ = lane(5), lane(6), lane(7)  # chord middle
HALF = lane(8)  # half chord, units of m along e; 0 where the ray misses
FIELD = lane(9)  # mean of f over the chord
PIXEL = lane(10)  # 16 y + x in the tile
DEPTH = lane(11)  # optical depth, 2 FIELD HALF FADE NORM_L
MID, TM, IA = lane(13), lane(14), lane(15)  # chord middle, closest approach (both t), 1/(e.e)
DH = lane(16)  # dh/dD with the floor on D
UNCUT = lane(17)  # 1 where the near plane does not cut the chord
NORM_L = lane(18)  # length of the ray direction whose camera-z is 1
ALPHA = lane(19)  # opacity after clamp and cut
FADE = lane(
    20
)  # soft edges: mean of (1 - |y|^2)^p over the chord; an optical depth is 2 FIELD HALF FADE, FADE = 1 without
OVER = lane(21)  # 1/(1 - alpha)
SLOPE = lane(22)  # d alpha / d(2 FIELD HALF FADE), 0 where clamped or cut
GRAD = lane(23)  # dL/d(2 FIELD HALF FADE)
GF = lane(24)  # dL/d FIELD
GQX, GQY, GQZ = lane(25), lane(26), lane(27)  # dL/d chord middle
GEX, GEY, GEZ = lane(28), lane(29), lane(30)  # dL/d (half e)
GMID = lane(31)  # dL/d MID from the depth image
HEIGHT = lane(32)  # half chord before the near plane cuts it
SLIDE = lane(33)  # s: MID and TM are measured from a ray origin slid by this much
# of soft edges only: derivatives of FADE, or in float64 of the mean of the whole density, see gradients.chord_gradient
BY_D, BY_A, BY_TM = lane(34), lane(35), lane(36)
INSIDE = lane(37)  # dL/dQ . e of the density alone
FORWARD_SCRATCH = lane(21)
BACKWARD_SCRATCH = lane(38)
# with a colour network also, forward and backward: C arrays of colours before max(0, .), then C of dL/d those
RAY_COLOUR = BACKWARD_SCRATCH
# per neuron of the float64 backward pass: cos sinc, -2 pi sin sinc, cos dsinc
N_COS, N_SIN, N_DSINC = lane(0), lane(1), lane(2)
NEURON_SCRATCH = lane(3)
# per unit of a colour network: cos of its phase, and -2 pi sin, its derivative by turns
NET_COS, NET_SIN = lane(0), lane(1)
NET_SCRATCH = lane(2)

# ---- per-tile pixel state
PIXELS = TILE * TILE
T_, NORM, LAST = 0, PIXELS, 2 * PIXELS  # transmittance, ray norm, rank + 1 of the last contributor
ZSUM = 3 * PIXELS  # forward: sum of w z
COLOR = 4 * PIXELS  # forward: then C arrays of accumulated colour
BEHIND = 3 * PIXELS  # backward: dL/dT_after x T_after, what lies behind
ERR, GZ = 4 * PIXELS, 5 * PIXELS
G_COLOR = 6 * PIXELS  # backward: then C arrays of dL/drgb

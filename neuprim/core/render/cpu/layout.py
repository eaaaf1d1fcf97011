"""Names for the columns of the kernels' flat arrays.

The pixel kernels read one float32 row per primitive and write one gradient row per (tile, primitive) pair. Flat arrays
at constant offsets are what lets LLVM vectorise them; the names keep them readable.
"""

from __future__ import annotations

__all__ = ["lane", "row_width"]

# ---- one primitive, as a pixel kernel sees it (method: "float64 preparation, float32 pixels").
# The ray of pixel offset (du, dv) from the anchor pixel (UX, UY) is, in whitened space with t in units of m,
#   x(t) = (XA + TC (du EX + dv EY)) + t (E0 + du EX + dv EY).
E0, EX, EY, XA = 0, 3, 6, 9
TC = 12  # anchor depth / m
UX, UY = 13, 14  # anchor pixel
NEAR = 15  # near plane, (near - anchor depth)/m
OFFSET = 16  # b2
UNIT, ANCHOR_Z = 17, 18  # m and anchor depth in scene units, for the depth image
NEURONS = 20  # then five numbers per neuron:
WX, WY, WZ, PHASE, AMPLITUDE = 0, 1, 2, 3, 4  # W1 on whitened axes and b1 in turns, w2
PER_NEURON = 5

# ---- columns of a gradient row that differ from the primitive's
G_LOG_M = 12  # sum of dL/dI I: the explicit 1/m of the density
G_WEIGHT, G_ERROR = 13, 14  # sums of alpha T and alpha T x pixel error: statistics, not gradients

# ---- row spans of a primitive's silhouette, relative to its anchor pixel
SKEW, XC, YC, HX, HY = 0, 1, 2, 3, 4
SPAN_WIDTH = 8
UNBOUNDED = 1e30  # half axes of a silhouette that is not an ellipse

TILE = 16
LANES = 288  # 256 pixels of a tile, padded so that a vector may run over the end


def row_width(neurons: int, channels: int = 0) -> int:
    """Floats per row for K padded neurons and C colour columns, a multiple of 16."""
    return -(-(NEURONS + PER_NEURON * neurons + channels) // 16) * 16


def lane(index: int) -> int:
    """Offset of scratch array number ``index``."""
    return LANES * index


# ---- scratch arrays over the compacted lanes of one (tile, primitive) pair
DU, DV = lane(0), lane(1)  # pixel offset from the anchor
EXL, EYL, EZL = lane(2), lane(3), lane(4)  # ray direction e in whitened space
QX, QY, QZ = lane(5), lane(6), lane(7)  # chord middle
HALF = lane(8)  # half chord, units of m along e; 0 where the ray misses
FIELD = lane(9)  # mean of f over the chord
MX, MY, MZ = lane(10), lane(11), lane(12)  # ray point at the anchor depth
MID, TM, IA = lane(13), lane(14), lane(15)  # chord middle, closest approach (both t), 1/(e.e)
DH = lane(16)  # dh/dD with the floor on D
UNCUT = lane(17)  # 1 where the near plane does not cut the chord
NORM_L = lane(18)  # length of the ray direction whose camera-z is 1
ALPHA = lane(19)  # opacity after clamp and cut
OVER = lane(20)  # 1/(1 - alpha)
SLOPE = lane(21)  # d alpha / d(FIELD HALF 2), 0 where clamped or cut
GRAD = lane(22)  # dL/d(FIELD HALF 2)
GF = lane(23)  # dL/d FIELD
GQX, GQY, GQZ = lane(24), lane(25), lane(26)  # dL/d chord middle
GEX, GEY, GEZ = lane(27), lane(28), lane(29)  # dL/d (half e)
GMID = lane(30)  # dL/d MID from the depth image
FORWARD_SCRATCH = lane(20)
BACKWARD_SCRATCH = lane(31)
# per neuron in the backward pass: cos sinc, -2 pi sin sinc, cos dsinc
N_COS, N_SIN, N_DSINC = lane(0), lane(1), lane(2)
NEURON_SCRATCH = lane(3)

# ---- per-tile pixel state
PIXELS = TILE * TILE
T_, NORM, LAST = 0, PIXELS, 2 * PIXELS  # transmittance, ray norm, rank + 1 of the last contributor
ZSUM = 3 * PIXELS  # forward: sum of w z
COLOR = 4 * PIXELS  # forward: then C arrays of accumulated colour
BEHIND = 3 * PIXELS  # backward: dL/dT_after x T_after, what lies behind
ERR, GZ = 4 * PIXELS, 5 * PIXELS
G_COLOR = 6 * PIXELS  # backward: then C arrays of dL/drgb

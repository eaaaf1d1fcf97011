"""Column numbers of the arrays of CPU and CUDA kernels, and bounds above which a primitive is drawn in float64.

A pixel kernel reads one float32 row of numbers per primitive (ellipsoid). The backward pass writes one row of gradients
(a gradient row) per (tile, primitive) pair; a tile has 16 x 16 pixels. Column numbers are constants, so that LLVM can
vectorise. The float32 rows of CUDA kernels consist of float4 columns (:mod:`neuprim.core.render.cuda.layout`). The
float64 rows and gradient rows of CUDA kernels have the columns below. benchmarks/numerics.py measured the float32
bounds.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.model.edge import EDGES

# ---- One primitive, as a pixel kernel sees it.
# The ray of pixel offset (du, dv) from the anchor pixel (UX, UY) is, in whitened space with t in units of m,
#   x(t) = (XA + TC G) + t e,  G = du EX + dv EY,  e = E0 + G.
# Its origin is slid along the ray by s = du TU + dv TV, to where x is nearly orthogonal to e. The closest approach is
# then a small correction, and float32 loses nothing to thin axes:
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

# ---- One primitive's colour network: per unit WX, WY, WZ, PHASE as above, then C output weights.
NET_OUT = 4

# ---- A gradient row: dL/d(E0, EX, EY, XA) in the same columns, then
G_OFFSET = 12
G_LOG_M = 13  # sum of dL/dI I: the explicit 1/m of the density
G_WEIGHT, G_ERROR = 14, 15  # sums of alpha T and alpha T x pixel error: statistics, not gradients
G_NEURONS = 16  # five per neuron, then C colours, then the units of a colour network

# ---- Row spans of a primitive's silhouette, relative to its anchor pixel.
SKEW, XC, YC, HX, HY = 0, 1, 2, 3, 4
SPAN_WIDTH = 8
UNBOUNDED = 1e30  # half axes of a silhouette that is not an ellipse

TILE = 16
PIXELS = TILE * TILE

VISIBLE, CULLED, NON_FINITE = 0, 1, 2
FLOAT32_MAX = 3.0e38

# ---- A primitive is drawn in float64 if it exceeds one of these bounds.
FLOAT64_RADII = 8.0  # cancelling terms of a point on the ray, in radii of the thinnest axis
FLOAT64_ANCHOR = 1.25  # |XA| if anchored at the camera: most cameras outside the primitive, but near
FLOAT64_TURNS = 4.0  # turns of a neuron, or of a unit of a colour network, over half a chord
FLOAT64_PIXELS = 16384.0  # pixels from the corner of the image to the anchor
FLOAT64_RATIO = 256.0  # longest to thinnest axis; the gradients need it
FLOAT64_RATIO_NEAR = 16.0  # the same if anchored at the camera, which the chords pass closely
CUT = 1e-3  # margin at the near plane, share of the reach: float32 may cut a chord that float64 does not

ANCHOR_RADII = 1.5  # a centre more than this far ahead of the camera is its own anchor, even if the near plane cuts

# ---- The visible extent of an ellipsoid. Rays close to the rim cross too little of it to reach alpha_min.
# A chord whose point nearest to the centre has |y|^2 = 1 - D crosses (1 - |y|^2)^p with an integral of N_p D^p times
# half its length, which is at most s D^(1/2), with s the longest half chord of the view's rays. No cosine exceeds its
# amplitude, so an optical depth is at most F N_p s D^(p + 1/2), F = b2 + sum |w2|. Rays below the depth of alpha_min
# count as empty in every backend; they miss the ellipsoid scaled by r = (1 - D)^(1/2). The image and
# every gradient stay the same but for rounding.
VISIBLE_SHARE = 0.99  # share of alpha_min's optical depth that a chord must be able to reach; margin for float32
MIN_RIM = 0.01  # smaller D do not shrink the silhouette: little to gain, and float32 is least accurate there
RIM_POWERS = (2.0, 2 / 3, 2 / 5)  # 1/(p + 1/2)
MIN_RIM_SHARES = tuple(MIN_RIM ** (p + 0.5) for p in EDGES)  # share of the largest depth below which D < MIN_RIM


def min_visible_depth(alpha_min: float) -> float:
    """Return the optical depth below which samples (ray x primitive) are skipped: 99 % of that of ``alpha_min``."""
    return -float(np.log1p(-alpha_min)) * VISIBLE_SHARE

"""Columns of the arrays that both kernel stacks share, and the bounds of their per-primitive stage.

A pixel kernel reads one float32 row per primitive and writes one gradient row per (tile, primitive) pair. Constant
offsets into flat arrays let LLVM vectorise. The CUDA kernels have float4 rows (:mod:`neuprim.core.render.cuda.layout`),
but float64 rows and gradient rows with these columns. Float32 bounds were found with benchmarks/numerics.py.
"""

from __future__ import annotations

# ---- One primitive, as a pixel kernel sees it (method: "float64 preparation, float32 pixels").
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

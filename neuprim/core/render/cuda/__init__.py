"""The cuda backend: render primitives with GPU kernels in NVIDIA Warp and hand-written gradients.

The modules handle a frame in this order: ``prepare`` (project primitives), ``binning`` (list the primitives of each
tile), ``slots`` (list the pixels of each (tile, primitive) pair) and ``forward`` (composite). ``backward`` and
``prepare_backward`` compute gradients. Primitives are projected in float64. Pixels are computed in float32, or by the
module ``float64`` where float32 is not accurate enough. For tests, the same source runs on the CPU.
"""

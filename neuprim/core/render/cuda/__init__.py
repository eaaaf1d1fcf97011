"""The cuda backend: render primitives by GPU kernels in NVIDIA Warp, with hand-written gradients.

A frame runs through ``prepare`` (project primitives), ``binning`` (list the primitives of each tile), ``slots`` (list
the pixels of each (tile, primitive) pair) and ``forward`` (composite). ``backward`` and ``prepare_backward`` compute
gradients. Primitives are projected in float64 and pixels computed in float32, or in ``float64`` where needed. For
tests, the same source runs on the CPU.
"""

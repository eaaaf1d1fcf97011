"""CUDA backend in Warp: float64 preparation per primitive, float32 pixels. For tests, the same source runs on Warp's
CPU blocks."""

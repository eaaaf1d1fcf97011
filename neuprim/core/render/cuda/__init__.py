"""The cuda backend, in Warp: per-primitive stage in float64, pixel stage in float32.

For tests, the same source runs on the CPU, as Warp's CPU blocks.
"""

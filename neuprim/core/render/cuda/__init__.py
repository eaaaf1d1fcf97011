"""The cuda backend, in Warp. Projects primitives in float64; computes pixels in float32.

For tests, the same source runs on the CPU, as Warp's CPU blocks.
"""
